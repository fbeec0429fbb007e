"""All of a case but its effects: runs, noise and the scales of the motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from tests.gap_cases.effects import CaseError, Context
from tests.gap_cases.excitation import SHAPES, SLOWEST
from tests.gap_cases.gap import measure
from tests.gap_cases.logs import Log, Noise
from tests.gap_cases.mechanisms import GRAVITY, Mechanism
from tests.gap_cases.simulate import Plan, record
from tests.gap_cases.truth import assemble, felt_inertia, home

NOISE = (1e-4, 2e-3)
"""Bounds of the encoders' noise, rad; a slide's is scaled to its travel."""
SLIDE_SCALE = 0.3
EXCESS = 1.06
"""What integration and velocity fits may add to a perfect model's floor."""


@dataclass(frozen=True)
class Setting:
    """All of a case but its effects."""

    mechanism: Mechanism
    fine: float
    plans: tuple[Plan, ...]
    noise: Noise
    context: Context
    notes: dict[str, float]


def owner_model(mechanism: Mechanism) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(mechanism.xml())


def _scale(mechanism: Mechanism) -> np.ndarray:
    # A contact turns small errors of the height into large forces.
    slide = SLIDE_SCALE / 3 if mechanism.on_ground else SLIDE_SCALE
    return np.array([1.0 if j.kind == "hinge" else slide for j in mechanism.joints])


def _noise(mechanism: Mechanism, std: float, grains: float) -> Noise:
    """Noise of `std` rad; `grains` is the encoder's step over it, 0 for none."""
    scale = _scale(mechanism)
    quantum = np.zeros(len(scale))
    if grains:
        hinge = 2 * np.pi / 2 ** round(np.log2(2 * np.pi / (grains * std)))
        slide = float(f"{grains * std * scale.min():.1g}")
        kinds = [joint.kind for joint in mechanism.joints]
        quantum = np.array([hinge if kind == "hinge" else slide for kind in kinds])
    return Noise(std * scale, quantum)


def _context(mechanism: Mechanism, log: Log, fine: float) -> Context:
    """Scales of the motion of a run without effects."""
    model = owner_model(mechanism)
    inertia = felt_inertia(model, home(mechanism))
    torque = inertia * np.sqrt(np.mean(log.qacc**2, axis=0))
    if mechanism.on_ground:
        # What matters to the trunk is its weight.
        rails = [i for i, j in enumerate(mechanism.joints) if j.body == "trunk"]
        weight = 0.2 * inertia[rails] * GRAVITY
        torque[rails] = np.maximum(torque[rails], weight)
    for column, joint in enumerate(mechanism.driven):
        drive = mechanism.joints[joint].gear * log.force[:, column]
        torque[joint] = max(torque[joint], float(np.sqrt(np.mean(drive**2))))
    bodies = [joint.body for joint in mechanism.joints]
    size = {}
    for name in bodies:
        geoms = np.flatnonzero(model.geom_bodyid == model.body(name).id)
        size[name] = float(2.0 * model.geom_size[geoms].max())
    return Context(
        mechanism=mechanism,
        torque=torque,
        speed=np.sqrt(np.mean(log.true_qvel**2, axis=0)),
        span=np.ptp(log.true_qpos, axis=0),
        center=0.5 * (log.true_qpos.max(axis=0) + log.true_qpos.min(axis=0)),
        inertia=inertia,
        command=np.abs(log.ctrl).max(axis=0),
        force=np.abs(log.force).max(axis=0),
        mass={name: float(model.body(name).mass[0]) for name in bodies},
        size=size,
        friction=float(model.geom_friction[0, 0]),
        fine=fine,
    )


def settle(
    mechanism: Mechanism, rng: np.random.Generator, coarse: bool = False
) -> Setting:
    """Runs and noise under which a perfect model's gap is close to its floor.

    Where the owner's timestep and the velocity fits leave more than `EXCESS`, the
    timestep is halved, the noise raised or the motion slowed; not where ``coarse``.
    """
    cheap = len(mechanism.joints) < 3
    fine = 2.5e-4 if cheap and rng.random() < 1 / 3 else 5e-4
    shapes = [SHAPES[i % 3] for i in rng.permutation(int(rng.integers(3, 5)))]
    plans = tuple(
        Plan(
            duration=float(np.round(rng.uniform(6.0, 10.0), 1)),
            shape=shape,
            seed=int(rng.integers(2**31)),
            begins=float(np.round(rng.uniform(0.0, 30.0), 2)),
        )
        for shape in shapes
    )
    std = drawn = float(np.exp(rng.uniform(*np.log(NOISE))))
    grains = float(rng.uniform(1.0, 3.0)) if rng.random() < 1 / 3 else 0.0
    notes = {"drawn_timestep": mechanism.timestep, "drawn_speed": mechanism.speed}
    ideal = Noise(np.zeros(len(mechanism.joints)), np.zeros(len(mechanism.joints)))
    logs: list[Log] = []
    for _ in range(12):
        if not logs:
            truth = assemble(mechanism, [], fine)
            try:
                logs = [record(truth, plan, ideal) for plan in plans]
            except CaseError:
                mechanism = mechanism.calmer(0.75)
                continue
        needed = _needed(mechanism, logs, std)
        if needed <= std or coarse:
            break
        if mechanism.timestep > 1.5e-3 and (needed > NOISE[1] or rng.random() < 0.5):
            mechanism = mechanism.with_timestep(mechanism.timestep / 2)
        elif needed <= NOISE[1]:
            std = needed
        else:
            mechanism = replace(mechanism, speed=0.8 * mechanism.speed)
            if mechanism.speed <= SLOWEST:
                raise CaseError("slow enough for its floor, it hardly moves")
            logs = []
    else:
        raise CaseError("the perfect model stays above its floor")
    notes |= {"drawn_noise": drawn, "speed": mechanism.speed}
    noise = _noise(mechanism, std, grains)
    return Setting(
        mechanism, fine, plans, noise, _context(mechanism, logs[-1], fine), notes
    )


def _needed(mechanism: Mechanism, logs: Sequence[Log], std: float) -> float:
    """Noise, rad, that leaves a perfect model at `EXCESS` times its floor.

    Scaled from the floor of `std`.
    """
    probe = _noise(mechanism, std, 0.0)
    gap = measure(
        owner_model(mechanism), logs, probe, np.random.default_rng(0), quick=True
    )
    # The logs have no noise: their gap is integration and fits alone.
    return std * gap.gap / (gap.floor * float(np.sqrt(EXCESS**2 - 1.0)))

"""Machines with a law that no table has, and controls without any; plain MuJoCo.

A law is a generalized force that plain functions compute between the steps of a
simulation by MuJoCo. Its size is set so that it moves predictions by a wanted
multiple of the sensor noise.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

STEP = 0.002  # s, of the model and of the machine
ROW = 0.01  # s
RUNS = 3
NOISE = 3e-4  # rad or m
HORIZON = 20  # rows, over which the size of a law is measured
STICTION = 0.02  # speed over which a sign turns

_LINK = """<body pos="0 0 {0}"><joint name="{1}" axis="0 1 0" damping="{2}"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="{3}"/>{4}</body>"""


def _chain(names: tuple[str, ...]) -> str:
    inner = ""
    for k in reversed(range(len(names))):
        damping, mass = 0.06 / (k + 1), 0.8 / (k + 1)
        inner = _LINK.format(-0.3 if k else 0, names[k], damping, mass, inner)
    return inner


def _model(name: str, body: str, joints: tuple[str, ...], gear: float) -> str:
    motors = "".join(
        f'<motor name="{j}_motor" joint="{j}" gear="{gear / (k + 1):.3g}"/>'
        for k, j in enumerate(joints)
    )
    return (
        f'<mujoco model="{name}"><option timestep="{STEP}" integrator="implicitfast"/>'
        f"<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


_THREE = ("base", "upper", "fore")
_CART = """<body><joint name="cart" type="slide" axis="1 0 0" damping="0.8"
stiffness="9"/>
<geom size="0.1" mass="1.5"/></body>"""
MACHINES = {
    "pendulum": _model("pendulum", _chain(("hinge",)), ("hinge",), 0.6),
    "cart": _model("cart", _CART, ("cart",), 8.0),
    "arm2": _model("arm2", _chain(("shoulder", "elbow")), ("shoulder", "elbow"), 0.9),
    "arm3": _model("arm3", _chain(_THREE), _THREE, 1.2),
}


@dataclass
class State:
    """Of a machine between two steps.

    Attributes:
        q, v, u: positions, speeds, commands.
        time: s.
        h: step, s.
        hidden: what laws remember.
    """

    q: np.ndarray
    v: np.ndarray
    u: np.ndarray
    time: float
    h: float
    hidden: dict[str, float] = field(default_factory=dict)


Law = Callable[[State], np.ndarray]  # generalized forces of a law of size one


def _sign(x: float) -> float:
    return float(np.tanh(x / STICTION))


def _at_first(force: Callable[[State], float]) -> Law:
    def law(s: State) -> np.ndarray:
        out = np.zeros(len(s.v))
        out[0] = force(s)
        return out

    return law


def _along(share: float, force: Callable[[float, float], float]) -> Law:
    """Along the last joint plus ``share`` times the one before."""

    def law(s: State) -> np.ndarray:
        out = np.zeros(len(s.v))
        f = force(s.q[-1] + share * s.q[-2], s.v[-1] + share * s.v[-2])
        out[-1], out[-2] = f, share * f
        return out

    return law


def _hysteresis(s: State) -> float:
    """Bouc and Wen, with a bend of 0.05."""
    z, v = s.hidden.get("z", 0.0), float(s.v[0])
    z += s.h * (v - 0.6 * abs(v) * z - 0.4 * v * abs(z)) / 0.05
    s.hidden["z"] = z
    return -z


def _warms(s: State) -> float:
    """Dry friction that falls to two fifths while it runs warm."""
    w = s.hidden.get("w", 0.0)
    s.hidden["w"] = w + s.h * abs(float(s.v[0])) * (1 - w) / 6.0
    return -_sign(float(s.v[0])) * (1.0 - 0.6 * w)


LAWS: dict[str, tuple[Law, tuple[str, ...]]] = {
    "coupling": (_along(-1.0, lambda q, v: -q), ("arm2", "arm3")),
    "wrist": (_along(1.0, lambda q, v: -_sign(v)), ("arm2", "arm3")),
    "direction": (
        _at_first(lambda s: float(abs(s.v[0]))),
        ("pendulum", "cart", "arm2"),
    ),
    "thrust": (_at_first(lambda s: float(s.u[0] * abs(s.u[0]))), ("pendulum", "cart")),
    "hysteresis": (_at_first(_hysteresis), ("pendulum", "cart", "arm2")),
    "warm": (_at_first(_warms), ("pendulum", "cart")),
    "cubic": (_at_first(lambda s: float(-(s.q[0] ** 3))), ("pendulum", "cart", "arm2")),
    "place": (
        _at_first(lambda s: -_sign(float(s.v[0])) * (1 + np.sin(2 * float(s.q[0])))),
        ("pendulum", "arm2"),
    ),
}


def _damping(s: State) -> np.ndarray:
    return np.r_[-s.v[0], np.zeros(len(s.v) - 1)]


def _friction(s: State) -> np.ndarray:
    """MuJoCo's own, which holds; see `_moved`."""
    return np.zeros(len(s.v))


def _constant(s: State) -> np.ndarray:
    return np.r_[1.0, np.zeros(len(s.v) - 1)]


def _spring(s: State) -> np.ndarray:
    return np.r_[-(s.q[0] - 0.2), np.zeros(len(s.v) - 1)]


# What tables have.
CONTROLS: dict[str, Law] = {
    "damping": _damping,
    "friction": _friction,
    "constant": _constant,
    "spring": _spring,
}


def _commands(m: mujoco.MjModel, rng: np.random.Generator, rows: int) -> np.ndarray:
    t = ROW * np.arange(rows)[:, None, None]
    rate = rng.uniform(0.2, 1.6, (m.nu, 4))
    waves = np.sin(2 * np.pi * rate * t + rng.uniform(0, 6, (m.nu, 4)))
    return 0.8 * waves.sum(-1) / 2


def _moved(
    m: mujoco.MjModel,
    ctrl: np.ndarray,
    law: Law | None,
    size: float,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, speeds and the law's forces in each row."""
    if law is _friction:
        m = copy.copy(m)
        m.dof_frictionloss[0] = size
    d = mujoco.MjData(m)
    if start is not None:
        d.qpos[:], d.qvel[:] = start
    h = float(m.opt.timestep)
    s = State(d.qpos, d.qvel, ctrl[0], 0.0, h)
    q, v, f = [], [], []
    for row in ctrl:
        d.ctrl[:] = row
        for k in range(round(ROW / h)):
            s.q, s.v, s.u, s.time = d.qpos, d.qvel, row, d.time
            force = np.zeros(m.nv) if law is None else size * law(s)
            if k == 0:
                q.append(d.qpos.copy())
                v.append(d.qvel.copy())
                f.append(force)
            d.qfrc_applied[:] = force
            mujoco.mj_step(m, d)
    return np.array(q), np.array(v), np.array(f)


def _sized(m: mujoco.MjModel, law: Law, floors: float, ctrl: np.ndarray) -> float:
    """How large a law has to be to move predictions of a run by so many times the
    noise."""
    rows = len(ctrl)
    size = 0.01
    for _ in range(6):
        q, v, _ = _moved(m, ctrl, law, size)
        off = []
        for begin in range(HORIZON, rows - HORIZON, HORIZON):
            part = ctrl[begin : begin + HORIZON]
            plain, _, _ = _moved(m, part, None, 0.0, (q[begin], v[begin]))
            off.append(plain - q[begin : begin + HORIZON])
        got = float(np.sqrt(np.mean(np.square(off))))
        if abs(got / (floors * NOISE) - 1) < 0.1:
            break
        size *= float(np.clip(floors * NOISE / max(got, 1e-12), 0.05, 20.0))
    return size


def draw_law(seed: int, folder: Path, control: bool = False) -> dict:
    """Writes ``model.xml``, three runs and ``answer.json``; the hidden forces of each
    row are ``hidden.npz``, by run.

    Returns:
        The answer.
    """
    rng = np.random.default_rng([seed, int(control)])
    if control:
        name = list(CONTROLS)[seed % len(CONTROLS)]
        law, machines = CONTROLS[name], tuple(MACHINES)
    else:
        name = list(LAWS)[seed % len(LAWS)]
        law, machines = LAWS[name]
    machine = str(rng.choice(machines))
    floors = float(np.exp(rng.uniform(np.log(3), np.log(30))))
    xml = MACHINES[machine]
    m = mujoco.MjModel.from_xml_string(xml)
    rows = [int(n) for n in rng.integers(800, 1600, RUNS)]
    sent = [_commands(m, rng, n) for n in rows]
    size = _sized(m, law, floors, sent[0])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(xml)
    hidden = {}
    for run, ctrl in enumerate(sent, 1):
        q, _, f = _moved(m, ctrl, law, size)
        hidden[f"run{run}"] = f
        read = q + NOISE * rng.normal(size=q.shape)
        head = ["time", *(f"qpos.{m.joint(j).name}" for j in range(m.njnt))]
        head += [f"ctrl.{m.actuator(a).name}" for a in range(m.nu)]
        table = np.column_stack([ROW * np.arange(len(ctrl)), read, ctrl])
        lines = [",".join(f"{x:.9g}" for x in row) for row in table]
        (folder / f"run{run}.csv").write_text("\n".join([",".join(head), *lines, ""]))
    np.savez(folder / "hidden.npz", **hidden)
    answer = {
        **{"law": name, "control": control, "machine": machine},
        **{"size": size, "floors": floors},
    }
    (folder / "answer.json").write_text(json.dumps(answer))
    return answer

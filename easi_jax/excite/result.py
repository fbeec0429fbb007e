"""What was chosen as plain values, for files and for people."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.excite.candidates import Test
from easi_jax.excite.choose import Choice
from easi_jax.excite.play import Bench
from easi_jax.excite.separation import nearest_rival
from easi_jax.model.joint_space import joint_name, scalar_dofs
from easi_jax.model.results import (
    ActuatorUse,
    Alias,
    Controller,
    EffectSeen,
    ExciteResult,
    JointUse,
    NumberSeen,
    PairSeen,
    PairWanted,
    Signal,
    Tried,
)

_PAIRS = 20
_TINY = 1e-12  # times the noise: an effect that shows less is divided by this


def excite_result(
    bench: Bench,
    tests: Sequence[Test],
    choice: Choice,
    *,
    model: str,
    noise: np.ndarray,
    horizon: float,
    margin: float,
    duration: float,
    notes: Sequence[str],
) -> ExciteResult:
    """The test that was chosen of ``tests``, and what it promises.

    Args:
        model: name.
        noise: of positions, ``(nv,)``; infinite where nobody measures them.
        horizon: of the predictions that the gap workflow will make [s].
        margin: share of a joint's range that is left free at both ends.
        duration: of each test [s].
        notes: what the user should know.
    """
    m, best = bench.models[0], tests[choice.best]
    keys = choice.found[choice.best].keys
    order = np.argsort(-choice.scores, kind="stable").tolist()
    return ExciteResult(
        model=model,
        signal=Signal(
            best.recipe.text(),
            best.recipe.kind,
            (best.recipe.low, best.recipe.high),
            best.recipe.level,
            _by_actuator(m, best.amplitude),
            _by_actuator(m, bench.hold),
            {
                joint_name(m, j): float(bench.start[q])
                for j, (q, _) in scalar_dofs(m).items()
            },
            best.seed,
            duration,
            1.0 / bench.dt,
        ),
        controller=_controller(m, bench),
        margin=margin,
        joints=_joints(m, bench, best),
        actuators=_actuators(m, bench, best),
        score=float(choice.scores[choice.best]),
        noise={
            joint_name(m, j): float(noise[d])
            for j, (_, d) in scalar_dofs(m).items()
            if np.isfinite(noise[d])
        },
        horizon=horizon,
        effects=_effects(choice),
        worst_pairs=_worst(choice),
        told_apart=_wanted(choice),
        no_trace=tuple(
            k for k, unseen in zip(keys, choice.known.unseen, strict=True) if unseen
        ),
        twins=_twins(choice),
        tried=tuple(
            Tried(
                tests[i].recipe.text(),
                _by_actuator(m, tests[i].amplitude),
                float(choice.scores[i]),
            )
            for i in order
        ),
        windows=choice.windows,
        changes=choice.vectors,
        notes=tuple(notes),
    )


def _by_actuator(m: mujoco.MjModel, values: np.ndarray) -> dict[str, float]:
    return {m.actuator(a).name: float(values[a]) for a in range(m.nu)}


def _controller(m: mujoco.MjModel, bench: Bench) -> Controller | None:
    f = bench.feedback
    if f is None:
        return None
    return Controller(
        "ctrl = feedforward - kp (qpos - start) - kd qvel, at the rate",
        _by_actuator(m, f.kp),
        _by_actuator(m, f.kd),
    )


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _joints(m: mujoco.MjModel, bench: Bench, best: Test) -> dict[str, JointUse]:
    limits = bench.limits
    qpos = np.concatenate([x.qpos for x in best.motions])
    qvel = np.concatenate([x.qvel for x in best.motions])
    out = {}
    for j, (q, d) in scalar_dofs(m).items():
        low, high = m.jnt_range[j].tolist()
        out[joint_name(m, j)] = JointUse(
            (float(limits.low[d]), float(limits.high[d])),
            _ends(qpos[:, q]),
            _ends(best.run.qpos[:, q]),
            (low, high) if m.jnt_limited[j] else None,
            float(limits.speed[d]),
            float(np.abs(qvel[:, d]).max()),
        )
    return out


def _actuators(m: mujoco.MjModel, bench: Bench, best: Test) -> dict[str, ActuatorUse]:
    limits = bench.limits
    ctrl = np.concatenate([x.ctrl for x in best.motions])
    force = np.concatenate([x.force for x in best.motions])
    return {
        m.actuator(a).name: ActuatorUse(
            (float(limits.ctrl_low[a]), float(limits.ctrl_high[a])),
            _ends(ctrl[:, a]),
            float(limits.force[a]),
            float(np.abs(force[:, a]).max()),
        )
        for a in range(m.nu)
    }


def _effects(choice: Choice) -> dict[str, EffectSeen]:
    best = choice.found[choice.best]
    distance, rival = nearest_rival(best, choice.known)
    return {
        key: EffectSeen(
            float(best.visible[i]),
            best.keys[rival[i]] if rival[i] >= 0 else None,
            float(distance[i]),
            tuple(
                NumberSeen(name, unit, size, std, std / size)
                for (name, unit, size), std in zip(
                    choice.numbers[key], best.std[key], strict=True
                )
            ),
        )
        for i, key in enumerate(best.keys)
    }


def _worst(choice: Choice) -> tuple[PairSeen, ...]:
    """The pairs that the chosen test tells apart worst, twins left out."""
    s, known = choice.found[choice.best], choice.known
    count = len(s.keys)
    rows = sorted(
        (float(s.apart[i, j]), s.keys[i], s.keys[j], float(s.visible[i]))
        for i in range(count)
        for j in range(count)
        if i != j and not known.unseen[i] and not known.same[i, j]
    )
    return tuple(
        PairSeen(a, b, apart, apart / max(visible, _TINY))
        for apart, a, b, visible in rows[:_PAIRS]
    )


def _wanted(choice: Choice) -> tuple[PairWanted, ...]:
    s = choice.found[choice.best]
    return tuple(
        PairWanted(
            s.keys[i],
            s.keys[j],
            float(s.apart[i, j]),
            float(max(f.apart[i, j] for f in choice.found)),
            bool(choice.known.same[i, j] or choice.known.unseen[i]),
        )
        for i, j in choice.wanted
    )


def _twins(choice: Choice) -> tuple[Alias, ...]:
    keys, same = choice.found[choice.best].keys, choice.known.same
    return tuple(
        Alias(a, b, bool(same[j, i]))
        for i, a in enumerate(keys)
        for j, b in enumerate(keys)
        if same[i, j] and (i < j or not same[j, i])
    )

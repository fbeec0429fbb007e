"""What ``train.excite`` is asked: model, limits, noise, what is to be told apart."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco
    import numpy as np

    from easi_jax.excite.drives import Limits
    from easi_jax.excite.play import Bench
    from easi_jax.model.effect_catalog import Scales
    from easi_jax.model.parameters import ParameterSpace
    from train._excite_config import Config
    from train._gap_problem import GivenModel

Strengths = Mapping[str, Mapping[str, float]]  # by effect, then by column
_NOISE = 1e-3  # rad, m
_TRAVEL = {2: 0.5, 3: math.pi}  # m for slides, rad for hinges
_RATE = 100.0  # Hz


@dataclasses.dataclass(frozen=True)
class ExciteProblem:
    """A machine that is to be excited.

    Attributes:
        name: of the model.
        mj_model: compiled.
        space: its own parameters that a refit may move.
        bench: model, wrong models, start, hold, limits.
        most: largest change of each command, ``(nu,)``.
        noise: of positions, ``(nv,)``; infinite where nobody measures them.
        scales: of --data; None without.
        pairs: effects that are to be told apart; empty: all.
        strengths: of those, by key, then by column of an effects file.
        notes: what the user should know.
    """

    name: str
    mj_model: "mujoco.MjModel"
    space: "ParameterSpace"
    bench: "Bench"
    most: "np.ndarray"
    noise: "np.ndarray"
    scales: "Scales | None"
    pairs: list[tuple[str, str]]
    strengths: Strengths
    notes: list[str]


def read_excite_problem(config: "Config") -> ExciteProblem:
    """Reads and checks everything; nothing is written yet.

    Raises:
        UserError: whatever is wrong with the files or the options.
    """
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.excite.candidates import LEAD, make_bench
    from easi_jax.excite.choose import check_names
    from easi_jax.io.models.parameter_file import read_parameter_file
    from easi_jax.model.joint_space import joint_name, scalar_dofs
    from easi_jax.model.parameter_proposal import own_space
    from train._gap_problem import read_model
    from train._log_problem import held_of

    if not config.model:
        raise UserError("give --model M.xml (or a robot's name)")
    _check_numbers(config, LEAD)
    check_names(config.only)
    _check_out(config)
    model = read_model(config.model, config.allow_assets, held_of(config))
    m, notes = _with_effects(config, model)
    if not m.nu:
        raise UserError(f"{config.model}: the model has no actuator to excite")
    space = (
        own_space(m)
        if config.parameters is None
        else read_parameter_file(config.parameters, m)
    )
    joints = {joint_name(m, j): qd for j, qd in scalar_dofs(m).items()}
    of_joint = {n: d for n, (_, d) in joints.items()}
    of_actuator = {m.actuator(a).name: a for a in range(m.nu)}
    dt, noise, scales = _from_data(config, m, notes)
    if config.rate is not None:
        dt = 1.0 / config.rate
    if dt is None:
        dt = 1.0 / _RATE if model.env is None else float(model.env.dt)
    noise = _noise(config, m, of_joint, noise)
    limits, more = _limits(config, m, of_joint)
    notes += more
    most = _numbers("--amplitude", config.amplitude, of_actuator, np.full(m.nu, np.inf))
    rows = round(config.duration / dt) + 1
    bench, more = make_bench(m, limits, dt, rows, config.play)
    pairs, strengths = from_gap(config.gap, m, notes)
    return ExciteProblem(
        model.name,
        m,
        space,
        bench,
        most,
        noise,
        scales,
        pairs,
        strengths,
        [*notes, *more],
    )


def _with_effects(
    config: "Config", model: "GivenModel"
) -> "tuple[mujoco.MjModel, list[str]]":
    """The model with what --effects says, and notes on what MJCF cannot."""
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.export.mjcf import identified_model
    from easi_jax.model.found_effects import FoundEffects, joined
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.simulator import Simulator
    from train._effects import found_in, read_given

    m, given = model.mj_model, read_given(config)
    found = found_in(given.effects, str(config.effects))
    if not found:
        return m, []
    if config.held_base:
        raise UserError(
            "--effects goes without --held-base: give a model whose base is held"
        )
    none = ParameterSpace(())
    joined(m, none, found)  # refuses what the model has no place for
    _, own = joined(m, none, FoundEffects(own=found.own))
    machine = Simulator(m, none, m.opt.timestep, fixed=own)
    with_them = identified_model(model.source, machine, np.zeros(0), found.physical)
    left = ", ".join(with_them.left)
    told = f"not in the model that commands are tried with: {left}"
    return with_them.model, [told] if left else []


def _noise(
    config: "Config",
    m: "mujoco.MjModel",
    of_joint: Mapping[str, int],
    noise: "np.ndarray",
) -> "np.ndarray":
    """Noise ``(nv,)`` as it is given, infinite where nobody measures; ``noise`` where
    it is not given."""
    import numpy as np

    from easi_jax.io.logs.columns import named_joints

    hidden = ~np.isfinite(noise)
    hidden[[of_joint[n] for n in named_joints(m, config.unmeasured) & {*of_joint}]] = (
        True
    )
    return np.where(hidden, np.inf, _numbers("--noise", config.noise, of_joint, noise))


def _limits(
    config: "Config", m: "mujoco.MjModel", of_joint: Mapping[str, int]
) -> "tuple[Limits, list[str]]":
    """Where joints may go, and what nothing checks."""
    import numpy as np

    from easi_jax.excite.choose import check_excitable
    from easi_jax.excite.drives import limits_of
    from easi_jax.model.joint_space import scalar_dofs

    check_excitable(m)
    speed = _numbers("--max-speed", config.max_speed, of_joint, np.full(m.nv, np.inf))
    default = np.full(m.nv, _TRAVEL[3])
    for j, (_, d) in scalar_dofs(m).items():
        default[d] = _TRAVEL[int(m.jnt_type[j])]
    travel = _numbers("--travel", config.travel, of_joint, default)
    limits = limits_of(m, config.margin, travel, speed)
    notes = []
    for joint in limits.assumed:
        reach = travel[of_joint[joint]]
        notes.append(
            f'joint "{joint}" has no range in the model: kept within {reach:.3g} of '
            "its start (--travel)"
        )
    if len(scalar_dofs(m)) < m.njnt:
        notes.append(
            "nothing checks what a free or ball joint does: hang up the base "
            "(--held-base), or watch the predicted positions"
        )
    return limits, notes


def _check_numbers(config: "Config", lead: float) -> None:
    from easi_jax.errors import UserError

    least = 2 * lead + max(2.0, 4 * config.horizon)
    if not (math.isfinite(config.duration) and least <= config.duration <= 600):
        raise UserError(
            f"--duration is {config.duration:g}: give {least:g} to 600 s, of which "
            f"{2 * lead:g} are rest"
        )
    if config.rate is not None and not 10 <= config.rate <= 2000:
        raise UserError(f"--rate is {config.rate:g}: give 10 to 2000 Hz")
    if not 0 <= config.margin < 0.4:
        raise UserError(f"--margin is {config.margin:g}: give a share from 0 to 0.4")
    if not (math.isfinite(config.horizon) and 0 < config.horizon <= 5):
        raise UserError(f"--horizon is {config.horizon:g}: give seconds, at most 5")
    if config.seed < 0:
        raise UserError(f"--seed is {config.seed}: give a whole number from 0 up")


def _check_out(config: "Config") -> None:
    """Refuses to touch a file before minutes of work, not after."""
    from easi_jax.errors import UserError

    if config.out.suffix and config.out.suffix != ".csv":
        raise UserError(f"--out {config.out}: give a folder, or a file NAME.csv")
    if config.out.suffix == ".csv":
        for path in (config.out, config.out.with_suffix(".json")):
            if path.exists() and not config.overwrite:
                raise UserError(
                    f"{path} exists: --overwrite replaces it, or choose another --out"
                )
    elif (config.out / "config.json").exists() and not config.overwrite:
        raise UserError(
            f"{config.out} already holds a run: --overwrite deletes it, or choose "
            "another --out"
        )


def _numbers(
    option: str, given: Sequence[str], index: Mapping[str, int], default: "np.ndarray"
) -> "np.ndarray":
    """Values of ``1.5`` (for all) and ``NAME=1.5`` over defaults ``(n,)``.

    Raises:
        UserError: no number above 0, or an unknown name.
    """
    import numpy as np

    from easi_jax.errors import UserError, nearest

    out = np.array(default, float)
    for text in sorted(given, key=lambda t: "=" in t):
        name, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise UserError(f'{option} "{text}": give a number above 0, or NAME=NUMBER')
        if "=" not in text:
            out[:] = value
        elif name in index:
            out[index[name]] = value
        else:
            raise UserError(
                f'{option}: the model has no "{name}"{nearest(name, index)} (known: '
                f"{', '.join(index)})"
            )
    return out


def _from_data(
    config: "Config", m: "mujoco.MjModel", notes: list[str]
) -> "tuple[float | None, np.ndarray, Scales | None]":
    """Control step, noise ``(nv,)`` and scales of earlier logs."""
    import numpy as np

    if not config.data:
        return None, np.full(m.nv, _NOISE), None
    from easi_jax.data.cleaning import to_common_step
    from easi_jax.data.noise import pooled_noise
    from easi_jax.data.scales import scales_of
    from easi_jax.io.logs.reader import read_logs

    log = read_logs(list(config.data), m, config.mapping, config.unmeasured)
    notes += log.notes
    runs, changed = to_common_step(log.runs)
    notes += changed
    noise = np.maximum(pooled_noise(log.runs)[: m.nv], 1e-6)
    return runs[0].dt, noise, scales_of(m, runs)


def from_gap(
    gap: Path | None, m: "mujoco.MjModel", notes: list[str]
) -> tuple[list[tuple[str, str]], Strengths]:
    """What a result of train.gap leaves open, with the strengths that it found.

    Of like places the first stands for all: what tells its names apart tells theirs.

    Args:
        gap: a run folder, or its ``gap.json``.
        m: the model that it is of.
        notes: takes what is to be told.
    """
    if gap is None:
        return [], {}
    from easi_jax.io.models.effects_file import read_effects
    from easi_jax.io.runs.schemas import GAP, read_checked

    path = gap / "gap.json" if gap.is_dir() else gap
    told = read_checked(path, GAP, "a gap.json of train.gap")
    pairs = []
    for effect in told["effects"]:
        key = _single(f"{effect['effect']}@{effect['at']}", m)
        pairs += [(key, _single(other, m)) for other in effect["indistinguishable"]]
    if not pairs:
        notes.append(f"{path} leaves no names open: the test is chosen for all effects")
        return [], {}
    pairs += [(b, a) for a, b in pairs]
    beside = path.parent / "effects.yaml"
    found = read_effects(beside)[0] if beside.exists() else []
    strengths = {f"{e.effect}@{e.at}": e.columns for e in found}
    return list(dict.fromkeys(pairs)), strengths


def _single(key: str, m: "mujoco.MjModel") -> str:
    """``effect@PATTERN`` at the first place of the model that the pattern fits."""
    from easi_jax.model import addresses as language
    from easi_jax.model.effect_catalog import CATALOG

    effect, _, at = key.partition("@")
    sites = CATALOG[effect].sites if effect in CATALOG and "*" in at else {}
    kinds = [kind for kind in ("joint", "actuator", "body") if kind in sites]
    each = (language.matching(at, language.names(m, kind)) for kind in kinds)
    return next((f"{effect}@{names[0]}" for names in each if names), key)

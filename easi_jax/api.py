"""What stands behind the names of `easi_jax`: files in, results as plain values out.

The commands of ``train`` do the same with folders, checkpoints and reports.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.measured import measured_runs
from easi_jax.data.recording import Log
from easi_jax.devices.runtime import fast_loops, quick_compile
from easi_jax.errors import UserError
from easi_jax.estimation.from_runs import ready_finish, replayed, search_data
from easi_jax.estimation.held_out import held_out_errors, ready_errors
from easi_jax.estimation.posterior import sound
from easi_jax.estimation.problem import HORIZON, Problem, checked_horizon, problem_of
from easi_jax.estimation.relative import result_of
from easi_jax.export.mjcf import written_machine
from easi_jax.export.policy import Interface, interface_of, policy_files
from easi_jax.gap.analysis import Analysis
from easi_jax.gap.excitation_coverage import coverage_notes
from easi_jax.gap.sensor_faults import reading_faults, without_faults
from easi_jax.gap.summary import gap_result
from easi_jax.io.files import atomic_write
from easi_jax.io.logs.reader import read_logs
from easi_jax.io.models.completed import base_joint, own_pose
from easi_jax.io.models.mjcf import read_machine
from easi_jax.io.models.parameter_file import read_parameter_file
from easi_jax.io.report.numbers import number, quantity, shown_unit, with_unit
from easi_jax.model import distribution
from easi_jax.model.checks import checked_array
from easi_jax.model.distribution import Distribution
from easi_jax.model.found_effects import FoundEffects
from easi_jax.model.own_effects import OwnEffect, registered
from easi_jax.model.own_effects_check import check_own_effects
from easi_jax.model.parameter_proposal import own_space
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import Flag, GapResult, HeldOutErrors, Outcome
from easi_jax.pipeline.stages import seed_keys
from easi_jax.progress import Tell
from easi_jax.rl.config import EssInfoGailConfig
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.rl.presets import imitating, training_preset
from easi_jax.rl.seeds import train_seeds
from easi_jax.rl.trainer import make_trainer
from easi_jax.search.config import preset
from easi_jax.search.easi import Search
from easi_jax.simulation import engine as engines
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import env_identified

PathLike = str | os.PathLike[str]


def _silent(_: str) -> None:
    """Takes a line and shows nothing."""


def read_model(
    path: PathLike,
    allow: Sequence[PathLike] = (),
    held_base: bool | Sequence[float] = False,
) -> mujoco.MjModel:
    """Reads a MuJoCo model (MJCF or URDF) that something moves in.

    Args:
        path: of the file.
        allow: files or folders outside of its folder that it may read (meshes,
            textures, includes).
        held_base: whether the base was held while logs were recorded; its free joint
            is removed. Seven numbers say where (m, unit quaternion); True: the first
            key frame's pose, or else the model's.

    Raises:
        UserError: no such file, no valid model, or one without a joint.
    """

    def pose(m: mujoco.MjModel) -> np.ndarray:
        if isinstance(held_base, bool):
            return own_pose(m, base_joint(m))
        return checked_array("held_base", held_base, (7,))

    held = None if held_base is False else pose
    allowed = tuple(Path(p) for p in allow)
    return read_machine(Path(path), allowed, held=held, logged=True)


def read_parameters(path: PathLike, model: mujoco.MjModel) -> ParameterSpace:
    """Reads a parameter file (YAML): what may vary in ``model``, and in which range.

    Raises:
        UserError: as `easi_jax.io.models.parameter_file.read_parameter_file`.
    """
    return read_parameter_file(path, model)


def read_log(
    paths: PathLike | Sequence[PathLike],
    model: mujoco.MjModel,
    mapping: PathLike | None = None,
    unmeasured: Sequence[str] = (),
) -> Log:
    """Reads measured logs (CSV, NPZ, Parquet) of the machine that ``model`` describes.

    Args:
        paths: one file or several.
        model: names of joints, actuators and sensors.
        mapping: mapping file (YAML) for logs with foreign column names.
        unmeasured: joints without a sensor, by name or pattern; ``all``: whatever a
            log lacks.

    Returns:
        ``runs``, SI units, and ``notes`` on all that a user should know of them.

    Raises:
        UserError: a file that cannot be used.
    """
    return read_logs(paths, model, mapping, unmeasured)


@dataclass(frozen=True, eq=False)
class Searched:
    """What a search found.

    Attributes:
        space: the parameters; ``space.to_si`` takes unit coordinates to SI units.
        mean: unit coordinates, ``(n,)``.
        cov: unit coordinates, ``(n, n)``.
        history: mean after each generation, SI units, ``(generations, n)``.
        non_finite: simulations that were no longer finite, of all generations.
        notes: on the data, one line each.
    """

    space: ParameterSpace
    mean: np.ndarray
    cov: np.ndarray
    history: np.ndarray
    non_finite: int
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Estimated:
    """Parameters as the logs determine them.

    Attributes:
        names, units: of the parameters, ``n`` each.
        mean, std: SI units, ``(n,)``; where a flag is not ``determined``, hardly more
            than where the search started.
        flags: ``determined``, ``not determined`` or ``at bound``, ``n``.
        undetermined: combinations that the logs leave open, a sentence each.
        outcome: how the fit ended; ``reason`` names what it is about.
        no_region: why ``std`` means nothing, as the model lacks something unknown;
            empty where it holds.
        held_out: errors of predictions on data that no fit saw.
        notes: on data and fit, one line each.
        space: the parameters, ``distribution`` in its unit coordinates.
        distribution: that policies are trained under.
        simulator: the machine; ``effects``: those that it was given.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    std: np.ndarray
    flags: tuple[Flag, ...]
    undetermined: tuple[str, ...]
    outcome: Outcome
    reason: str
    no_region: str
    held_out: HeldOutErrors
    notes: tuple[str, ...]
    space: ParameterSpace
    distribution: Distribution
    simulator: Simulator
    effects: FoundEffects

    def __str__(self) -> str:
        """A line for each parameter, and one for each joint's held-out error."""
        e = self.held_out
        width = max(map(len, (*self.names, *e.channels)))
        lines = [
            f"{name:{width}}  "
            + with_unit(number(mean) if self.no_region else quantity(mean, std), unit)
            + (f"  ({flag})" if flag != "determined" else "")
            for name, mean, std, unit, flag in zip(
                *(self.names, self.mean, self.std, self.units, self.flags), strict=True
            )
        ]
        lines += [
            f"{name:{width}}  error over {e.horizon:.3g} s: {old:.3g} as given, "
            f"{new:.3g} identified, {floor:.3g} noise floor [{shown_unit(unit)}]"
            for name, unit, old, new, floor in zip(
                *(e.channels, e.units, e.before, e.after[0], e.floor[0]), strict=True
            )
        ]
        if self.outcome != "converged":
            lines.append(f"the fit: {self.outcome} ({self.reason})")
        return "\n".join(lines)


def search_parameters(
    model: mujoco.MjModel,
    parameters: ParameterSpace,
    log: Log,
    *,
    held_out: Log | None = None,
    effects: FoundEffects | None = None,
    generations: int | None = None,
    population: int | None = None,
    settings: str = "default",
    noise: Sequence[float] = (),
    horizon: float | None = None,
    seed: int = 0,
    engine: str = "auto",
) -> Searched:
    """EASI: the distribution of parameters under which simulation looks like the logs.

    Args:
        model: of the machine.
        parameters: what may vary in it.
        log: measured motion.
        held_out: kept out of the search; None: part of ``log`` is.
        effects: that the model gets (``find_effects(...).found``); their numbers join
            ``parameters``.
        generations, population: of the search; those of ``settings`` where None.
        settings: ``default``, or ``paper`` (the reference's recipe but for its
            controller, which logs come without).
        noise: standard deviations of positions, then velocities, ``(2 nv,)`` [m, rad,
            m/s, rad/s]; estimated from the logs where empty.
        horizon: longest piece of a log that is simulated [s]; 0.2 where None.
        seed: of the random numbers.
        engine: ``mjx``, ``mujoco``, or ``auto``, as the commands choose
            (`easi_jax.simulation.engine`).

    Raises:
        UserError: what is wrong with the data or the options; no simulation of a
            generation stayed finite.
    """
    with engines.chosen(engine) as said:
        problem = _problem(model, parameters, log, held_out, effects, noise, horizon)
        found = _searched(problem, generations, population, settings, seed)[1]
    return replace(found, notes=(*said, *found.notes))


def estimate_parameters(
    model: mujoco.MjModel,
    parameters: ParameterSpace,
    log: Log,
    *,
    held_out: Log | None = None,
    effects: FoundEffects | None = None,
    start: Searched | None = None,
    generations: int | None = None,
    population: int | None = None,
    settings: str = "default",
    noise: Sequence[float] = (),
    horizon: float | None = None,
    restarts: int = 0,
    seed: int = 0,
    engine: str = "auto",
    tell: Tell = _silent,
) -> Estimated:
    """Parameters and their uncertainty, by least squares from the end of a search.

    Args:
        model: of the machine.
        parameters: what may vary in it.
        log: measured motion.
        held_out: kept out of the fit, to test it on; None: part of ``log`` is.
        effects: as in `search_parameters`.
        start: of `search_parameters`; None: it is called first, with ``generations``,
            ``population``, ``settings`` and ``seed``.
        noise, horizon: as in `search_parameters`.
        restarts: more starts of the fit, drawn from the search's spread; the best fit
            counts.
        engine: as in `search_parameters`.
        tell: takes a line on how far it is.

    Raises:
        UserError: as `search_parameters`; ``start`` is of other parameters.
    """
    with engines.chosen(engine, tell) as said:
        given = model, parameters, log, held_out, effects, noise, horizon
        problem = _problem(*given)
        if start is None:
            searching = generations, population, settings, seed
            search, start = _searched(problem, *searching)
        else:
            search = _search(problem, 1, population, settings)
        found = _estimated(problem, search, start, effects, restarts, seed, tell)
    return replace(found, notes=(*said, *found.notes))


def _estimated(
    problem: Problem,
    search: Search,
    start: Searched,
    effects: FoundEffects | None,
    restarts: int,
    seed: int,
    tell: Tell,
) -> Estimated:
    if start.space.names != search.space.names:
        raise UserError(
            f"start is of {', '.join(start.space.names)}, parameters are "
            f"{', '.join(search.space.names)}: search with the same parameters"
        )
    estimates, notes = ready_finish(problem, search, True, restarts, tell)(
        jnp.asarray(start.mean)[None], jnp.asarray(start.cov)[None]
    )
    space = search.space
    (found,) = sound((seed,), estimates, space.names)[0].values()
    unit, result = found.distribution.mean, result_of(space, found)
    errors = held_out_errors(problem, space, [unit], ready_errors(problem, space))
    return Estimated(
        names=space.names,
        units=space.units,
        mean=np.array(result.mean),
        std=np.array(result.std),
        flags=tuple(result.flags),
        undetermined=tuple(u.meaning for u in result.undetermined),
        outcome=result.outcome,
        reason=result.reason,
        no_region=result.no_region,
        held_out=errors,
        notes=(*problem.notes, *notes(0), *errors.notes((seed,))),
        space=space,
        distribution=found.distribution,
        simulator=problem.simulator,
        effects=effects or FoundEffects(),
    )


def find_effects(
    model: mujoco.MjModel,
    log: Log,
    *,
    parameters: ParameterSpace | None = None,
    held_out: Log | None = None,
    horizon: float = HORIZON,
    own: Sequence[OwnEffect] = (),
    engine: str = "auto",
    tell: Tell = _silent,
) -> GapResult:
    """Which physical effects the model lacks, and where, judged on held-out data.

    Args:
        model: of the machine.
        log: measured motion.
        parameters: what may be refitted in the model; None: damping, friction and
            stiffness that it states, each within a factor of 5.
        held_out: kept out of every fit; None: part of ``log`` is.
        horizon: of the predictions that are compared [s].
        own: effects of your own, beside those that are known.
        engine: as in `search_parameters`.
        tell: takes a line on how far it is.

    Returns:
        ``verdict``, ``effects`` with their values and confidence, the gap ``before``,
        after a ``refit`` of the parameters and ``after`` all of it, and ``found``, the
        effects as `estimate_parameters` takes them.

    Raises:
        UserError: data too short, too still, or that the model does not cover; an
            effect of your own that cannot be believed.
    """
    with registered(own):
        check_own_effects(model)
        return _effects(model, log, parameters, held_out, horizon, engine, tell)


def _effects(
    model: mujoco.MjModel,
    log: Log,
    parameters: ParameterSpace | None,
    held_out: Log | None,
    horizon: float,
    engine: str,
    tell: Tell,
) -> GapResult:
    runs = measured_runs(model, log, held_out, checked_horizon(horizon))
    space = own_space(model) if parameters is None else parameters
    faults = reading_faults(model, runs.recorded)
    fit, held = (without_faults(part, faults) for part in (runs.fit, runs.held))
    given = model, space, fit, held, runs.noise, horizon
    with engines.chosen(engine, tell) as said:
        found = Analysis(*given, tell=tell).run()
    return gap_result(
        found,
        model=_name(model),
        readings=faults,
        held_out=[run.name for run in runs.held],
        held_name=runs.held_name,
        notes=[*said, *runs.notes, *coverage_notes(model, runs.fit, runs.held)],
    )


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy.

    Attributes:
        interface: names of what it reads and writes.
        params: a pytree of arrays, without a leading axis.
        action_map: from actions to commands; None where the environment names none.
        returns: of the evaluations during training, in the environment's own units,
            ``(evaluations,)``.
    """

    interface: Interface
    params: PolicyParams
    action_map: Any
    returns: np.ndarray

    def __call__(self, obs: Any) -> np.ndarray:
        """The action in [-1, 1], ``(..., action_size)``, for ``obs (..., obs_size)``.

        Raises:
            UserError: ``obs`` of another size, or not finite.
        """
        size, names = len(self.interface.observation), self.interface.observation
        lead = np.shape(obs)[:-1]
        given = checked_array("obs", obs, (*lead, size), ", ".join(names))
        return np.asarray(act(self.params, jnp.asarray(given), deterministic=True))


def train_policy(
    env: Any,
    estimated: Estimated | None = None,
    *,
    algorithm: str | None = None,
    env_steps: int | None = None,
    seed: int = 0,
    demonstrations: PathLike | None = None,
) -> Policy:
    """Trains a policy under randomized physics, as one compiled program.

    Args:
        env: a built-in robot (``envs.make``) or an environment of your own
            (``envs.load``), made for an engine.
        estimated: its distribution is drawn from, a sample an episode, with the
            effects that it was given; other parameters keep their nominal values.
            None: uniform over the environment's own ranges.
        algorithm: ``sac``, ``ppo``, or ``ess_infogail``, which imitates; the
            environment's own where None.
        env_steps: control steps of training; those of the preset where None.
        seed: of the random numbers.
        demonstrations: log of motion to imitate (docs/imitation.md).

    Raises:
        UserError: no such algorithm, or one that does not go with ``demonstrations``; a
            log that cannot be imitated; ``estimated`` is of another robot; the
            training did not stay finite.
    """
    config = training_preset(env, algorithm)
    if env_steps is not None:
        config = replace(config, env_steps=env_steps)
    if isinstance(config, EssInfoGailConfig) != (demonstrations is not None):
        raise UserError("demonstrations and algorithm ess_infogail go together")
    if isinstance(config, EssInfoGailConfig) and demonstrations is not None:
        config = imitating(config, env, Path(demonstrations))
    if estimated is None:
        dist = distribution.uniform(env.space, *env.space.initial)
    else:
        dist, fixed = estimated.distribution, estimated.simulator.fixed
        env = env_identified(env, estimated.space, estimated.mean, fixed)
    space = env.space
    trainer = make_trainer(env, config, env.model, partial(distribution.draw, space))
    middle = distribution.point(space, space.nominal)
    keys = seed_keys([seed])
    train = jax.jit(lambda keys: train_seeds(trainer, keys, dist, middle))
    states, info = train(keys)
    policy = jax.tree.map(lambda x: x[0], jax.vmap(trainer.policy)(states))
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(policy)):
        raise UserError("the training did not stay finite: try another seed")
    returns = np.asarray(info["eval_return"])[0]
    return Policy(
        interface_of(env),
        jax.device_get(policy),
        getattr(env, "action_map", None),
        returns[np.isfinite(returns)],
    )


def export_policy(
    policy: Policy, folder: PathLike, to: Sequence[str] = ("onnx", "stablehlo")
) -> list[Path]:
    """Writes a policy for programs that have not this package.

    Args:
        policy: of `train_policy`.
        folder: made where it is missing.
        to: ``onnx`` (needs the extra ``export``), ``stablehlo``.

    Returns:
        The files: ``policy.json`` (what it reads and writes), ``policy.onnx``,
        ``policy.stablehlo`` and ``policy.mlir``.

    Raises:
        UserError: an unknown form, a missing package, a folder that cannot be written.
    """
    files = policy_files(policy.params, policy.interface, policy.action_map, to)
    return _written(folder, files)


def export_model(
    estimated: Estimated, source: PathLike, folder: PathLike
) -> list[Path]:
    """Writes ``model.xml``, the model with the estimated values, and its assets.

    Args:
        estimated: of `estimate_parameters`.
        source: the file that the model was read from.
        folder: made where it is missing.

    Raises:
        UserError: ``source`` is of another model; a folder that cannot be written.
    """
    e, machine = estimated, estimated.simulator
    values = dict(zip(e.names, e.mean.tolist(), strict=True))
    given = Path(source), machine.mj_model, machine.dt
    model = written_machine(*given, e.space.parameters, values, e.effects)
    return _written(folder, model.files())


def _written(folder: PathLike, files: dict[str, Any]) -> list[Path]:
    places = [Path(folder) / name for name in files]
    for place, content in zip(places, files.values(), strict=True):
        atomic_write(place, content)
    return places


def _problem(
    model: mujoco.MjModel,
    parameters: ParameterSpace,
    log: Log,
    held_out: Log | None,
    effects: FoundEffects | None,
    noise: Sequence[float],
    horizon: float | None,
) -> Problem:
    runs = measured_runs(model, log, held_out, checked_horizon(horizon))
    given = {"found": effects, "noise": noise, "horizon": horizon}
    return problem_of(_name(model), model, parameters, runs, **given)


def _name(model: mujoco.MjModel) -> str:
    """Its own, the first of all names in it."""
    return model.names.split(b"\0", 1)[0].decode() or "the model"


def _search(
    problem: Problem, generations: int | None, population: int | None, settings: str
) -> Search:
    given = {"generations": generations, "population": population}
    chosen = preset(settings, **{k: v for k, v in given.items() if v is not None})
    return Search(problem.simulator, replayed(problem, chosen))


def _searched(
    problem: Problem,
    generations: int | None,
    population: int | None,
    settings: str,
    seed: int,
) -> tuple[Search, Searched]:
    search = _search(problem, generations, population, settings)
    data = search_data(problem)

    def whole(key: jax.Array) -> Any:
        state = search.init(key, data)
        state, info = search.run(state, data, search.config.generations)
        return state.result_mean, state.result_cov, info

    run = jax.jit(whole, compiler_options=fast_loops() | quick_compile())
    mean, cov, info = jax.device_get(run(seed_keys([seed])[0]))
    lost = info.non_finite >= search.config.population
    if lost.any():
        raise UserError(
            f"generation {int(np.argmax(lost)) + 1}: all "
            f"{search.config.population} simulations became non-finite (narrow initial "
            "or bounds, or lower the model's timestep)"
        )
    return search, Searched(
        search.space,
        mean,
        cov,
        np.asarray(search.space.to_si(info.mean)),
        int(info.non_finite.sum()),
        tuple(problem.notes),
    )

"""Identifies a robot that walks under its own controller; what ``train.easi --data LOG
--policy RUN`` does."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from train._command import say
from train._effects import found_in, read_given
from train._inputs import files_of
from train._stand import known_from_stand, stand_problem

if TYPE_CHECKING:
    from easi_jax.estimation.problem import Problem
    from easi_jax.estimation.unpaired_runs import UnpairedProblem

COMMANDS = "commands"  # for --policy: send what the log was sent


def run(config: Any) -> None:
    """Reads, searches, fits and reports; ``config`` is that of ``train.easi``."""
    _check_options(config)
    problem, settings, robot = read_problem(config)
    stand = stand_problem(config, problem.env) if config.stand else None
    seeds = config.seeds or (0,)
    import jax

    from easi_jax.estimation.unpaired_runs import check_commands
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import seed_keys
    from easi_jax.search.unpaired import Simulations
    from train._from_logs import searched, show

    search, data = problem.search(settings), problem.data()
    simulated = Simulations(search, data)
    keys = [jax.random.fold_in(k, 1) for k in seed_keys(list(seeds))]
    check_commands(problem, search, simulated, keys[0])
    with RunFolder.open(
        config.out,
        {**read_given(config).recorded(config), **robot},
        command="train.easi",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        states = searched(folder, config, search, data, problem.notes, seeds)
        given = problem, simulated, stand
        report = _finished(folder, config, *given, states, seeds, keys)
    show(problem.name, report, config.out)


def _check_options(config: Any) -> None:
    from easi_jax.errors import UserError

    for flag, given in (
        ("--horizon", config.horizon is not None),
        ("--held-base", config.held_base),
        ("--restarts", config.restarts is not None),
    ):
        if given:
            raise UserError(
                f"{flag} goes without --policy: where a robot is simulated under its "
                "controller, no piece starts at a row of the log"
            )
    if config.stand and not config.refine:
        raise UserError("--stand goes without --no-refine: the fit has use for it")


# -- what is asked -------------------------------------------------------------------


def read_problem(config: Any) -> "tuple[UnpairedProblem, Any, dict[str, Any]]":
    """Reads and checks everything; nothing is written yet. The search's settings, and
    what says which robot it is, too.

    Raises:
        UserError: whatever is wrong with the files or the options.
    """
    from easi_jax.errors import UserError
    from easi_jax.estimation.problem import HORIZON
    from easi_jax.estimation.unpaired_runs import (
        at_control_step,
        command_step,
        unpaired_problem,
    )
    from easi_jax.simulation.sent_commands import SentCommands
    from easi_jax.simulation.simulator import Simulator
    from train._log_problem import read_runs
    from train._robots import chosen_search

    sends = config.policy == COMMANDS
    if sends:
        env, policy, robot = *_machine(config), {}
    else:
        env, policy, robot = _controlled(config)
    given = dataclasses.replace(config, unmeasured=_unmeasured(config, env.mj_model))
    runs = _true(read_runs(given, env.mj_model, HORIZON), env.mj_model, config)
    # Compared is what sensors read.
    unseen = {"observation_inputs": False, "stale_first_observation": False}
    source = {"source": "policy", "innovation_inputs": False}
    settings = chosen_search(config, env.name, **source, **unseen)
    if settings.policy_updates_per_generation or settings.source != "policy":
        raise UserError(
            "no policy is trained from logs: leave source and "
            "policy_updates_per_generation alone with --data"
        )
    if config.stand and not settings.finish:
        raise UserError("--stand goes with a fit after the search: --set finish=true")
    if sends:
        name, mj_model, space, fixed = env.name, env.mj_model, env.space, env.fixed
        step = command_step(max(runs.fit, key=len))
        simulator = Simulator(mj_model, space, step, fixed=fixed)
        rows = at_control_step(runs.fit, simulator.dt)
        env = SentCommands(name, simulator, rows, settings.rollout_steps)
    observed = dict(_observed(text) for text in config.observed)
    given = observed, config.sampled, config.noise
    problem = unpaired_problem(env, policy, runs, settings.rollout_steps, *given)
    return problem, settings, robot


def _true(runs: Any, m: Any, config: Any) -> Any:
    """Runs rid of what ``--effects`` says of the readings of joints."""
    from easi_jax.data.cleaning import true_readings

    entries = found_in(read_given(config).effects, str(config.effects)).entries
    told = [
        f"{e.effect}@{e.at}: taken out of the logs' readings"
        for e in entries
        if e.of_readings
    ]
    fit, held = (true_readings(m, r, entries) for r in (runs.fit, runs.held))
    return dataclasses.replace(runs, fit=fit, held=held, notes=[*runs.notes, *told])


@dataclasses.dataclass(frozen=True)
class _Machine:
    """A machine without a task."""

    name: str
    mj_model: Any
    space: Any
    fixed: dict[str, float]


def _machine(config: Any) -> tuple[Any, None]:
    from easi_jax.errors import UserError
    from easi_jax.model.found_effects import joined
    from train._log_problem import model_and_space

    for flag in ("observed", "sampled", "policy_seed", "env"):
        if getattr(config, flag) not in (None, False, ()):
            raise UserError(
                f"--{flag.replace('_', '-')} goes with a policy, and --policy "
                f"{COMMANDS} has none"
            )
    name, mj_model, space = model_and_space(config)
    found = found_in(read_given(config).effects, str(config.effects))
    space, fixed = joined(mj_model, space, found)
    if config.start is not None:
        space = space.scaled(*config.start)
    return _Machine(name, mj_model, space, fixed), None


def _controlled(config: Any) -> tuple[Any, Any, dict[str, Any]]:
    """The robot, with the parameters and effects that are searched, its policy, and
    its name and options."""
    from easi_jax.errors import UserError
    from easi_jax.io.models.parameter_file import read_parameter_file
    from easi_jax.simulation.with_effects import env_with_space

    path = Path(config.policy)
    if config.model is not None and not config.stand:
        raise UserError(
            "--model goes with --policy commands: a policy brings its robot, or give "
            "it with --robot or --env"
        )
    opened = _of_file if path.suffix == ".onnx" else _of_run
    env, policy, option = opened(config, path)
    space = env.space
    if config.parameters is not None:
        own = read_parameter_file(config.parameters, env.mj_model)
        known = {a for p in own.parameters for a in p.addresses}
        more = [p for p in space.parameters if p.addresses[0].startswith("effect.")]
        rest = [p for p in more if not known & set(p.addresses)]
        space = dataclasses.replace(own, parameters=(*own.parameters, *rest))
    if config.start is not None:
        space = space.scaled(*config.start)
    out = env_with_space(env, space)
    return out, policy, {"robot": env.name, "option": option}


def _of_run(config: Any, path: Path) -> tuple[Any, Any, Sequence[str]]:
    import jax

    from easi_jax.errors import UserError
    from train._robots import load_policies

    if config.robot is not None:
        raise UserError("--robot goes without --policy RUN: a run knows its robot")
    known = load_policies(path, None, config.env, read_given(config))
    seeds = list(known["seeds"])
    seed = seeds[0] if config.policy_seed is None else config.policy_seed
    if seed not in seeds:
        raise UserError(f"{path} has no policy of seed {seed}: it holds seeds {seeds}")
    at = seeds.index(seed)
    policy = jax.tree.map(lambda x: x[at], known["policies"])
    return known["env"], policy, known["option"]


def _of_file(config: Any, path: Path) -> tuple[Any, Any, Sequence[str]]:
    from easi_jax.errors import UserError
    from easi_jax.export.policy import from_onnx, interface_of
    from easi_jax.io.files import read_bytes
    from envs import open_env
    from train._effects import robots

    if config.policy_seed is not None or config.sampled:
        raise UserError(
            f"{path} holds one policy, and of that the mode: leave --policy-seed and "
            "--sampled out"
        )
    policy, told = from_onnx(read_bytes(path), str(path))
    env = open_env(config.robot or told.robot, config.env)
    env = robots(env, read_given(config))[0]
    mine = interface_of(env)
    for what in ("observation", "action", "dt"):
        if getattr(mine, what) != getattr(told, what):
            word = "control step" if what == "dt" else what
            raise UserError(
                f"{path} is a policy of {told.robot} whose {word} is another than that "
                f"of {env.name}: give its robot with --robot or --env"
            )
    return env, policy, ()


def _unmeasured(config: Any, m: Any) -> tuple[str, ...]:
    """Joints that are not read: bases, too, since nothing starts where they were."""
    from easi_jax.model.joint_space import given_name, is_free

    bases = [given_name(m, j) for j in range(m.njnt) if is_free(m, j)]
    return (*config.unmeasured, *(name for name in bases if name))


def _observed(text: str) -> tuple[str, float]:
    import math

    from easi_jax.errors import UserError

    name, sign, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not sign or not math.isfinite(number):
        raise UserError(
            f"--observed {text}: write NAME=NUMBER, such as command.forward=1.4"
        )
    return name, number


# -- what is found -------------------------------------------------------------------


def _finished(
    folder: Any,
    config: Any,
    problem: "UnpairedProblem",
    simulated: Any,
    stand: "Problem | None",
    states: Any,
    seeds: Sequence[int],
    keys: Sequence[Any],
) -> Any:
    """The fit of each seed, and the report."""
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.estimation.emulator import NOTHING
    from easi_jax.estimation.unpaired_results import found_of, held_out_errors
    from train._log_results import write_found

    search, pieces = simulated.search, problem.pieces(problem.fit)
    known, refines = [NOTHING] * len(seeds), config.refine and search.config.finish
    if stand is not None:
        n = slice(stand.simulator.space.size)
        ends = states.result_mean[:, n], states.result_cov[:, n, n]
        log_scale = search.config.log_scale
        known = known_from_stand(stand, log_scale, *ends, problem.notes)
    found = {}
    for k, seed in enumerate(seeds):
        end = states.result_mean[k], states.result_cov[k]
        given = simulated, pieces, *end, keys[k], refines, say
        found[seed] = found_of(*given, known[k])
    good = {s: f for s, f in found.items() if np.isfinite(f.mean).all()}
    lost = {s: "too few simulations stay on their feet" for s in seeds if s not in good}
    if not good:
        raise UserError(
            "too few simulations near where the search ended stay finite and on their "
            "feet: narrow the initial ranges, or try another seed"
        )
    errors = held_out_errors(problem, simulated, list(good.values()), keys[0])
    best = list(good.values())[errors.best]
    problem.notes.extend(best.notes(search))
    noise = dict(zip(problem.of.names, problem.noise.tolist(), strict=True))
    return write_found(
        *(folder, problem.name, best.space(search), search.config.generations),
        *([f.result(search) for f in good.values()], list(good), errors, lost),
        *(problem.notes, noise, "--data ... --policy ..."),
        readings=best.readings(search),
    )

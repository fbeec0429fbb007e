"""Logs of a robot's joints in a stand, beside those of its walk; ``--stand``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from easi_jax.estimation.emulator import Known
    from easi_jax.estimation.problem import Problem


def stand_problem(config: Any, env: Any) -> "Problem":
    """The same parameters, in the robot held in its stand.

    Raises:
        UserError: no file of the robot's model, or whatever is wrong with the logs.
    """
    from easi_jax.data.measured import measured_runs
    from easi_jax.errors import UserError
    from easi_jax.estimation.problem import HORIZON, problem_of
    from easi_jax.io.logs.reader import read_logs
    from easi_jax.model.found_effects import FoundEffects
    from envs import REGISTRY
    from envs.robot import model_file
    from train._log_problem import load_model

    path = config.model
    if path is None:
        if env.name not in REGISTRY:
            raise UserError(
                "--stand needs the file of the robot's model, whose base it holds: "
                "give --model M.xml"
            )
        path = model_file(env.name)
    held = (config.stand, config.mapping)
    m = load_model(Path(path), config.allow_assets, held, True)
    logs = read_logs(list(config.stand), m, config.mapping, config.unmeasured)
    runs = measured_runs(m, logs, None, HORIZON)
    found = FoundEffects((), env.simulator.fixed)
    return problem_of(f"{env.name} in a stand", m, env.space, runs, found=found)


def known_from_stand(
    problem: "Problem", log_scale: bool, means: Any, covs: Any, notes: list[str]
) -> "list[Known]":
    """What logs in a stand say of the parameters, by least squares from where the
    search of each seed has ended.

    Args:
        problem: of `stand_problem`.
        log_scale: of the search, as `easi_jax.search.config.SearchConfig` has it.
        means, covs: its ends, unit coordinates, ``(S, n)``, ``(S, n, n)``.
        notes: gets what the user should know.

    Raises:
        UserError: a fit diverged.
    """
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.estimation.emulator import Known
    from easi_jax.estimation.from_runs import ready_finish, replayed
    from easi_jax.estimation.posterior import diverged
    from easi_jax.model.distribution import covariance
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search
    from train._command import say

    settings = replayed(problem, preset("default", log_scale=log_scale))
    search = Search(problem.simulator, settings)
    finish = ready_finish(problem, search, tell=lambda text: say(f"stand: {text}"))
    estimates, notes_of = finish(means, covs)
    known = []
    for found in estimates:
        why = diverged(found, search.space.names)
        if why:
            raise UserError(f"the fit to the logs in a stand diverged: {why}")
        center = np.asarray(found.distribution.mean, float)
        information = np.linalg.inv(covariance(found.distribution))
        known.append(Known(center, information))
    notes += [f"in the stand: {text}" for text in (*problem.notes, *notes_of(0))]
    return known

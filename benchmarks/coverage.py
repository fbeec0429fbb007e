"""Whether the spread that a search returns means what it says.

    python -m benchmarks.coverage

Many Cartpoles, each with parameters drawn from UDR's range, are recorded with realistic
sensor noise under a rough controller; the search (`default`) and its least-squares
finish say where the parameters are, and how sure they are. Counted is how often the
truth lies inside the 50 % and the 90 % regions along the directions that the data
determine, and how large the error is beside the Cramer-Rao bound of the same data. One
line a target is added to ``coverage.jsonl``; a run that was stopped goes on, and
several share the work by ``--shard`` (the second of four is 2/4).

With ``--late`` the targets' commands come late, which the model knows nothing of. The
finish is then made with doubts (`easi_jax.estimation.doubts`), as that of measured logs
is, and what it says of the parameters has to hold. Lines are in
``coverage_late.jsonl``. ``--doubts`` shows what doubts cost where commands come in
time. With ``--logs`` the demonstrations are written down as logs, and search and finish
are those of ``train.easi --data``; lines are in ``coverage_logs.jsonl``.
"""

import copy
import dataclasses
import time
from pathlib import Path
from typing import Any

from benchmarks._cells import add_row, check_out, read_rows, shard
from benchmarks._common import RESULTS
from benchmarks.recovery import NOISE, WEIGHED, controller
from train._command import main, progress, say

WAYS: tuple[str, ...] = ("search, own spread", "search", "refined")


@dataclasses.dataclass(frozen=True)
class Config:
    """Searches for many synthetic targets and counts what their regions cover."""

    targets: int = 100
    """Synthetic targets, one seed each."""
    trajectories: int = 50
    """Demonstration trajectories of each: 200 s."""
    generations: int = 50
    """Generations of each search."""
    late: float = 0.0
    """How late the targets' commands come [s]; fitted with doubts, as measured logs."""
    doubts: bool = False
    """Fit with doubts where commands come in time, too."""
    logs: bool = False
    """Search and fit as train.easi --data does, from logs."""
    shard: str = "1/1"
    """Which part of the targets this process runs."""
    out: Path | None = None
    """Where a line for each target is added; coverage.jsonl of the results,
    coverage_late.jsonl, coverage_doubts.jsonl or coverage_logs.jsonl where not
    given."""


def run(config: Config) -> None:
    """Runs the targets that are not there yet."""
    from benchmarks._common import at_least_one, command_of
    from easi_jax.errors import UserError
    from easi_jax.io.runs.versions import versions

    at_least_one(config, "targets", "trajectories", "generations")
    if not 0 <= config.late < 1:
        raise UserError(f"--late {config.late}: seconds, 0 or more and below 1")
    part, parts = shard(config.shard)
    kinds = {"_logs": config.logs, "_late": config.late > 0, "_doubts": config.doubts}
    kind = next((name for name, on in kinds.items() if on), "")
    out = config.out or RESULTS / f"coverage{kind}.jsonl"
    mine = list(range(config.targets))[part - 1 :: parts]
    rows = read_rows(out, ("seed",))
    alike = (r for r in rows if r.get("late", 0.0) == config.late)
    done = {row["seed"] for row in alike}
    seeds = [s for s in mine if s not in done]
    if not seeds:
        return say(f"all {len(mine)} targets are in {out}")
    check_out(out)
    solve = _solver(config)
    given = {"command": command_of("benchmarks.coverage", config)}
    given |= {"versions": versions(), "late": config.late}
    with progress("coverage", len(mine), len(mine) - len(seeds)) as shown:
        for seed in seeds:
            begun = time.monotonic()
            row = {"seed": seed, **solve(seed), **given}
            row["seconds"] = time.monotonic() - begun  # the first one's compile, too
            add_row(out, row)
            shown.advance(1, refined=row["refined"]["distance"] / max(row["rank"], 1))
    say(f"written: {out}")


def _solver(config: Config) -> Any:
    import functools

    import jax
    import jax.numpy as jnp

    from easi_jax.data.segments import windows
    from easi_jax.devices.runtime import fast_loops
    from easi_jax.estimation.doubts import doubts_of
    from easi_jax.estimation.normal_equations import PairedFit
    from easi_jax.estimation.pieces import finish_pieces
    from easi_jax.estimation.posterior import RESTARTS, errs_by, estimate
    from easi_jax.search.config import preset
    from easi_jax.search.easi import Search, SearchData
    from easi_jax.simulation.simulator import Simulator
    from envs import make

    env = make("cartpole")
    space = env.space.select([n for n in env.space.names if n not in WEIGHED])
    simulator = Simulator(env.mj_model, space, env.dt)
    real = copy.copy(env)
    real.simulator, real.space = simulator, space
    if config.late > 0:
        real.simulator = simulator.rebuilt(fixed={"effect.delay.cart": config.late})
    search = Search(
        simulator, preset("default", generations=config.generations, horizon=8)
    )
    noise = jnp.asarray(NOISE)
    doubted = config.late > 0 or config.doubts
    doubts = doubts_of(simulator, space) if doubted else None

    recorded = jax.jit(functools.partial(_recorded, real, config.trajectories))

    @functools.partial(jax.jit, compiler_options=fast_loops())
    def find(key: jax.Array, demos: Any) -> Any:
        data = SearchData(windows(demos, 8, 4), noise, ())
        state, info = search.run(search.init(key, data), data, config.generations)
        return state.result_mean, state.result_cov, info.non_finite.sum()

    @jax.jit
    def known(demos: Any, truth: jax.Array) -> jax.Array:
        pieces = finish_pieces(simulator, demos)
        return PairedFit(simulator, space, pieces, noise).information(truth)

    @jax.jit
    def judge(demos: Any, mean: jax.Array, cov: jax.Array) -> Any:
        pieces = finish_pieces(doubts.simulator if doubts else simulator, demos)
        fit = PairedFit(simulator, space, pieces, noise)
        found = [
            estimate(
                *(fit, mean, cov, *how),
                restarts=RESTARTS,
                adjusted=True,
                doubts=doubts,
            )
            for how in ((False, False), (False, True), (True, True))
        ]
        return [e.distribution for e in found], errs_by(found[-1])

    def solve(seed: int) -> dict[str, Any]:
        k_truth, k_rest = jax.random.split(jax.random.key(seed))
        truth = jax.random.uniform(k_truth, (space.size,))
        k_data, k_search = jax.random.split(k_rest)
        demos = recorded(k_data, truth)
        bound = known(demos, truth)
        if config.logs:
            found = _from_logs(env.mj_model, space, demos, env.dt, config.generations)
            ended = {WAYS[-1]: found.distribution}
            row = _row(space, truth, ended, bound)
            return {**row, "no_region": found.no_region}
        mean, cov, lost = find(k_search, demos)
        found, times = judge(demos, mean, cov)
        ended = dict(zip(WAYS, found, strict=True))
        row = _row(space, truth, ended, bound)
        return {**row, "times_noise": float(times), "non_finite": int(lost)}

    return solve


def _recorded(real: Any, trajectories: int, key: Any, truth: Any) -> Any:
    """Demonstrations of a machine with parameters ``truth (n,)``, read with noise."""
    import jax
    import jax.numpy as jnp

    from easi_jax.simulation.rollout import collect, measured

    k_run, k_noise = jax.random.split(key)
    model = real.simulator.model(real.space.to_si(truth))
    length, shape = real.episode_length, real.simulator.configuration
    runs = collect(real, model, controller, k_run, trajectories, length)
    return measured(runs, jnp.asarray(NOISE), k_noise, shape)


def _from_logs(model: Any, space: Any, demos: Any, dt: float, generations: int) -> Any:
    """What the library says of demonstrations ``(B, T, 1, ...)`` as logs; the last one
    of half the length of the longest, at least, is held out."""
    import jax
    import numpy as np

    from easi_jax.api import estimate_parameters
    from easi_jax.data.recording import Log, Run
    from easi_jax.model.joint_space import Configuration

    def whole(first: Any, following: Any) -> Any:
        return np.concatenate([first[:1], following[:, 0]]).astype(float)

    runs = []
    for k in range(len(demos.qpos)):
        one = jax.tree.map(lambda x, k=k: np.asarray(x[k]), demos)
        end = np.count_nonzero(one.weight)  # of the episode
        qpos = whole(one.qpos[:end], one.next_qpos[:end])
        qvel = whole(one.qvel[:end], one.next_qvel[:end])
        ctrl = np.concatenate([one.ctrl[:end, 0], one.ctrl[end - 1 : end, 0]])
        runs.append(
            Run(
                name=f"run{k}",
                source=f"run{k}",
                dt=dt,
                time=dt * np.arange(len(qpos)),
                qpos=qpos,
                qvel=qvel,
                qvel_measured=True,
                ctrl=ctrl.astype(float),
                configuration=Configuration.of(model),
            )
        )
    longest = max(map(len, runs))
    kept = max(k for k, run in enumerate(runs) if 2 * len(run) >= longest)
    log = Log((*runs[:kept], *runs[kept + 1 :]), ())
    held = Log((runs[kept],), ())
    return estimate_parameters(
        model, space, log, held_out=held, generations=generations
    )


def _row(space: Any, truth: Any, found: dict[str, Any], bound: Any) -> dict[str, Any]:
    """What was ``found`` of a target, a distribution for each of the `WAYS`, beside the
    ``truth (n,)`` and its information ``bound (n, n)``, unit coordinates."""
    import numpy as np

    from easi_jax.estimation.identifiability import identifiability
    from easi_jax.model import distribution

    known = identifiability(space, np.asarray(bound))
    row: dict[str, Any] = {
        "truth": np.asarray(space.to_si(truth), float).tolist(),
        "rank": known.rank,
        "determined": known.determined.tolist(),
    }
    for way, d in found.items():
        off = (np.asarray(d.mean, float) - np.asarray(truth, float)) * known.scale
        spread = distribution.covariance(d)
        cov_log = spread * np.outer(known.scale, known.scale)
        row[way] = {
            "off": off.tolist(),
            "std": np.sqrt(np.diag(cov_log)).tolist(),
            **distances(off, cov_log, known),
        }
    return row


def distances(off: Any, cov: Any, known: Any) -> dict[str, float]:
    """Squared Mahalanobis distances of an error along the determined directions.

    Args:
        off: errors in log ratios, ``(n,)``.
        cov: covariance that was stated, ``(n, n)``.
        known: `easi_jax.estimation.normal_equations.Identifiability` at the truth.

    Returns:
        ``distance`` in the stated covariance, ``bound`` in that of Cramer and Rao;
        chi-squared with ``known.rank`` degrees of freedom where they are right.
    """
    import numpy as np

    whole = np.linalg.svd(known.null, full_matrices=True)[0]
    seen = whole[:, known.null.shape[1] :]  # basis of the determined directions
    d = seen.T @ off
    least = known.covariance * np.outer(known.scale, known.scale)
    return {
        "distance": float(d @ np.linalg.solve(seen.T @ cov @ seen, d)),
        "bound": float(d @ np.linalg.solve(seen.T @ least @ seen, d)),
    }


if __name__ == "__main__":
    main(Config, run, name="benchmarks.coverage")

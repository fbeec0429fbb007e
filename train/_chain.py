"""The chain behind ``train.easi``, in chunks, and ``train.pipeline``, in one piece."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from train._command import say, show_table
from train._effects import Given, robots, target_name
from train._robots import chosen_search, save_policies, target_of, training_chunk
from train._stages import (
    as_read_back,
    found_check,
    jit_chunks,
    run_stage,
    search_check,
    search_rows,
    training_rows,
)

if TYPE_CHECKING:
    import numpy as np

    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model.results import Curve
    from easi_jax.pipeline.stages import Pipeline


@dataclass(frozen=True)
class Setup:
    """A chain that is ready to run.

    Attributes:
        pipe: its stages.
        seeds: one chain each.
        given: effects of the robots.
        changes: of the real robot, as given.
        theta: parameters of the real robot, SI.
        option: of the built-in robot.
    """

    pipe: "Pipeline"
    seeds: tuple[int, ...]
    given: Given
    changes: tuple[str, ...]
    theta: "np.ndarray"
    option: tuple[str, ...]


def ready(
    config: Any,
    env: Any,
    given: Given,
    training: Any,
    seeds: tuple[int, ...],
    option: tuple[str, ...] = (),
    horizon: float | None = None,
) -> Setup:
    """The chain that a command's options describe.

    Args:
        config: with `SearchOptions`, `ChainOptions` and `TargetOptions`.
        env: the robot, its effects left out.
        horizon: of a measured piece [s].

    Raises:
        UserError: options that do not go together, or with the robot.
    """
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, target_parameters

    env, real = robots(env, given)
    changes = target_of(env, config.target, given)
    theta = target_parameters((real or env).space, changes)
    steps = steps_of(horizon, env.dt, any(x > 0 for x in config.noise))
    horizon_steps = steps if config.preset != "paper" else None
    search = chosen_search(config, env.name, horizon=horizon_steps)
    settings = PipelineConfig(
        search=search,
        training=training,
        trajectories=config.trajectories,
        noise=config.noise,
        refine=config.refine,
        restarts=config.restarts,
        warm_start=config.warm_start,
        eval_episodes=config.eval_episodes,
    )
    pipe = Pipeline(env, settings, start=config.start, real=real)
    return Setup(pipe, seeds, given, tuple(changes), theta, tuple(option))


def steps_of(horizon: float | None, dt: float, noisy: bool) -> int:
    """Control steps of a measured piece: one for clean data, 0.16 s for noisy data.

    Over a longer piece the motion grows and the noise does not.
    """
    from easi_jax.errors import UserError

    if horizon is None:
        return max(1, round(0.16 / dt)) if noisy else 1
    if not 0 < horizon <= 5:
        raise UserError(f"--horizon is {horizon}: give seconds above 0, at most 5")
    return max(1, round(horizon / dt))


class Chunked:
    """Stages in chunks, with progress, metrics, checkpoints and resume; a `Runner`.

    Args:
        chunk, search_chunk: steps between checkpoints, as given.
        notes: where remarks of a resume are added.
    """

    def __init__(
        self,
        setup: Setup,
        folder: "RunFolder",
        chunk: int | None,
        search_chunk: int,
        notes: list[str],
    ) -> None:
        self._setup, self._folder, self._notes = setup, folder, notes
        self._training_chunk = training_chunk(chunk, setup.pipe.trainer.config)
        self._search_chunk = search_chunk
        self._compiled: dict[Any, Any] = {}
        self._begun = set[Any]()

    def stage(
        self, name: str, total: int, init: Any, step: Any, *args: Any
    ) -> tuple[Any, None]:
        """As `Runner.stage`; what was told is in the run's metrics."""
        from easi_jax.devices.runtime import fast_loops
        from easi_jax.simulation.compile_time import expected

        pipe, seeds = self._setup.pipe, self._setup.seeds
        if name == "search":
            names, population = pipe.env.space.names, pipe.config.search.population
            chunk, per_step, options = self._search_chunk, 1, fast_loops()
            rows = search_rows(seeds, names, pipe.space.to_si)
            check = search_check(seeds, names, population)
        else:
            per_step = pipe.trainer.config.steps_per_iteration
            chunk, options, check = self._training_chunk, None, None
            rows = training_rows(seeds, per_step)
        # Stages of one step function share what is compiled for it.
        if step not in self._compiled:
            self._compiled[step] = jit_chunks(step, options)
        advance = self._compiled[step]
        state = run_stage(
            self._folder,
            name,
            total,
            chunk,
            init,
            lambda s, n: advance(s, *args, n),
            rows,
            self._notes,
            check,
            per_step,
            None if step in self._begun else expected(pipe.simulator),
        )
        self._begun.add(step)
        return state, None

    def kept(self, name: str, fun: Callable[..., Any], *args: Any) -> Any:
        """As `Runner.kept`: a checkpoint, once it is checked."""
        import jax

        from easi_jax.devices import distributed
        from easi_jax.io.runs import checkpoints

        folder, setup = self._folder, self._setup
        place = folder.checkpoints / name
        found = checkpoints.restore(
            place, jax.eval_shape(fun, *args), config_hash=folder.config_hash
        )
        if found is not None:
            return found.state
        refined = setup.pipe.config.finishes
        say(
            "least squares on the paired data ..."
            if refined
            else "Fisher information ..."
        )
        result = as_read_back(distributed.local(jax.jit(fun)(*args)))
        found_check(setup.seeds, setup.pipe.env.space.names, result)
        checkpoints.save(place, 1, result, config_hash=folder.config_hash)
        return result

    def call(self, fun: Callable[..., Any], *args: Any) -> Any:
        """As `Runner.call`, compiled."""
        import jax

        if fun not in self._compiled:
            self._compiled[fun] = jax.jit(fun)
        return self._compiled[fun](*args)


def write_and_show(
    folder: "RunFolder",
    command: str,
    setup: Setup,
    out: dict[str, Any],
    methods: dict[str, str],
    curves: "dict[str, Curve]",
    notes: Sequence[str],
) -> None:
    """Writes policies, results and report, and shows the tables.

    Args:
        out: what `Pipeline.chain` returned.
        methods: policies of it to their names, the first first.
        curves: trainings by method, where they are known.
    """
    import numpy as np

    from easi_jax.devices import distributed
    from easi_jax.io.report.easi_report import return_table
    from easi_jax.io.report.parameters import parameter_table
    from easi_jax.model.results import Transfer
    from easi_jax.pipeline.held_out import held_out_shares
    from easi_jax.pipeline.stages import seed_keys, stage_keys
    from train._results import lost_simulations, write_transfer

    pipe, seeds, given = setup.pipe, setup.seeds, setup.given
    for policy, method in methods.items():
        save_policies(folder, method, out[policy])
    returns = {
        method: np.asarray(distributed.local(out[f"{policy}_returns"])).mean(1)
        for policy, method in methods.items()
    }
    keys = stage_keys(seed_keys(list(seeds)))["evaluate"]
    transfer = Transfer(
        robot=pipe.env.name,
        returns=returns,
        episodes=pipe.config.eval_episodes,
        curves=curves,
        held_out=held_out_shares(pipe, out["estimate"], setup.theta, out["udr"], keys),
        non_finite=lost_simulations(folder),
    )
    rows, unseen = write_transfer(
        folder,
        command,
        pipe,
        out["estimate"],
        setup.theta,
        seeds,
        transfer,
        np.asarray(distributed.local(out["motion"]))[0],
        notes,
        {"option": setup.option, **given.results()},
    )
    table = return_table(seeds, returns, transfer.episodes)
    title = f"{table.title} ({target_name(setup.changes, given)})"
    show_table(title, table.columns, table.rows)
    show_table("Parameters (first seed)", *parameter_table(rows))
    for note in unseen:
        say(f"note: {note}")

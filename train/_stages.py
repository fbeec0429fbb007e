"""A long stage in chunks: progress, metrics, checkpoints, resume."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from train._command import progress

if TYPE_CHECKING:
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import Pipeline

T = TypeVar("T")
Rows = list[tuple[int, dict[str, float]]]


def run_stage(
    run: "RunFolder",
    name: str,
    total: int,
    chunk: int,
    init: Callable[[], Any],
    advance: Callable[[Any, int], tuple[Any, Any]],
    rows: Callable[[int, Any], Rows],
    notes: list[str] | None = None,
    check: Callable[[int, Any], None] | None = None,
    per_step: int = 1,
    seconds: float | None = None,
) -> Any:
    """Takes ``total`` steps in chunks and returns the last state.

    After each chunk its metrics are written and a checkpoint saved; a folder that
    holds checkpoints of this stage goes on from the last good one.

    Args:
        name: of the stage; names its metrics and checkpoints.
        init: the state before the first step.
        advance: ``advance(state, n) -> (state, info)``.
        rows: ``rows(first_step, info)``: metrics as ``(step, {name: value})``.
        notes: where remarks of a resume are added.
        check: ``check(first_step, info)`` raises where going on is useless; called
            before the checkpoint is written.
        per_step: what the metrics count in one of these steps, such as control steps.
        seconds: that its physics take to compile, about; None: not known.
    """
    import jax

    from easi_jax.devices import distributed
    from easi_jax.devices.mesh import placed
    from easi_jax.errors import engine_calls
    from easi_jax.io.runs import checkpoints

    folder = run.checkpoints / name
    found = checkpoints.restore(
        folder, jax.eval_shape(init), config_hash=run.config_hash
    )
    if found is None:
        state, done = jax.jit(init)(), 0
    else:
        state, done = found.state, found.step
        if notes is not None:
            notes.extend(found.notes)
            notes.append(f"{name}: went on after step {done}")
    # Every chunk runs the same compiled program, so a resumed run ends bit-equal.
    state = placed(state)
    if run.resumed:
        run.rewind(name, done * per_step)
    with progress(name, total, done) as meter:
        while done < total:
            n = min(chunk, total - done)
            state, info = meter.compile(partial(advance, state, n), seconds)
            seconds = None
            state = placed(state)
            info = jax.device_get(distributed.local(info))
            engine_calls.check()
            if check is not None:
                check(done, info)
            lines = rows(done, info)
            for step, values in lines:
                run.log(name, step, values)
            done += n
            checkpoints.save(folder, done, state, config_hash=run.config_hash)
            last = lines[-1][1] if lines else {}
            shown = {k: v for k, v in last.items() if "/" not in k}
            meter.advance(n, **shown)
    return distributed.local(state)


def train_stage(
    run: "RunFolder",
    name: str,
    pipe: "Pipeline",
    keys: Any,
    physics: Any,
    target: Any,
    seeds: Sequence[int],
    chunk: int | None,
    old: Any = None,
    notes: list[str] | None = None,
) -> Any:
    """Policies ``(S, ...)`` of a whole training, in chunks.

    Args:
        name, notes: as for `run_stage`.
        keys: one for each of ``seeds``.
        physics: distribution that all seeds train under.
        target: parameters that evaluations are made with.
        chunk: iterations between checkpoints, as a command was given it.
        old: networks to go on from; None for new ones.
    """
    from easi_jax.simulation.compile_time import expected
    from train._robots import training_chunk

    training = pipe.config.training
    wide = pipe.spread(physics, len(seeds))
    step = jit_chunks(
        lambda states, dist, target, n: pipe.train_chunk(states, dist, target, n)
    )
    states = run_stage(
        run,
        name,
        training.iterations,
        training_chunk(chunk, training),
        lambda: pipe.train_init(keys, wide, old),
        lambda s, n: step(s, wide, target, n),
        training_rows(seeds, training.steps_per_iteration),
        notes,
        per_step=training.steps_per_iteration,
        seconds=expected(pipe.simulator),
    )
    return pipe.policies(states)


def as_read_back(tree: Any) -> Any:
    """Arrays on one device, as a checkpoint gives them: what is computed from them is
    the same to the last bit whether a run was interrupted or not.

    Sums over what lies on several devices have another order.
    """
    import jax
    import jax.numpy as jnp

    return jax.tree.map(jnp.asarray, jax.device_get(tree))


def training_rows(seeds: Sequence[int], per_step: int) -> Callable[[int, Any], Rows]:
    """Metrics of policy training: one line for each evaluation.

    ``step`` counts environment steps; ``return`` is the median over seeds.
    """
    import numpy as np

    def rows(first: int, info: Any) -> Rows:
        value = np.asarray(info["eval_return"])
        out: Rows = []
        for i in np.flatnonzero(np.isfinite(value).any(0)):
            column = value[:, i]
            line = {"return": float(np.nanmedian(column))}
            line |= {
                f"seed{s}/return": float(v) for s, v in zip(seeds, column, strict=True)
            }
            out.append(((first + int(i) + 1) * per_step, line))
        return out

    return rows


def training_curve(
    folder: Path, stage: str, seeds: Sequence[int]
) -> tuple[list[int], list[list[float]]]:
    """``(steps, returns[step][seed])`` of a stage from its metrics."""
    from easi_jax.io.runs.metrics import read_metrics

    lines = read_metrics(folder / "metrics.jsonl", stage)
    steps = [line["step"] for line in lines]
    return steps, [
        [line.get(f"seed{s}/return", math.nan) for s in seeds] for line in lines
    ]


def search_rows(
    seeds: Sequence[int], names: Sequence[str], to_si: Callable[[Any], Any]
) -> Callable[[int, Any], Rows]:
    """Metrics of a search: one line for each generation.

    ``seedS/NAME/mean`` and ``seedS/NAME/std`` are in SI units; the standard deviation
    of a log parameter is that of its logarithm times the mean.
    """
    import numpy as np

    def rows(first: int, info: Any) -> Rows:
        mean, std = np.asarray(info.mean), np.asarray(info.std)
        center = np.asarray(to_si(mean))
        above = np.asarray(to_si(mean + std)) - center
        out: Rows = []
        for i in range(mean.shape[1]):
            line = {
                "score": float(np.median(info.score[:, i])),
                "loss": float(np.median(info.loss[:, i])),
                "non_finite": float(np.sum(info.non_finite[:, i])),
            }
            for s, seed in enumerate(seeds):
                line[f"seed{seed}/non_finite"] = float(info.non_finite[s, i])
                for j, name in enumerate(names):
                    line[f"seed{seed}/{name}/mean"] = float(center[s, i, j])
                    line[f"seed{seed}/{name}/std"] = float(above[s, i, j])
                    line[f"seed{seed}/{name}/at_bound"] = float(info.at_bound[s, i, j])
            out.append((first + i + 1, line))
        return out

    return rows


def search_check(
    seeds: Sequence[int], names: Sequence[str], population: int
) -> Callable[[int, Any], None]:
    """Stops a search none of whose simulations stayed finite, with the reason."""
    import numpy as np

    from easi_jax.errors import UserError

    def check(first: int, info: Any) -> None:
        lost = np.asarray(info.non_finite) >= population
        for s, seed in enumerate(seeds):
            dead = np.flatnonzero(lost[s])
            if dead.size:
                worst = np.asarray(info.suspects)[s, dead[0]]
                order = np.argsort(-np.abs(worst))[:3]
                blamed = ", ".join(str(names[int(j)]) for j in order)
                raise UserError(
                    f"seed {seed}, generation {first + int(dead[0]) + 1}: all "
                    f"{population} simulations became non-finite; look first at "
                    f"{blamed} (narrow initial or bounds, or lower the model's "
                    "timestep)"
                )

    return check


def found_check(seeds: Sequence[int], names: Sequence[str], found: Any) -> None:
    """Stops where a fit diverged: a policy trained under what is no number would be
    worth nothing, and nothing would tell. ``found`` has an `Estimate` of each seed.

    Raises:
        UserError: names the seed and the reason.
    """
    import jax

    from easi_jax.errors import UserError
    from easi_jax.estimation.posterior import diverged

    for i, seed in enumerate(seeds):
        why = diverged(jax.tree.map(lambda x, i=i: x[i], found), names)
        if why:
            raise UserError(
                f"seed {seed}: the fit diverged: {why}; another seed may do, but "
                "please report it: the fault is in easi_jax"
            )


def jit_chunks(
    fun: Callable[..., Any], options: dict[str, Any] | None = None
) -> Callable[..., Any]:
    """``fun(*arrays, n)`` compiled once for each chunk length.

    ``options`` of the compiler are such as those of `easi_jax.devices.runtime`.
    """
    import jax

    compiled: dict[int, Any] = {}

    def call(*args: Any) -> Any:
        *arrays, n = args
        if n not in compiled:

            def advance(*a: Any) -> Any:
                return fun(*a, n)

            compiled[n] = jax.jit(advance, compiler_options=options)
        return compiled[n](*arrays)

    return call

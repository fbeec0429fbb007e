"""Which data are kept out of a fit."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from easi_jax.data.cleaning import rows_of
from easi_jax.data.drive_forces import exertion
from easi_jax.data.recording import Run
from easi_jax.data.windows import lead_rows, window_steps
from easi_jax.errors import UserError

HELD_OUT = 0.25  # of the rows, where whole runs are held out
_MOST = 0.6  # of the rows, or of a run
_OF_ONE = 0.3  # of a single run
_BLOCKS = 3  # in which that lies, where each has room for two predictions
_USUAL = 0.2  # s; of predictions that data are parted for, whatever the horizon
_REACHED = 99.8  # percentile
_TRIED = 24  # of very many runs, side by side: a second or two for a thousand of them
_FURTHER = 4.0  # times as bad as not as far: what fits never see cannot be found


def split_held_out(
    m: mujoco.MjModel, runs: Sequence[Run], horizon: float
) -> tuple[list[Run], list[Run], str]:
    """Runs to fit, runs held out, and a sentence that says which: the same for every
    horizon that those held out are long enough for.

    Args:
        horizon: of predictions [s].

    Raises:
        UserError: runs too short to be split.
    """
    # Where runs are too short for that, the horizon that was asked for is told.
    with contextlib.suppress(UserError):
        parted = _parted(m, runs, _USUAL)
        if any(len(run) >= _least(run, horizon) for run in parted[1]):
            return parted
    return _parted(m, runs, horizon)


def _parted(
    m: mujoco.MjModel, runs: Sequence[Run], seconds: float
) -> tuple[list[Run], list[Run], str]:
    """`split_held_out` for predictions of so many ``seconds``.

    Of two runs or more with room for a prediction, whole runs with a quarter of their
    rows, and hardly more, whose speeds and drive forces reach about as far as those of
    the runs left to fit, and rather less far than further; of equals the last. Of a
    single one blocks that are spread over it (`_blocks_of`), and likewise of the
    longest where whole runs would be too few rows or nearly all: a bad row near the end
    of a log parts it in a long run and a short one.
    """
    long = [run for run in runs if len(run) >= _least(run, seconds)]
    chosen = None
    if len(long) > 1:
        rows = np.array([len(run) for run in long])
        chosen = _alike(rows, [_reach(m, run) for run in long])
    if chosen is None:
        longest = max(runs, key=len)
        parts, held, name = _blocks_of(longest, long or runs, seconds)
        fit = []
        for run in runs:
            fit += parts if run is longest else [run]
        return fit, held, name
    held = [run for run, out in zip(long, chosen, strict=True) if out]
    return (
        [run for run in runs if not any(run is out for out in held)],
        held,
        ", ".join(run.name for run in held),
    )


def _least(run: Run, horizon: float) -> int:
    """Rows of one prediction."""
    return lead_rows(run.dt) + window_steps(run.dt, horizon) + 1


def _alike(rows: np.ndarray, reach: Sequence[np.ndarray]) -> np.ndarray | None:
    """Which of runs with so many ``rows (n,)`` are held out, ``(n,)`` bool: one after
    the other, beginning with each of them, or with some of very many. None where these
    would all be too few rows, or too many."""
    far, number = np.array(reach), np.arange(len(rows))

    def share(sets: np.ndarray) -> np.ndarray:
        """Of the rows that are in sets ``(S, n)`` bool."""
        return sets @ rows / rows.sum()

    def costs(held: np.ndarray) -> np.ndarray:
        """Of sets ``(S, n)`` bool."""
        more = np.maximum(share(held) - HELD_OUT, 0.0)
        each = [_unlike(far, one) for one in held]
        return np.round(np.array(each) + 2 * more, 2)

    def order(sets: np.ndarray) -> np.ndarray:
        """Numbers of sets, the best first, of equals the last."""
        return np.lexsort((-(sets @ number), costs(sets)))

    ends = []
    for first in _some(number):
        held = number == first
        while share(held) < HELD_OUT and held.sum() < len(rows) - 1:
            more = _some(number[~held])
            one = order(held | (number == more[:, None]))[: len(rows) // 100 or 1]
            held |= np.isin(number, more[one])
        ends.append(held)
    sets = np.array(ends)
    sets = sets[(share(sets) >= HELD_OUT) & (share(sets) <= _MOST)]
    return sets[order(sets)[0]] if len(sets) else None


def _some(x: np.ndarray) -> np.ndarray:
    """All of ``x (n,)``, or some at even distances."""
    return x[np.unique(np.linspace(0, len(x) - 1, _TRIED).round().astype(int))]


def _blocks_of(
    run: Run, beside: Sequence[Run], horizon: float
) -> tuple[list[Run], list[Run], str]:
    """30 % of a run, or a quarter of it and the runs ``beside`` it, in three blocks,
    each in the middle of a third of it and behind a gap of one prediction; where those
    would be shorter than two predictions in two, else its last rows. What is left
    between them are runs to fit.
    """
    rows, gap = len(run), window_steps(run.dt, horizon)
    least = _least(run, horizon)
    every = sum(len(other) for other in beside)
    held = max(int(_OF_ONE * rows), math.ceil(HELD_OUT * every))
    held = min(held, round(_MOST * rows))
    if held < least:
        longest = parts = ""
        if len(beside) > 1:
            longest = f", the longest of {len(beside)} runs,"
            parts = ", or mend what parts the log (rows that are not finite, holes)"
        raise UserError(
            f"{run.source}: {rows} rows ({rows * run.dt:.3g} s){longest} are too few "
            f"to hold some out with a horizon of {horizon:g} s, which needs "
            f"{math.ceil(least / _OF_ONE)}: record more{parts}, or shorten --horizon"
        )
    count = min(max(held // (least + gap), 1), _BLOCKS)
    size = math.ceil(held / count)
    first = [round((k + 0.5) * rows / count - size / 2) for k in range(count)]
    if count == 1:
        first = [rows - size]
    begin = [0, *(f + size for f in first)]
    end = [*(f - gap for f in first), rows]
    fit = [_piece(run, *of) for of in zip(begin, end, strict=True) if of[0] < of[1]]
    out = [_piece(run, f, f + size) for f in first]
    times = ", ".join(_span(part) for part in out)
    return fit, out, f"{100 * held / rows:.0f} % of {run.name}: {times}"


def _piece(run: Run, first: int, last: int) -> Run:
    part = replace(rows_of(run, first, last), part_of=run.recording)
    return replace(part, name=f"{run.name}, {_span(part)}")


def _span(run: Run) -> str:
    return f"{run.time[0]:.2f} to {run.time[-1]:.2f} s"


def _reach(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """Largest drive forces and measured speeds but for two rows in 1,000."""
    measured = np.concatenate([np.ones(m.nu, bool), ~run.hidden])
    return np.percentile(exertion(m, run)[:, measured], _REACHED, axis=0)


def _unlike(reach: np.ndarray, out: np.ndarray) -> float:
    """How differently far the runs held ``out (n,)`` reach; where further, it counts
    more."""
    least = 1e-3 * reach.max(0) + 1e-12
    d = np.log((reach[out].max(0) + least) / (reach[~out].max(0) + least))
    return float(np.mean(np.where(d > 0, _FURTHER * d, -d)))

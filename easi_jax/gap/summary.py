"""What the workflow found as plain values, for files and reports."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.gap.error_localization import condition_errors, where
from easi_jax.gap.result import Figures, Found, Outcome, last_figures
from easi_jax.gap.sensor_faults import ReadingFault
from easi_jax.gap.verdict import Openness
from easi_jax.model.found_laws import public_name
from easi_jax.model.joint_space import scalar_dofs
from easi_jax.model.results import (
    ErrorMap,
    ErrorPlace,
    GapFigures,
    GapResult,
    NamedEffect,
    Refitted,
    Site,
    Traces,
)

_SHOWN = 6  # channels in a picture of traces
_LEAST = 1e-12  # of a floor that errors are divided by


def gap_result(
    outcome: Outcome,
    *,
    model: str,
    readings: Sequence[ReadingFault],
    held_out: Sequence[str],
    held_name: str,
    notes: Sequence[str],
) -> GapResult:
    """``outcome`` with the faults of readings, by names that people know.

    Args:
        model: name.
        readings: found in the logs; with one, no gap is an explained one.
        held_out: runs; ``held_name`` says it in words.
        notes: of the data, before those of the workflow.
    """
    o, c = outcome, outcome.channels
    explained = bool(readings) and o.verdict == "no_gap"
    lost = last_figures(o).not_finite
    return GapResult(
        model=model,
        verdict="explained" if explained else o.verdict,
        effects=_effects(o),
        readings=tuple(_reading(r, last_figures(o).gap) for r in readings),
        refitted=o.refitted,
        before=_figures(o.before),
        refit=_figures(o.refit, _intervals(o, o.open_refit)),
        after=_figures(o.after, _intervals(o, o.open_after)),
        floor=o.floor,
        floor_si=tuple(o.floor_si.tolist()),
        channels=c.names,
        units=c.units,
        ignored=c.ignored,
        held_out=tuple(held_out),
        held_name=held_name,
        horizon=o.horizon,
        disagreeing=o.disagreeing,
        seconds=o.seconds,
        law_seconds=o.law_seconds,
        start=o.start,
        known_effects=o.known_effects,
        bounded=_named(c.names, np.append(o.floor_is_bound, False)),
        open=_named(c.names, o.open_after.is_open),
        undecided=_named(c.names, o.open_after.undecided),
        notes=(
            *(*notes, *o.notes, *_not_finite(lost, len(o.held))),
            *_not_determined(o.refitted),
        ),
    )


def _not_finite(lost: int, of: int) -> list[str]:
    if not lost:
        return []
    return [
        f"{lost} of {of} held-out predictions are not finite (the model blows up from "
        "there); each counts as an error of the largest motion seen"
    ]


def _not_determined(refitted: Sequence[Refitted]) -> list[str]:
    loose = [r.address for r in refitted if r.outcome == "not determined"]
    if not loose:
        return []
    return [
        f"the data do not determine {', '.join(loose)}: values of the refit there "
        "mean nothing, also in effects.yaml and model.xml"
    ]


_Intervals = tuple[tuple[float, float], ...]


def _figures(f: Figures, intervals: _Intervals = ()) -> GapFigures:
    return GapFigures(f.gap, f.interval, tuple(f.si.tolist()), intervals, f.not_finite)


def _intervals(o: Outcome, found: Openness) -> _Intervals:
    """Of errors of channels, in their units."""
    edges = np.stack([found.low, found.high], 1)[:-1] * o.floor_si[:, None]
    return tuple((low, high) for low, high in edges.tolist())


def _named(names: Sequence[str], which: np.ndarray) -> tuple[str, ...]:
    """Channels of a mask ``(nv + 1,)``, the whole by an empty name."""
    return tuple(n for n, yes in zip((*names, ""), which, strict=True) if yes)


def _effects(o: Outcome) -> tuple[NamedEffect, ...]:
    out, gap = [], o.refit.gap
    for f in o.found:
        out.append(_effect(f, gap))
        gap = f.gap_after
    return tuple(out)


def _effect(f: Found, gap: float) -> NamedEffect:
    columns, single = f.place.columns, Site(f.place.at, f.gap_after, f.place.tied)
    return NamedEffect(
        effect=f.place.effect,
        kind="actuator" if f.sites else f.place.kind,
        sites=f.sites or (single,),
        values=f.values,
        confidence=f.confidence,
        indistinguishable=tuple(map(public_name, f.indistinguishable)),
        gap_before=gap,
        columns={columns[k].name: x for k, x in f.fitted.items()},
        std={columns[k].name: s for k, s in f.deviations.items()},
        shared=bool(f.sites),
        cost=f.cost,
        sure=f.sure,
        odds=f.odds,
        outcome=f.outcome,
    )


def _reading(r: ReadingFault, gap: float) -> NamedEffect:
    """No prediction uses the reading, so the gap stays."""
    return NamedEffect(
        effect=r.effect,
        kind="sensor",
        sites=(Site(r.at, gap),),
        values=r.parameters,
        confidence=r.confidence,
        indistinguishable=(),
        gap_before=gap,
        columns=r.columns,
        std=r.std,
    )


def error_places(o: Outcome, m: mujoco.MjModel) -> tuple[ErrorPlace, ...]:
    """Where the error that remains sits, the largest share first."""
    last = last_figures(o)
    return tuple(where(last.errors, last.conditions, m, o.channels))


def error_map(o: Outcome, m: mujoco.MjModel) -> ErrorMap | None:
    """Errors of joints under conditions; None where no hinge or slide is compared, or
    no condition holds in enough windows."""
    c = o.channels
    joints, names, before = condition_errors(o.before.errors, o.before.conditions, m, c)
    if not joints or not names:
        return None
    *_, after = condition_errors(o.after.errors, o.after.conditions, m, c)
    dofs = np.array([d for _, d in scalar_dofs(m).values()])
    used = dofs[np.isfinite(c.scale[dofs])]
    floor = np.maximum(o.floor_si[used] / c.scale[used], _LEAST)
    return ErrorMap(tuple(joints), tuple(names), before, after, floor)


def telling_traces(o: Outcome, m: mujoco.MjModel, run: Run) -> Traces:
    """Windows with a large, a median and a small error under the model as given.

    Args:
        run: one of the held-out runs, for its control step and joints.
    """
    used = np.isfinite(o.channels.scale)
    nv = m.nv
    size = (o.before.square[:, used] / o.channels.scale[used] ** 2).mean(1)
    order = np.argsort(size)
    w = order[[int(0.95 * (len(order) - 1)), len(order) // 2, len(order) // 10]]
    last, found = last_figures(o), []
    for figures in (o.before, last):
        positions = figures.conditions.positions[w]
        origin = np.broadcast_to(m.qpos0, positions.shape)
        seen = run.configuration.difference(origin, positions)
        error = np.concatenate([figures.first[w, None], figures.errors[w]], 1)
        found.append((seen, seen + error[..., :nv]))
    (measured, before), (_, after) = found
    begin = o.before.conditions.rows.readings[w, 0, 0]
    after = _on_rows(after, last.conditions.rows.readings[w], begin)
    some = np.flatnonzero(used[:nv])[:_SHOWN]
    return Traces(
        np.arange(measured.shape[1]) * run.dt,
        measured[..., some],
        before[..., some],
        after[..., some],
        tuple(o.channels.names[d] for d in some),
        tuple(o.channels.units[d] for d in some),
    )


def _on_rows(path: np.ndarray, rows: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Paths ``(W, T, nv)`` at ``rows`` as they are at T rows from ``first`` on, NaN
    where they do not reach."""
    out = np.full(path.shape, np.nan)
    at = rows - first[:, None, None]
    w, t, d = np.nonzero((at >= 0) & (at < path.shape[1]))
    out[w, at[w, t, d], d] = path[w, t, d]
    return out

"""What the gap workflow found, as ``gap.json`` and as a report for people."""

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from easi_jax.io.report.gap_figures import (
    gap_steps,
    law_curves,
    residual_maps,
    traces,
)
from easi_jax.io.report.html import Picture, Report, Table
from easi_jax.io.report.numbers import (
    measured,
    number,
    quantity,
    shown_unit,
    with_unit,
)
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.results import (
    UNMEASURED,
    ErrorMap,
    GapFigures,
    GapResult,
    LawCurve,
    NamedEffect,
    Retrained,
    Traces,
    Values,
)


def gap_json(result: GapResult) -> dict[str, Any]:
    """The content of ``gap.json``, as the log format describes it."""
    r = result
    last = r.after if r.effects else r.refit
    out = {
        "schema": 1,
        "verdict": r.verdict,
        "effects": [
            told for e in (*r.effects, *r.readings) for told in _effect_json(r, e)
        ],
        "refitted": [
            {
                **{"address": p.address, "from": p.nominal, "to": p.value},
                **{"std": p.std, "outcome": p.outcome},
            }
            for p in r.refitted
        ],
        "gap": {
            "before": r.before.gap,
            "refit": r.refit.gap,
            "refit_95": r.refit.interval,
            "after": r.after.gap,
            "after_95": r.after.interval,
            "floor": r.floor,
            "open": "" in r.open,
            **({} if r.known_effects is None else {"known_effects": r.known_effects}),
        },
        "unexplained_share": r.share(r.after.gap, r.floor),
        "gap_si": {row[0]: _channel_json(r, *row) for row in _channels(r)},
        "undecided": [name for name in r.undecided if name],
        "horizon_seconds": r.horizon,
        "start_seconds": r.start,
        "not_finite": last.not_finite,
        "ignored": [{"at": k, "reason": v} for k, v in r.ignored.items()],
        "held_out": r.held_out,
        "where": r.where or [],
        "disagreeing_runs": r.disagreeing,
        "record_next": r.record_next,
        "notes": r.notes,
        "seconds": r.seconds,
        "law_seconds": r.law_seconds,
        "not_in_model_xml": r.not_in_model_xml,
    }
    if r.retrained is not None:
        out["retrained"] = {
            "robot": r.retrained.robot,
            "env_steps": r.retrained.env_steps,
            "without": r.retrained.without,
            "with": r.retrained.with_effects,
        }
    return out


def _effect_json(r: GapResult, e: NamedEffect) -> Iterator[dict[str, Any]]:
    """An entry for each of its sites."""
    before = e.gap_before
    for site in e.sites:
        yield {
            "effect": e.name,
            "at": site.at,
            **({"places": site.like} if site.like else {}),
            **({"law": e.law} if e.law else {}),
            "kind": e.kind,
            "parameters": {
                k: {"value": v, "std": s, "unit": u}
                for k, (v, s, u) in e.values.items()
            },
            "confidence": e.confidence,
            "explains": r.share(before, site.gap_after),
            "removal_cost": e.cost,
            "removal_sure": e.sure,
            "rival_odds": e.odds,
            "outcome": e.outcome,
            "indistinguishable": e.indistinguishable,
            "gap_after": site.gap_after,
        }
        before = site.gap_after


def gap_report(
    result: GapResult,
    pictures: Sequence[Picture] = (),
    config: Any = None,
    versions: Any = None,
) -> Report:
    """The report: sentences, ``pictures``, tables."""
    r = result
    return Report(
        title=f"The gap of {r.model}",
        headline=headline(r),
        command="train.gap",
        tables=[t for t in _tables(r) if t.rows],
        pictures=pictures,
        notes=[*r.notes, *(f"{k}: left out, {v}" for k, v in r.ignored.items())],
        config=config,
        versions=versions,
    )


# -- sentences ---------------------------------------------------------------------


def headline(r: GapResult) -> list[str]:
    """The result in a few sentences."""
    lines = []
    if r.verdict == "no_gap":
        lines.append(
            "No gap: with its own parameters refitted the model predicts held-out "
            f"data as well as their noise allows (gap {number(r.refit.gap, 3)}, floor "
            f"{number(r.floor, 3)})."
        )
    for e in r.effects:
        said = sentence(e)
        before, after = (r.times_floor(g) for g in (e.gap_before, e.gap_after))
        first, last = number(before, 2), number(after, 2)
        ends = (
            f"from {first} times the sensor noise to the noise itself"
            if round(after, 1) <= 1
            else f"from {first} to {last} times the sensor noise"
        )
        error = f"{measured(r.horizon, 's', 3)} prediction error"
        change = (
            f"With it the {error} on held-out data rises, {ends}: it helps only beside "
            "what follows, or in the fitting data alone."
            if e.rises
            else f"With it the {error} falls {ends}."
        )
        lines.append(
            f"{said[0].upper()}{said[1:]}, which the model lacks (confidence "
            f"{e.confidence:.2f}). {change}"
        )
        if e.indistinguishable:
            lines.append(
                f"These data cannot tell it from {', '.join(e.indistinguishable)}."
            )
    if r.known_effects is not None:
        lines.append(
            "The effects that are known by name leave a gap of "
            f"{number(r.known_effects, 3)} without that law."
        )
    if r.verdict == "unexplained":
        lines.append(
            f"A gap of {number(r.after.gap, 3)} remains "
            f"({number(r.times_floor(r.after.gap), 3)} times the noise) that no known "
            f"effect closes{_most_of_it(r)}."
        )
    lines += [disagreement(*item) for item in r.disagreeing.items()]
    lines += [_reading_line(e) for e in r.readings]
    if r.retrained is not None:
        lines.append(retrained_line(r.retrained))
    return lines


def _most_of_it(r: GapResult) -> str:
    if not r.where:
        return ""
    w = r.where[0]
    return f'; {100 * w.share:.0f}\u00a0% of it sits at "{w.at}", {w.when}'


def sentence(e: NamedEffect) -> str:
    """What a roboticist would say of an effect."""
    shown = {k: measured(v, u, 3) for k, (v, _, u) in e.values.items()}
    at, words = e.sites[0].at, CATALOG[e.effect].sentence
    names = (f'"{name}"' for name in at.split("/"))
    pair = f" between {' and '.join(names)}" if e.kind == "geom" else ""
    if e.shared:
        words = words.replace('actuator "{at}"', "{at}")
        at = f"{len(e.at)} actuators alike ({', '.join(e.at)})"
    elif e.sites[0].like:
        words += f" (alike at {', '.join(e.at)})"
    return words.format(at=at, kind=e.kind, pair=pair, **shown)


def _reading_line(e: NamedEffect) -> str:
    """What to say of a reading that is late or off."""
    (at,) = e.at
    joint = at.removeprefix("qvel.")
    place = f'sensor "{at}"' if joint == at else f'measured velocity of "{joint}"'
    start = f"{place[0].upper()}{place[1:]}"
    if not CATALOG[e.effect].is_shift:
        bias = parameters_text(e.values, ", ")
        return f"{start} is off by a constant ({bias}); no prediction uses it."
    late = f"{1000 * e.columns['late']:.0f} ms"
    if joint != at:
        return (
            f"The {place} lags its position by {late}: a filter in the drive, not the "
            "plant. It is not used."
        )
    return f"{start} comes {late} late; no prediction uses it."


def disagreement(run: str, times: float) -> str:
    """What to say of a run that the others contradict."""
    return (
        f'Run "{run}" disagrees with the others: the same model predicts it '
        f"{number(times, 2)} times worse. Was it recorded with another payload, gain "
        "or setting? Leave it out, or analyse it alone."
    )


def retrained_line(r: Retrained) -> str:
    """What the two trainings came to, in a sentence."""
    with_, without = (median(x.values()) for x in (r.with_effects, r.without))
    count = len(r.with_effects)
    seeds = f"medians of {count} seeds" if count > 1 else "one seed"
    return (
        f"In the repaired model the policy of {r.robot} that was trained with the "
        f"effects returns {with_:.1f}, the one trained without them {without:.1f} "
        f"({seeds})."
    )


def parameters_text(values: Values, between: str) -> str:
    """Parameters of an effect with deviation and unit."""
    return between.join(
        f"{k} {with_unit(quantity(v, s), u)}" for k, (v, s, u) in values.items()
    )


# -- tables ------------------------------------------------------------------------

EFFECT_COLUMNS = ("effect", "at", "parameters", "confidence", "held-out gap")


def effect_rows(r: GapResult, between: str, none: str) -> list[tuple[str, ...]]:
    """Rows of a table of effects: `EFFECT_COLUMNS` and rivals."""
    return [
        (
            f"{e.name}: {e.law}" if e.law else e.name,
            ", ".join(site.at for site in e.sites) or "whole model",
            _marked(parameters_text(e.values, between), e.outcome),
            f"{e.confidence:.2f}",
            _change(e, none),
            ", ".join(e.indistinguishable) or none,
        )
        for e in (*r.effects, *r.readings)
    ]


def _marked(told: str, outcome: str) -> str:
    """Numbers, and how their fit ended where that is to be doubted."""
    return told if outcome == "converged" else f"{told} ({outcome})"


def _change(e: NamedEffect, none: str) -> str:
    if e.kind == "sensor" and e.gap_after == e.gap_before:
        return none  # no prediction uses it
    change = f"{number(e.gap_before, 3)} to {number(e.gap_after, 3)}"
    return f"{change}, rises" if e.rises else change


def _channels(r: GapResult) -> list[tuple[str, str, float, float, float, float]]:
    """Name, unit and errors of each channel that was measured."""
    sizes = (r.before.si, r.refit.si, r.after.si, r.floor_si)
    every = zip(r.channels, r.units, *sizes, strict=True)
    return [row for row in every if r.ignored.get(row[0]) != UNMEASURED]


def _state(r: GapResult, name: str) -> str:
    if name in r.open:
        return "open"
    return "undecided" if name in r.undecided else ""


def _channel_json(
    r: GapResult,
    name: str,
    unit: str,
    before: float,
    refit: float,
    after: float,
    floor: float,
) -> dict[str, Any]:
    """An entry of ``gap_si``."""
    at = r.channels.index(name)
    out = {"unit": unit, "before": before, "refit": refit, "after": after}
    for key, figures in (("refit_95", r.refit), ("after_95", r.after)):
        out[key] = figures.si_intervals[at]
    marked = {"floor_is_upper_bound": True} if name in r.bounded else {}
    return {**out, "floor": floor, **marked, "open": name in r.open}


def _tables(r: GapResult) -> list[Table]:
    returns = r.retrained
    trained = (
        [("without", returns.without), ("with", returns.with_effects)]
        if returns is not None
        else []
    )
    return [
        Table(
            "Effects",
            [*EFFECT_COLUMNS, "as good on these data"],
            effect_rows(r, "; ", "none"),
            "An effect with which the held-out gap rises is marked: the held-out data "
            "do not confirm it alone."
            if any(e.rises for e in r.effects)
            else "",
        ),
        Table(
            "Error by channel",
            ["channel", "unit", "as given", "refitted", "after", "noise floor", ""],
            [
                (name, shown_unit(u), *sizes, _state(r, name))
                for name, u, *sizes in _channels(r)
            ],
            f"RMS over windows of {measured(r.horizon, 's', 3)}, held out: "
            f"{r.held_name}. Open: surely beyond 1.25 times the floor; undecided: "
            "perhaps, more data would tell.",
        ),
        Table(
            "Where the rest sits",
            ["joint", "share", "when"],
            [(w.at, f"{100 * w.share:.3g} %", w.when) for w in r.where or ()],
        ),
        Table(
            "What to record next",
            ["so that names can be told apart"],
            [(line,) for line in r.record_next],
        ),
        Table(
            "The model's own parameters",
            ["address", "from", "to", "std"],
            [
                (p.address, p.nominal, p.value, _marked(number(p.std, 2), p.outcome))
                for p in r.refitted
            ],
        ),
        Table(
            "Return in the repaired model",
            ["trained", "seed", "return"],
            [
                (f"{which} the effects", seed, f"{value:.1f}")
                for which, by_seed in trained
                for seed, value in by_seed.items()
            ],
        ),
    ]


# -- pictures ----------------------------------------------------------------------


def steps_picture(r: GapResult) -> Picture:
    """The gap as given, refitted and after each effect."""
    figures: list[GapFigures] = [r.before, r.refit]
    return Picture(
        "The gap, step by step",
        gap_steps(
            ["as given", "refitted", *(f"+ {e.label}" for e in r.effects)],
            [*(f.gap for f in figures), *(e.gap_after for e in r.effects)],
            *r.after.interval,
            r.floor,
            [2 + k for k, e in enumerate(r.effects) if e.rises],
        ),
        "Bars of the held-out gap as given, refitted and after each effect, with the "
        "noise floor as a line",
        "Root mean square error of open-loop predictions of data that no fit has seen, "
        "as a share of the motion; the line on the last bar is its 95 % interval.",
    )


def law_picture(curves: Sequence[LawCurve]) -> Picture:
    """What force is missing, against what."""
    return Picture(
        "The law that was found",
        law_curves(curves),
        "The force of each law that was found against what it depends on, a dot for "
        "each row of the held-out data",
        "What the law adds to the model, over motion that no fit has seen.",
    )


def map_picture(errors: ErrorMap) -> Picture:
    """Where errors sit, and when."""
    return Picture(
        "Where and when",
        residual_maps(
            errors.joints, errors.conditions, errors.before, errors.after, errors.floor
        ),
        "Two maps of prediction errors, joints by conditions, of the model as given "
        "and of the repaired one",
        "RMS error on held-out data in units of the noise floor of each joint.",
    )


def traces_picture(t: Traces) -> Picture:
    """Measured and predicted motion."""
    return Picture(
        "Measured and predicted",
        traces(t.time, t.measured, t.before, t.after, t.names, t.units),
        "Measured motion in three held-out windows with predictions of the model as "
        "given and of the repaired one",
        "Held-out windows whose error under the model as given is large, median and "
        "small.",
    )

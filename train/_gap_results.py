"""Files of ``train.gap``: gap.json, model.xml, effects.yaml, report.html."""

from pathlib import Path
from typing import Any


def sentence(found: Any) -> str:
    """What a roboticist would say of an effect."""
    shown = {k: f"{v:.3g} {u}".strip() for k, (v, _, u) in found.values.items()}
    shown = {k: v.removesuffix(" 1") for k, v in shown.items()}
    place = found.place
    names = (f'"{name}"' for name in place.at.split("/"))
    pair = f" between {' and '.join(names)}" if place.kind == "geom" else ""
    said = {"at": place.at, "kind": place.kind, "pair": pair}
    words = place.row.sentence
    if found.parts:
        words = words.replace('actuator "{at}"', "{at}")
        said["at"] = _actuators(found)
    return words.format(**said, **shown)


def _actuators(found: Any) -> str:
    """Where a shared effect is seen, in words."""
    names = [p.place.at for p in found.parts]
    return f"{len(names)} actuators alike ({', '.join(names)})"


def _label(found: Any) -> str:
    return f"{found.place.effect}@all" if found.parts else found.place.key


def sites(found: Any) -> list[tuple[Any, float]]:
    """The places that an effect is written down at, and the held-out gap with it at
    each and those before."""
    parts = [(p.place, p.gap_after) for p in found.parts]
    return parts or [(found.place, found.gap_after)]


def parameters_text(values: Any, between: str) -> str:
    """Parameters of an effect with deviation and unit."""
    return between.join(
        f"{k} {v:.4g} ± {s:.2g} {u}".strip() for k, (v, s, u) in values.items()
    )


def effect_rows(
    problem: Any, o: Any, between: str, none: str
) -> list[tuple[str, str, str, str, str]]:
    """Rows of a table of effects: name, place, parameters, confidence, rivals."""
    rows = [
        (
            f.place.effect,
            ", ".join(p.at for p, _ in sites(f)) or "whole model",
            parameters_text(f.values, between),
            f"{f.confidence:.2f}",
            ", ".join(f.indistinguishable) or none,
        )
        for f in o.found
    ]
    for r in problem.readings:
        told = parameters_text(r.parameters, between)
        rows.append((r.effect, r.at, told, f"{r.confidence:.2f}", none))
    return rows


def reading_line(reading: Any) -> str:
    """What to say of a reading that is late or off."""
    place = f"{reading.place[0].upper()}{reading.place[1:]}"
    if reading.effect == "sensor_bias":
        bias = parameters_text(reading.parameters, ", ")
        return f"{place} is off by a constant ({bias}); no prediction uses it."
    late = f"{1000 * reading.columns['late']:.0f} ms"
    if reading.at.startswith("qvel."):
        return (
            f"The {reading.place} lags its position by {late}: a filter in the drive, "
            "not the plant. It is not used."
        )
    return f"{place} comes {late} late; no prediction uses it."


def disagreement(run: str, times: float) -> str:
    """What to say of a run that the others contradict."""
    return (
        f'Run "{run}" disagrees with the others: the same model predicts it '
        f"{times:.2g} times worse. Was it recorded with another payload, gain or "
        "setting? Leave it out, or analyse it alone."
    )


def gap_json(problem: Any, outcome: Any) -> dict[str, Any]:
    """The content of ``gap.json``, as the log format describes it."""
    from easi_jax.gap.error_localization import where

    c, m = outcome.channels, problem.model.mj_model
    last = outcome.after if outcome.found else outcome.refit
    places = where(last.errors, last.conditions, m, c)
    listed = [
        {
            "effect": place.effect,
            "at": place.at,
            "kind": place.kind,
            "parameters": {
                k: {"value": v, "std": s, "unit": u}
                for k, (v, s, u) in f.values.items()
            },
            "confidence": f.confidence,
            "indistinguishable": f.indistinguishable,
            "gap_after": gap_after,
        }
        for f in outcome.found
        for place, gap_after in sites(f)
    ]
    listed += [
        {
            "effect": r.effect,
            "at": r.at,
            "kind": "sensor",
            "parameters": {
                k: {"value": v, "std": s, "unit": u}
                for k, (v, s, u) in r.parameters.items()
            },
            "confidence": r.confidence,
            "indistinguishable": [],
            "gap_after": last.gap,
        }
        for r in problem.readings
    ]
    return {
        "schema": 1,
        "verdict": outcome.verdict,
        "effects": listed,
        "refitted": outcome.refitted,
        "gap": {
            "before": outcome.before.gap,
            "refit": outcome.refit.gap,
            "after": outcome.after.gap,
            "after_95": list(outcome.after.interval),
            "floor": outcome.floor,
        },
        "gap_si": {
            name: {
                "unit": c.units[d],
                "before": outcome.before.si[d],
                "refit": outcome.refit.si[d],
                "after": outcome.after.si[d],
                "floor": outcome.floor_si[d],
            }
            for d, name in enumerate(c.names)
        },
        "ignored": [{"at": k, "reason": v} for k, v in c.ignored.items()],
        "held_out": problem.held_names,
        "where": [
            {"at": w.at, "share": w.share, "when": w.when}
            for w in places
            if w.share > 0
        ],
        "disagreeing_runs": outcome.disagreeing,
        "record_next": outcome.record_next,
        "notes": outcome.notes,
        "seconds": outcome.seconds,
    }


def write_results(
    folder: Any,
    config: Any,
    problem: Any,
    analysis: Any,
    outcome: Any,
    retrained: dict[str, Any] | None = None,
) -> Path:
    """Writes all files; returns the report's path. ``retrained``: see `_retrain`."""
    from easi_jax.io.models.effects_file import write_effects
    from easi_jax.model.found_effects import EffectEntry

    entries, shown = [], []
    for f in outcome.found:
        index = analysis.selector.columns(f.place, fitted=False)
        columns = {
            c.name: float(outcome.x[i])
            for c, i in zip(f.place.columns, index, strict=True)
        }
        std = {f.place.columns[k].name: s for k, s in f.deviations.items()}
        for place, _ in sites(f):
            at = place.effect, place.at, place.kind
            entries.append(EffectEntry(*at, columns, std))
            shown.append({k: v for k, (v, _, _) in f.values.items()})
    for r in problem.readings:
        entries.append(EffectEntry(r.effect, r.at, "sensor", r.columns, r.std))
        shown.append({k: v for k, (v, _, _) in r.parameters.items()})
    write_effects(
        folder.path / "effects.yaml",
        str(problem.model.path or problem.model.name),
        entries,
        shown,
        outcome.refitted,
    )
    model = _with_found(problem, outcome, entries)
    for name, place in model.assets.items():
        folder.write(name, place.read_bytes())
    folder.write("model.xml", model.xml)
    content = gap_json(problem, outcome)
    content["not_in_model_xml"] = model.left
    if retrained is not None:
        content["retrained"] = retrained
    folder.write_json("gap.json", content)
    return _report(folder, config, problem, outcome, content)


def _with_found(problem: Any, outcome: Any, entries: Any) -> Any:
    """The model with refitted values and effects, as MJCF."""
    import numpy as np

    from easi_jax.export.mjcf import identified_model
    from easi_jax.io.models.repaired_mjcf import repaired_model
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.simulator import Simulator

    source = problem.model.source
    values = {r["address"]: r["to"] for r in outcome.refitted}
    moved = [p for p in problem.space.parameters if p.addresses[0] in values]
    if not moved and problem.model.path is not None:
        return repaired_model(source, entries)
    simulator = Simulator(
        problem.model.mj_model, ParameterSpace(tuple(moved)), problem.fit[0].dt
    )
    theta = np.array([values[p.addresses[0]] for p in moved], float)
    return identified_model(source, simulator, theta, entries)


def retrained_line(retrained: dict[str, Any]) -> str:
    """What the two trainings came to, in a sentence."""
    from statistics import median

    with_, without = (median(retrained[k].values()) for k in ("with", "without"))
    count = len(retrained["with"])
    seeds = f"medians of {count} seeds" if count > 1 else "one seed"
    return (
        f"In the repaired model the policy of {retrained['robot']} that was trained "
        f"with the effects returns {with_:.1f}, the one trained without them "
        f"{without:.1f} ({seeds})."
    )


def _report(folder: Any, config: Any, problem: Any, o: Any, content: Any) -> Path:
    import numpy as np

    from easi_jax.io.report.gap_figures import gap_steps, traces
    from easi_jax.io.report.html import Picture, Report, Table, write_report
    from easi_jax.io.runs.versions import versions

    c = o.channels
    lines = []
    if o.verdict == "no_gap":
        lines.append(
            "No gap: with its own parameters refitted the model predicts held-out "
            f"data as well as their noise allows (gap {o.refit.gap:.3g}, floor "
            f"{o.floor:.3g})."
        )
    gap = o.refit.gap
    for f in o.found:
        said = sentence(f)
        lines.append(
            f"{said[0].upper()}{said[1:]}, which the model lacks (confidence "
            f"{f.confidence:.2f}). With it the {o.horizon:g} s prediction error "
            f"falls from {gap / o.floor:.3g} to {f.gap_after / o.floor:.3g} times the "
            "sensor noise."
        )
        if f.indistinguishable:
            lines.append(
                f"These data cannot tell it from {', '.join(f.indistinguishable)}."
            )
        gap = f.gap_after
    if o.verdict == "unexplained":
        rest = content["where"][0]
        lines.append(
            f"A gap of {o.after.gap:.3g} remains ({o.after.gap / o.floor:.3g} times "
            "the noise) that no known effect closes; "
            f"{100 * rest['share']:.0f} % of it sits "
            f'at "{rest["at"]}", {rest["when"]}.'
        )
    lines += [disagreement(*item) for item in o.disagreeing.items()]
    lines += [reading_line(r) for r in problem.readings]
    if "retrained" in content:
        lines.append(retrained_line(content["retrained"]))
    pictures = []
    labels = ["as given", "refitted", *[f"+ {_label(f)}" for f in o.found]]
    gaps = [o.before.gap, o.refit.gap, *[f.gap_after for f in o.found]]
    low, high = o.after.interval
    pictures.append(
        Picture(
            "The gap, step by step",
            gap_steps(labels, gaps, low, high, o.floor),
            "Bars of the held-out gap as given, refitted and after each effect, with "
            "the noise floor as a line",
            "Root mean square error of open-loop predictions of data that no fit has "
            "seen, as a share of the motion; the line on the last bar is its 95 % "
            "interval.",
        )
    )
    pictures += _residual_map(problem, o)
    used = np.flatnonzero(np.isfinite(c.scale))[:6]
    w = _telling(o)
    measured, before, after = _traces(problem, o, w)
    time = np.arange(measured.shape[1]) * problem.fit[0].dt
    pictures.append(
        Picture(
            "Measured and predicted",
            traces(
                time,
                measured[..., used],
                before[..., used],
                after[..., used],
                [c.names[d] for d in used],
                [c.units[d] for d in used],
            ),
            "Measured motion in three held-out windows with predictions of the model "
            "as given and of the repaired one",
            "Held-out windows whose error under the model as given is large, median "
            "and small.",
        )
    )
    tables = [
        Table(
            "Effects",
            ["effect", "at", "parameters", "confidence", "as good on these data"],
            effect_rows(problem, o, "; ", "none"),
        ),
        Table(
            "Error by channel",
            ["channel", "unit", "as given", "refitted", "after", "noise floor"],
            [
                (
                    n,
                    c.units[d],
                    *(
                        float(x[d])
                        for x in (o.before.si, o.refit.si, o.after.si, o.floor_si)
                    ),
                )
                for d, n in enumerate(c.names)
            ],
            f"RMS over windows of {o.horizon:g} s, held out: {problem.held_name}.",
        ),
        Table(
            "Where the rest sits",
            ["joint", "share", "when"],
            [(r["at"], r["share"], r["when"]) for r in content["where"]],
        ),
        Table(
            "What to record next",
            ["so that names can be told apart"],
            [(line,) for line in o.record_next],
        ),
        Table(
            "The model's own parameters",
            ["address", "from", "to", "std"],
            [(r["address"], r["from"], r["to"], r["std"]) for r in o.refitted],
        ),
        Table(
            "Return in the repaired model",
            ["trained", "seed", "return"],
            [
                (f"{which} the effects", seed, f"{value:.1f}")
                for which in ("without", "with")
                for seed, value in content.get("retrained", {}).get(which, {}).items()
            ],
        ),
    ]
    path = folder.path / "report.html"
    write_report(
        path,
        Report(
            title=f"The gap of {problem.model.name}",
            headline=lines,
            command="train.gap",
            tables=[t for t in tables if t.rows],
            pictures=pictures,
            notes=[*o.notes, *(f"{k}: left out, {v}" for k, v in c.ignored.items())],
            config=config,
            versions=versions(),
        ),
    )
    return path


def _residual_map(problem: Any, o: Any) -> list[Any]:
    """A picture of where errors sit; none where no hinge or slide is compared."""
    import numpy as np

    from easi_jax.gap.error_localization import condition_errors
    from easi_jax.io.report.gap_figures import residual_maps
    from easi_jax.io.report.html import Picture
    from easi_jax.model.joint_space import scalar_dofs

    c, m = o.channels, problem.model.mj_model
    joints, names, before = condition_errors(o.before.errors, o.before.conditions, m, c)
    if not joints:
        return []
    *_, after = condition_errors(o.after.errors, o.after.conditions, m, c)
    dofs = np.array([d for _, d in scalar_dofs(m).values()])
    used = dofs[np.isfinite(c.scale[dofs])]
    floor = np.maximum(o.floor_si[used] / c.scale[used], 1e-12)
    return [
        Picture(
            "Where and when",
            residual_maps(joints, names, before, after, floor),
            "Two maps of prediction errors, joints by conditions, of the model as "
            "given and of the repaired one",
            "RMS error on held-out data in units of the noise floor of each joint.",
        )
    ]


def _telling(o: Any) -> Any:
    """Windows with a large, a median and a small error under the model as given."""
    import numpy as np

    used = np.isfinite(o.channels.scale)
    size = (o.before.square[:, used] / o.channels.scale[used] ** 2).mean(1)
    order = np.argsort(size)
    return order[[int(0.95 * (len(order) - 1)), len(order) // 2, len(order) // 10]]


def _traces(problem: Any, o: Any, w: Any) -> tuple[Any, Any, Any]:
    import numpy as np

    last = o.after if o.found else o.refit
    configuration = problem.held[0].configuration
    found = []
    for figures in (o.before, last):
        positions = figures.conditions.positions[w]
        origin = np.broadcast_to(problem.model.mj_model.qpos0, positions.shape)
        seen = configuration.difference(origin, positions)
        error = np.pad(figures.errors[w], [(0, 0), (1, 0), (0, 0)])
        found.append((seen, seen + error))
    (measured, before), (_, after) = found
    return (
        measured,
        before,
        _on_rows(after, last.conditions.rows.readings[w], o.held.row[w]),
    )


def _on_rows(path: Any, rows: Any, first: Any) -> Any:
    """Paths ``(W, T, nv)`` at ``rows`` as they are at T rows from ``first`` on, NaN
    where they do not reach."""
    import numpy as np

    out = np.full(path.shape, np.nan)
    at = rows - first[:, None, None]
    w, t, d = np.nonzero((at >= 0) & (at < path.shape[1]))
    out[w, at[w, t, d], d] = path[w, t, d]
    return out

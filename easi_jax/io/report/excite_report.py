"""What ``train.excite`` chose: ``excite.json``, ``commands.csv``, and in words."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from easi_jax.io.report.numbers import number, with_unit
from easi_jax.model.results import ExciteResult, NumberSeen

_WORST = 10  # effects in the printed table
_ANY = 1e300  # beyond, a number says that there is no limit


def excite_json(result: ExciteResult) -> dict[str, Any]:
    """The content of ``excite.json``."""
    r = result
    return {
        "schema": 1,
        "model": r.model,
        "signal": r.signal,
        "play": "open-loop" if r.controller is None else "feed-forward",
        "controller": r.controller,
        "limits": {"margin": r.margin, "joints": r.joints, "actuators": r.actuators},
        "score": r.score,
        "noise": r.noise,
        "horizon": r.horizon,
        "effects": r.effects,
        "worst_pairs": [
            {
                "effect": p.effect,
                "as": p.rival,
                "apart": p.apart,
                "of_visible": p.of_visible,
            }
            for p in r.worst_pairs
        ],
        "told_apart": [
            {
                "effect": p.effect,
                "as": p.rival,
                "apart": p.apart,
                "best_of_all": p.best_of_all,
                "no_test_can": p.no_test_can,
            }
            for p in r.told_apart
        ],
        "no_trace": r.no_trace,
        "twins": [
            {
                "effect": t.effect,
                "is": "twins" if t.twins else "a case of",
                "as": t.rival,
            }
            for t in r.twins
        ],
        "tried": r.tried,
        "simulated": {
            "windows_of_each_test": r.windows,
            "changes_of_the_model": r.changes,
            "wrong_models": "mass and friction 0.8 and 1.2 times the model's",
        },
        "notes": r.notes,
    }


Rows = list[tuple[str, ...]]


def told_table(result: ExciteResult) -> tuple[str, Sequence[str], Rows]:
    """Title, columns and rows: the pairs that were asked for, or the effects that the
    test tells worst."""
    r = result
    if r.told_apart:
        return (
            "What was to be told apart, in times the noise",
            ("effect", "as", "this test", "best of all tests"),
            [
                (
                    p.effect,
                    p.rival,
                    f"{p.apart:.1f}",
                    "none can" if p.no_test_can else f"{p.best_of_all:.1f}",
                )
                for p in r.told_apart
            ],
        )
    seen = [(k, e) for k, e in r.effects.items() if k not in r.no_trace]
    rows = [
        (
            key,
            ", ".join(with_unit(number(n.size, 2), n.unit) for n in e.numbers[:1]),
            ", ".join(_known_to(n) for n in e.numbers[:1]),
            f"{e.visible:.1f}",
            f"{e.apart:.1f}",
            e.nearest or "nothing",
        )
        for key, e in sorted(seen, key=lambda x: x[1].apart)
    ]
    return (
        f"The {min(_WORST, len(rows))} of {len(rows)} effects told worst: distances in "
        "times the noise, of an effect of this size",
        ("effect", "size", "known to", "from nothing", "from a rival", "rival"),
        rows[:_WORST],
    )


def _known_to(n: NumberSeen) -> str:
    return "nothing" if n.std > _ANY else f"± {with_unit(number(n.std, 2), n.unit)}"


def told_lines(result: ExciteResult) -> list[str]:
    """What else matters of it, a sentence each."""
    r = result
    lines = [
        f"twins in this model, which no test tells apart: {t.effect} and {t.rival}"
        for t in r.twins
        if t.twins
    ]
    if r.no_trace:
        lines.append(f"no trace in any test: {', '.join(r.no_trace)}")
    sizes = (f"{number(v, 3)} at {k}" for k, v in r.signal.amplitude.items())
    best, middle, worst = (
        number(r.tried[i].score, 3) for i in (0, len(r.tried) // 2, -1)
    )
    lines.append(
        f"chosen of {len(r.tried)} tests: {r.signal.what}, {', '.join(sizes)}; score "
        f"{best}, median {middle}, worst {worst}"
    )
    for name, j in r.joints.items():
        allowed = _between(j.allowed) if abs(j.allowed[0]) < _ANY else "any"
        lines.append(
            f"{name}: {_between(j.reached)} in the model and the wrong ones (allowed "
            f"{allowed}), speed up to {number(j.speed_reached, 3)}"
        )
    if r.controller is not None:
        lines.append(
            "play as feed-forward: constant commands do not hold this machine, so add "
            "the columns feedforward.* to your own position controller about the start "
            "pose, and log what is sent in all; excite.json names the controller that "
            "was assumed"
        )
    return lines


def _between(ends: tuple[float, float]) -> str:
    return " to ".join(number(x, 3) for x in ends)


def commands_csv(
    names: Iterable[str], time: np.ndarray, sent: np.ndarray, qpos: np.ndarray
) -> str:
    """Commands, with the positions that the model predicts, as a log.

    Args:
        names: of the columns after the time.
        time: ``(T,)`` [s].
        sent: ``(T, nu)``.
        qpos: ``(T, nq)``.
    """
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    write(["time", *names])
    for t, u, q in zip(time, sent, qpos, strict=True):
        write([f"{t:.6f}", *(f"{x:.9g}" for x in u), *(f"{x:.9g}" for x in q)])
    return out.getvalue()

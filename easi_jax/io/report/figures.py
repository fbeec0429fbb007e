"""Figures as SVG text: no global state, and the same data give the same text."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import ArrayLike

from easi_jax.io.report.figure_style import (
    BLUE,
    DASHED,
    FAINT,
    INK,
    ORANGE,
    ROUND,
    SERIES,
    dash,
    fit,
    grid,
    legend_above,
    styled,
    svg,
    tell,
    with_unit,
)
from easi_jax.io.report.numbers import number, quantity


@styled
def parameters_by_generation(
    mean: ArrayLike,
    std: ArrayLike,
    names: Sequence[str],
    units: Sequence[str],
    *,
    truth: ArrayLike | None = None,
    initial: ArrayLike | None = None,
    log: Sequence[bool] | None = None,
) -> str:
    """One small plot per parameter: mean and two standard deviations, as Fig. 4.

    Args:
        mean: ``(generations, n)`` in SI units; row 0 is where the search started.
        std: ``(generations, n)`` in SI units. For a parameter on a log axis the band
            is ``mean * exp(±2 std / mean)``, which stays positive.
        names: ``n`` parameter names.
        units: ``n`` units, ``""`` where there is none.
        truth: ``(n,)`` dashed line, where known; NaN for a parameter without.
        initial: ``(n, 2)`` range the search started from, drawn at the left edge.
        log: ``n`` flags for a logarithmic axis.

    Returns:
        SVG text.
    """
    mean, std = np.atleast_2d(np.asarray(mean)), np.atleast_2d(np.asarray(std))
    count = mean.shape[1]
    flags = [False] * count if log is None else list(log)
    goals = np.full(count, np.nan) if truth is None else np.asarray(truth, float)
    starts = np.full((count, 2), np.nan) if initial is None else np.asarray(initial)
    figure, axes = grid(count, columns=max(2, min(count, 4)), height=1.6)
    generations = np.arange(mean.shape[0])
    last = max(mean.shape[0] - 1, 1)
    for i, axis in enumerate(axes):
        low, high = _band(mean[:, i], std[:, i], flags[i])
        fit(axis, np.concatenate([low, high, starts[i], goals[i : i + 1]]), flags[i])
        axis.fill_between(generations, low, high, color=BLUE, alpha=0.2, lw=0)
        axis.plot(generations, mean[:, i], color=BLUE, lw=1.6)
        end = with_unit(quantity(float(mean[-1, i]), float(std[-1, i])), units[i])
        tell(axis, generations, mean[:, i], f"{names[i]}: {end} at the end", BLUE)
        if np.isfinite(goals[i]):
            axis.axhline(goals[i], **DASHED)
        axis.plot(
            [-0.03 * last] * 2, starts[i], color=ORANGE, lw=4, solid_capstyle="butt"
        )
        axis.set_title(with_unit(names[i], units[i]))
        axis.set_xlim(-0.05 * last, last)
        axis.xaxis.set_major_locator(MaxNLocator(4, integer=True, steps=ROUND))
    figure.supxlabel("generation", color=FAINT, fontsize=9)
    handles = [
        Line2D([], [], color=BLUE, lw=1.6, label="mean"),
        Patch(color=BLUE, alpha=0.2, lw=0, label="± 2 std"),
    ]
    if np.isfinite(goals).any():
        handles.append(Line2D([], [], **DASHED, label="truth"))
    if initial is not None:
        handles.append(Line2D([], [], color=ORANGE, lw=4, label="start range"))
    legend_above(figure, handles)
    return svg(figure)


@styled
def returns_by_step(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    ylabel: str = "return in the target",
) -> str:
    """Return by training step, as Fig. 5: each seed thin, their median bold.

    Args:
        curves: method to ``(steps (s,), returns (s, seeds))``.
        ylabel: what the return is measured in.

    Returns:
        SVG text.
    """
    figure, (axis,) = grid(1, columns=1, height=3.4)
    ends = []
    for i, (name, (steps, returns)) in enumerate(curves.items()):
        x = np.asarray(steps)
        y = np.asarray(returns, float).reshape(x.size, -1)
        color = SERIES[i % len(SERIES)]
        axis.plot(x, y, color=color, lw=0.7, alpha=0.45)
        middle = np.array([_median(row) for row in y])
        axis.plot(x, middle, color=color, lw=2.2, ls=dash(i))
        ends.append((middle[-1], x[-1], name, color))
        for k, column in enumerate(y.T):
            tell(axis, x, column, f"{name}, seed {k + 1} of {y.shape[1]}", color)
        tell(axis, x, middle, f"{name}, median: {middle[-1]:.4g} at the end", color)
    _name_ends(axis, ends)
    axis.set_xlabel("environment steps")
    axis.set_ylabel(ylabel)
    axis.xaxis.set_major_locator(MaxNLocator(6, steps=ROUND))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    return svg(figure)


@styled
def returns_by_method(
    returns: Mapping[str, ArrayLike], *, xlabel: str = "return in the target"
) -> str:
    """Final return of each method: a dot for every seed, a bar at the median.

    Args:
        returns: method to ``(seeds,)``; methods may differ in their seeds.
        xlabel: what the return is measured in.

    Returns:
        SVG text.
    """
    count = len(returns)
    figure, (axis,) = grid(1, columns=1, height=0.9 + 0.45 * count)
    for i, (name, values) in enumerate(returns.items()):
        row = np.asarray(values, float)
        color = SERIES[i % len(SERIES)]
        spread = 0.18 * np.sin(2.4 * np.arange(row.size))  # seeds side by side
        axis.scatter(row, i + spread, s=26, color=color, alpha=0.75, lw=0)
        for x, y in zip(row, i + spread, strict=True):
            tell(axis, [x], [y], f"{name}: {x:.4g}", color)
        middle = _median(row)
        axis.plot([middle] * 2, [i - 0.32, i + 0.32], color=INK, lw=2)
        axis.annotate(
            f"{middle:.4g}", (middle, i - 0.34), ha="center", va="bottom", fontsize=8.5
        )
    axis.set_yticks(range(count), list(returns))
    axis.tick_params(axis="y", length=0, labelcolor=INK)
    axis.set_ylim(count - 0.4, -0.75)
    axis.grid(False, axis="y")
    axis.spines["left"].set_visible(False)
    axis.set_xlabel(f"{xlabel} (a dot a seed, bar at the median)")
    return svg(figure)


@styled
def prediction_errors(
    errors: Mapping[str, ArrayLike],
    channels: Sequence[str],
    units: Sequence[str],
    *,
    floor: ArrayLike | None = None,
) -> str:
    """Held-out error per channel, one row per model (such as before and after).

    Args:
        errors: model to ``(n,)`` RMS errors in the channels' units.
        channels: ``n`` channel names.
        units: ``n`` units.
        floor: ``(n,)`` what measurement noise alone gives, a dashed line.

    Returns:
        SVG text.
    """
    columns = min(len(channels), 4)
    figure, axes = grid(len(channels), columns, height=0.75 + 0.3 * len(errors))
    for i, axis in enumerate(axes):
        values = [float(np.asarray(row)[i]) for row in errors.values()]
        places = np.arange(len(values))
        colors = [SERIES[k % len(SERIES)] for k in places]
        finite = [v if math.isfinite(v) else 0.0 for v in values]
        axis.barh(places, finite, height=0.62, color=colors)
        for place, value in zip(places, values, strict=True):
            axis.annotate(
                number(value, 3) if math.isfinite(value) else "not finite",
                (value if math.isfinite(value) else 0.0, place),
                xytext=(4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8.5,
            )
        if floor is not None:
            finite.append(float(np.asarray(floor)[i]))
            axis.axvline(finite[-1], **DASHED)
        first = i % columns == 0
        axis.set_yticks(places, list(errors) if first else [""] * len(values))
        axis.tick_params(axis="y", length=0, labelcolor=INK)
        axis.invert_yaxis()
        axis.set_xlim(0, 1.25 * max(finite, default=0.0) or 1.0)
        axis.xaxis.set_major_locator(MaxNLocator(3, steps=ROUND))
        axis.grid(False, axis="y")
        axis.set_title(with_unit(channels[i], units[i]))
    if floor is not None:
        line = Line2D([], [], **DASHED, label="noise floor")
        legend_above(figure, [line])
    return svg(figure)


def _band(mean: np.ndarray, std: np.ndarray, log: bool) -> tuple[Any, Any]:
    """Lower and upper edge; NaN, which leaves a hole, where there is none."""
    known = np.isfinite(mean) & np.isfinite(std) & ((mean > 0) | (not log))
    mean, std = np.where(known, mean, np.nan), np.where(known, std, np.nan)
    if not log:
        return mean - 2 * std, mean + 2 * std
    factor = np.exp(np.minimum(2 * std / mean, 50.0))
    return mean / factor, mean * factor


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def _name_ends(axis: Axes, ends: list[tuple[float, float, str, str]]) -> None:
    """Names at the right end of the curves, moved apart where they would overlap."""
    low, high = axis.get_ylim()
    gap = 0.07 * (high - low)
    place = -math.inf
    for value, x, name, color in sorted(e for e in ends if math.isfinite(e[0])):
        place = max(value, place + gap)
        axis.annotate(
            name,
            xy=(x, value),
            xytext=(1.01, place),
            xycoords="data",
            textcoords=axis.get_yaxis_transform(),
            va="center",
            color=color,
            fontweight="bold",
            annotation_clip=False,
        )

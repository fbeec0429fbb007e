"""Figures of the gap workflow: traces before and after, the gap step by step."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from easi_jax.io.report.figure_style import (
    BLUE,
    DASHED,
    FAINT,
    INK,
    VERMILION,
    grid,
    labelled_map,
    legend_above,
    styled,
    svg,
    tell,
    with_unit,
)
from easi_jax.io.report.numbers import compact, number
from easi_jax.model.results import LawCurve

_DOTS = 1_500  # of a law, at most
_DASHES: Any = {"color": VERMILION, "lw": 1.3, "ls": (0, (4, 2))}


@styled
def traces(
    time: np.ndarray,
    measured: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
) -> str:
    """Measured and predicted motion in some windows, one row of axes per channel.

    Args:
        time: ``(H + 1,)`` [s].
        measured, before, after: ``(windows, H + 1, channels)``.
    """
    windows, _, count = measured.shape
    figure, axes = grid(count * windows, windows, 1.9)
    handles = []
    for c in range(count):
        for w in range(windows):
            axis = axes[c * windows + w]
            for label, motion, style in (
                ("measured", measured, {"color": INK, "lw": 2.2}),
                ("model as given", before, _DASHES),
                ("repaired", after, {"color": BLUE, "lw": 1.3}),
            ):
                y = motion[w, :, c]
                lines = axis.plot(time, y, label=label, **style)
                handles += lines if w == c == 0 else []
                end = with_unit(number(float(y[-1])), units[c])
                tell(axis, time, y, f"{names[c]}, {label}: {end} at the end")
            if w == 0:
                axis.set_ylabel(with_unit(names[c], units[c]))
            if c == count - 1:
                axis.set_xlabel("time in the window [s]")
    legend_above(figure, handles)
    return svg(figure)


@styled
def gap_steps(
    labels: Sequence[str],
    gaps: Sequence[float],
    low: float,
    high: float,
    floor: float,
    rising: Sequence[int] = (),
) -> str:
    """The held-out gap as given, refitted and after each effect, and the noise floor.

    Args:
        low, high: 95 % interval of the last.
        rising: places of effects with which the gap rises.
    """
    figure, (axis,) = grid(1, 1, 0.42 * len(labels) + 0.9)
    y = np.arange(len(labels))[::-1]
    colors = [VERMILION, *([FAINT] * (len(labels) - 2)), BLUE][: len(labels)]
    bars = axis.barh(y, gaps, color=colors, height=0.6)
    for k in rising:
        bars[k].set(hatch="///", edgecolor=VERMILION)
    labels = [f"{t} (rises)" if k in rising else t for k, t in enumerate(labels)]
    axis.plot([low, high], [y[-1], y[-1]], color=INK, lw=2)
    axis.axvline(floor, **DASHED)
    axis.annotate(
        "noise floor",
        (floor, len(labels) - 0.45),
        xytext=(4, 0),
        textcoords="offset points",
        color=INK,
        va="bottom",
    )
    axis.set_yticks(y, labels)
    axis.set_xlabel("gap on held-out data (share of the motion)")
    axis.set_ylim(-0.6, len(labels) - 0.1)
    axis.grid(visible=False, axis="y")
    return svg(figure)


@styled
def law_curves(curves: Sequence[LawCurve]) -> str:
    """The force of each law against what it depends on, a dot a row."""
    figure, axes = grid(len(curves), min(len(curves), 2), 2.6)
    for axis, c in zip(axes, curves, strict=True):
        some = np.linspace(0, len(c.x) - 1, min(len(c.x), _DOTS)).astype(int)
        axis.plot(c.x[some], c.force[some], ".", ms=2, color=BLUE)
        axis.set_xlabel(c.against)
        axis.set_ylabel(f"missing force [{c.unit}]")
        axis.set_title(c.law)
    return svg(figure)


@styled
def residual_maps(
    joints: Sequence[str],
    conditions: Sequence[str],
    before: np.ndarray,
    after: np.ndarray,
    floor: np.ndarray,
) -> str:
    """Errors of joints under conditions, in units of the noise floor, two maps.

    Args:
        before, after: ``(joints, conditions)``; NaN where it did not occur.
        floor: of each joint, ``(joints,)``, in the same units.
    """
    figure, axes = grid(2, 2, 0.42 * len(joints) + 1.9)
    maps = [np.maximum(x / floor[:, None], 1e-3) for x in (before, after)]
    most = max(float(np.max(maps[0], initial=2.0, where=np.isfinite(maps[0]))), 2.0)
    for axis, shown, title in zip(
        axes, maps, ("model as given", "repaired"), strict=True
    ):
        axis.imshow(
            np.log10(shown), cmap="YlOrRd", vmin=0.0, vmax=np.log10(most), aspect="auto"
        )
        dark = np.log10(shown) > 0.6 * np.log10(most)
        labels = {
            (i, j): (compact(shown[i, j]), bool(dark[i, j]))
            for i, j in np.argwhere(np.isfinite(shown)).tolist()
        }
        # The rows of the second map are those of the first.
        labelled_map(axis, labels, joints if axis is axes[0] else (), conditions)
        axis.set_title(title)
    return svg(figure)

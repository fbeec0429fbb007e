"""Figures of the gap workflow: traces before and after, the gap step by step."""

from collections.abc import Sequence

import numpy as np

from easi_jax.io.figure_style import (
    BLUE,
    DASHED,
    FAINT,
    INK,
    VERMILION,
    grid,
    legend_above,
    styled,
    svg,
    with_unit,
)


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
    for c in range(count):
        for w in range(windows):
            axis = axes[c * windows + w]
            axis.plot(time, measured[w, :, c], color=INK, lw=2.2, label="measured")
            axis.plot(
                time,
                before[w, :, c],
                color=VERMILION,
                lw=1.3,
                ls=(0, (4, 2)),
                label="model as given",
            )
            axis.plot(time, after[w, :, c], color=BLUE, lw=1.3, label="repaired")
            if w == 0:
                axis.set_ylabel(with_unit(names[c], units[c]))
            if c == count - 1:
                axis.set_xlabel("time in the window [s]")
    legend_above(figure, axes[0].get_lines())
    return svg(figure)


@styled
def gap_steps(
    labels: Sequence[str], gaps: Sequence[float], low: float, high: float, floor: float
) -> str:
    """The held-out gap as given, refitted and after each effect, and the noise floor.

    Args:
        low, high: 95 % interval of the last.
    """
    figure, (axis,) = grid(1, 1, 0.42 * len(labels) + 0.9)
    y = np.arange(len(labels))[::-1]
    colors = [VERMILION, *([FAINT] * (len(labels) - 2)), BLUE][: len(labels)]
    axis.barh(y, gaps, color=colors, height=0.6)
    axis.plot([low, high], [y[-1], y[-1]], color=INK, lw=2)
    axis.axvline(floor, **DASHED)
    axis.text(floor, len(labels) - 0.45, " noise floor", color=INK, va="bottom")
    axis.set_yticks(y, [text.replace("$", r"\$") for text in labels])
    axis.set_xlabel("gap on held-out data (share of the motion)")
    axis.set_ylim(-0.6, len(labels) - 0.1)
    axis.grid(visible=False, axis="y")
    return svg(figure)


@styled
def error_map(rows: Sequence[str], columns: Sequence[str], values: np.ndarray) -> str:
    """Where the remaining error sits: squared error of joints over its mean.

    Args:
        values: ``(rows, columns)``; NaN where not measured.
    """
    figure, (axis,) = grid(1, 1, 0.4 * len(rows) + 1.2)
    shown = np.ma.masked_invalid(values)
    axis.imshow(
        shown,
        cmap="cividis",
        vmin=0.0,
        vmax=max(2.0, float(shown.max())),
        aspect="auto",
    )
    for i in range(len(rows)):
        for j in range(len(columns)):
            if np.isfinite(values[i, j]):
                dark = values[i, j] < 0.6 * max(2.0, float(shown.max()))
                axis.text(
                    j,
                    i,
                    f"{values[i, j]:.1f}",
                    ha="center",
                    va="center",
                    color="white" if dark else "black",
                )
    axis.set_xticks(range(len(columns)), columns, rotation=20, ha="right")
    axis.set_yticks(range(len(rows)), [r.replace("$", r"\$") for r in rows])
    axis.grid(visible=False)
    return svg(figure)

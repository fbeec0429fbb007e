"""Pictures of the gap benchmark: confusion matrix and calibration curve."""

from collections.abc import Mapping, Sequence

import numpy as np

from easi_jax.io.report.figure_style import (
    BLUE,
    DASHED,
    FAINT,
    grid,
    labelled_map,
    styled,
    svg,
)

_LAST = ("right twin", "none")  # columns that are no effect's name


@styled
def confusion_matrix(counts: Mapping[str, Mapping[str, int]]) -> str:
    """How often each true effect (rows) was named as what (columns).

    Args:
        counts: first name by true effect, of `gap_score.confusion`.
    """
    rows = sorted(counts)
    named = {name for row in counts.values() for name in row}
    columns = sorted({*rows, *(named - set(_LAST))}) + [n for n in _LAST if n in named]
    table = np.array([[counts[r].get(c, 0) for c in columns] for r in rows], float)
    figure, (axis,) = grid(1, 1, 0.27 * len(rows) + 1.9)
    shares = table / np.maximum(table.sum(1, keepdims=True), 1)
    axis.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    labels = {
        (i, j): (f"{table[i, j]:.0f}", bool(shares[i, j] > 0.6))
        for i, j in np.argwhere(table > 0).tolist()
    }
    labelled_map(axis, labels, rows, columns)
    axis.set_xlabel("named first")
    axis.set_ylabel("true effect")
    return svg(figure)


@styled
def calibration_curve(
    bins: Sequence[tuple[float, float, int]],
    intervals: Sequence[tuple[float, float]],
) -> str:
    """Share of names that are right, by the confidence stated.

    Args:
        bins: mean confidence, share right and count, of `gap_score.calibration`.
        intervals: 95 % of each share.
    """
    figure, (axis,) = grid(1, 1, 2.8)
    axis.plot([0, 1], [0, 1], **DASHED)
    x = np.array([b[0] for b in bins])
    y = np.array([b[1] for b in bins])
    reach = np.array(intervals).reshape(-1, 2).T
    bars = np.maximum((y - reach[0], reach[1] - y), 0.0)  # 0 of 5 rounds below 0
    axis.errorbar(x, y, bars, fmt="o", color=BLUE, capsize=3)
    for (at, share, count), (low, _) in zip(bins, intervals, strict=True):
        axis.annotate(
            f"{count}", (at, min(share, low)), (6, 0), textcoords="offset points"
        )
    axis.text(0.42, 0.33, "calibrated", color=FAINT)
    axis.set_xlim(-0.02, 1.06)
    axis.set_ylim(-0.02, 1.06)
    axis.set_xlabel("confidence stated (numbers: names in the bin)")
    axis.set_ylabel("share that is right")
    return svg(figure)

"""One style for all figures, in colors that all eyes tell apart.

The colors are Okabe and Ito's ("Color Universal Design", 2008), which people with any
of the common color vision deficiencies can tell apart.
"""

import html
import io
import math
import re
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from easi_jax.io.report.numbers import number, shown_unit

INK = "#24292f"
FAINT = "#6e7781"
GRID = "#d8dee4"
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY, ORANGE = "#56b4e9", "#e69f00"
SERIES = (BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE)

_P = ParamSpec("_P")
ROUND = (1, 2, 5, 10)
DASHED: Any = {"color": INK, "lw": 1.2, "ls": (0, (4, 2.5))}
_TOLD = "told-"
_WIDTH = 9.0  # inches; the report's text column
_LETTERS = 140  # of a legend, in a row
_CELL = 0.88  # of a heat map's cell that its label may fill
_SMALLEST = 4.0  # points; a browser enlarges what is smaller than one can read
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "easi-jax",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelcolor": FAINT,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 4),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "text.color": INK,
    "text.parse_math": False,  # a $ in a name is a $
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
}


def styled(draw: Callable[_P, str]) -> Callable[_P, str]:
    """A figure function that draws in this style and leaves the global one alone."""

    @wraps(draw)
    def styled(*args: _P.args, **kwargs: _P.kwargs) -> str:
        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return styled


def grid(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` axes; ``height`` of a row in inches."""
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(_WIDTH, height * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def fit(axis: Axes, values: np.ndarray, log: bool) -> None:
    """Limits and ticks that hold all finite values (on a log axis: the positive)."""
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not values.size:
        return
    low, high = values.min(), values.max()
    if not log:
        margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
        axis.set_ylim(low - margin, high + margin)
        axis.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND))
        return
    factor = max((high / low) ** 0.06, 1.02)
    axis.set_yscale("log")
    axis.set_ylim(low / factor, high * factor)
    axis.yaxis.set_major_locator(FixedLocator(_log_ticks(low / factor, high * factor)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 3)))
    axis.yaxis.set_minor_locator(NullLocator())


def _log_ticks(low: float, high: float) -> list[float]:
    """Three or so ticks between, round numbers wherever there are enough."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found: list[float] = []
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7)):
        ticks = [digit * 10.0**decade for decade in decades for digit in digits]
        found = [tick for tick in ticks if low <= tick <= high]
        if len(found) >= 3:
            return found[:: math.ceil(len(found) / 5)]
    return found if len(found) == 2 else np.linspace(low, high, 5)[1:-1:2].tolist()


def labelled_map(
    axis: Axes,
    labels: Mapping[tuple[int, int], tuple[str, bool]],
    rows: Sequence[str],
    columns: Sequence[str],
) -> None:
    """Writes into an image what its cells hold.

    Args:
        labels: text and whether the cell is dark, by row and column.
    """
    for (i, j), (text, dark) in labels.items():
        axis.text(
            j,
            i,
            text,
            ha="center",
            va="center",
            fontsize="small",
            color="white" if dark else INK,
        )
    axis.set_xticks(range(len(columns)), columns, rotation=55, ha="right")
    axis.set_yticks(range(len(rows)), rows)
    axis.grid(visible=False)


def _fit_cells(figure: Figure) -> None:
    """Makes the labels of heat maps as small as the narrowest cell needs."""
    maps = [a for a in figure.axes if a.images and a.texts]
    if maps:
        figure.draw_without_rendering()  # the layout is known from here on
    for axis in maps:
        left, right, bottom, top = axis.images[0].get_extent()
        box = axis.get_window_extent()
        width = _CELL * box.width / abs(right - left)
        height = _CELL * box.height / abs(top - bottom)
        labels = [text.get_window_extent() for text in axis.texts]
        most = max(max(x.width / width, x.height / height) for x in labels)
        for text in axis.texts:
            size = float(text.get_fontsize()) / max(1.0, most)
            text.set_fontsize(max(_SMALLEST, size))


def legend_above(figure: Figure, handles: list[Any]) -> None:
    """One legend for all axes at the top left; in a row where that is not too long."""
    wide = [len(str(h.get_label())) + 8 for h in handles]
    columns = len(handles) if sum(wide) <= _LETTERS else _LETTERS // max(wide)
    figure.legend(
        handles=handles, loc="outside upper left", ncols=max(1, columns), borderpad=0
    )


def dash(index: int) -> Any:
    """Line style of the curve ``index``, so that color is not all that differs."""
    return ("-", (0, (6, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.2, 1.2, 1.2)))[index % 4]


def with_unit(name: str, unit: str) -> str:
    """``name [unit]``."""
    return f"{name} [{shown_unit(unit)}]" if unit else name


def tell(axis: Axes, x: Any, y: Any, text: str, color: str = INK) -> None:
    """Says ``text`` where the pointer is near a curve or, of one number each, a dot.

    What lies there is not seen until then (class ``told``; the page shows it).
    """
    one = np.size(x) == 1
    mark: Any = {"marker": "o", "ms": 11, "mew": 0} if one else {"lw": 9}
    (line,) = axis.plot(x, y, color=color, alpha=0.0, **mark)
    line.set_gid(_TOLD + urllib.parse.quote(text, safe=""))


def _titled(found: re.Match[str]) -> str:
    words = html.escape(urllib.parse.unquote(found[1]))
    return f'<g class="told"><title>{words}</title>'


def svg(figure: Figure) -> str:
    """SVG text, the same for the same figure: no date, no random names."""
    _fit_cells(figure)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(rf'<g id="{_TOLD}([^"]*)">', _titled, buffer.getvalue())
    # matplotlib's metadata name addresses on the network.
    return re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.S)

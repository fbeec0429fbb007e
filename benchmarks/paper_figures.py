"""Pictures that only the paper's figures need."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from easi_jax.io.report.figure_style import (
    DASHED,
    FAINT,
    SERIES,
    dash,
    fit,
    grid,
    legend_above,
    styled,
    svg,
)


@styled
def ratios_by_generation(
    panels: Mapping[str, Mapping[str, Sequence[Sequence[Sequence[float]]]]],
    columns: int,
    whole: bool = False,
) -> str:
    """Ratios to the truth by generation, a panel each, as the paper's Fig. 4.

    Args:
        panels: by title and method, for each seed the middle, the lower and the upper
            edge by generation. Bands are of the first seed.
        columns: panels side by side.
        whole: whether axes reach as far as the bands, or as the lines.
    """
    figure, axes = grid(len(panels), columns, height=1.9)
    methods = list(next(iter(panels.values())))
    for axis, (title, by_method) in zip(axes, panels.items(), strict=True):
        seen = [np.ones(1)]
        for i, method in enumerate(methods):
            color = SERIES[i % len(SERIES)]
            for k, (middle, low, high) in enumerate(by_method.get(method, ())):
                generation = np.arange(1, len(middle) + 1)
                if k == 0:
                    axis.fill_between(
                        generation, low, high, color=color, alpha=0.2, lw=0
                    )
                axis.plot(generation, middle, color=color, lw=1.2, ls=dash(i))
                shown = (middle, low, high) if whole and k == 0 else (middle,)
                seen += [np.asarray(x, float) for x in shown]
        axis.axhline(1.0, **DASHED)
        fit(axis, np.clip(np.concatenate(seen), 0.05, 20.0), log=True)
        axis.set_title(title)
    figure.supxlabel("generation", color=FAINT, fontsize=9)
    handles = [
        Line2D([], [], color=SERIES[i % len(SERIES)], lw=1.6, ls=dash(i), label=m)
        for i, m in enumerate(methods)
    ]
    legend_above(figure, [*handles, Line2D([], [], **DASHED, label="truth")])
    return svg(figure)


@styled
def returns_by_factor(
    returns: Mapping[str, Mapping[float, Sequence[float]]], xlabel: str
) -> str:
    """Return by the factor on a target's parameter, as the paper's Fig. 6: a dot a
    seed, lines through the medians.

    Args:
        returns: by method and factor, of each seed.
    """
    figure, (axis,) = grid(1, 1, 3.2)
    handles = []
    for i, (method, by_factor) in enumerate(returns.items()):
        color, shift = SERIES[i % len(SERIES)], 1.04 ** (i - 1)
        factors = sorted(by_factor)
        for x in factors:
            values = by_factor[x]
            axis.scatter(
                [x * shift] * len(values), values, s=16, color=color, alpha=0.6, lw=0
            )
        middle = [float(np.nanmedian(by_factor[x])) for x in factors]
        axis.plot(factors, middle, color=color, lw=1.8, ls=dash(i))
        handles.append(Line2D([], [], color=color, lw=1.8, ls=dash(i), label=method))
    axis.set_xscale("log")
    ticks = sorted({x for by_factor in returns.values() for x in by_factor})
    axis.xaxis.set_major_locator(FixedLocator(ticks))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.set_xlabel(xlabel)
    axis.set_ylabel("return in the target")
    legend_above(figure, handles)
    return svg(figure)


@styled
def motion_and_speed(
    frequency: Sequence[float],
    density: Mapping[str, Mapping[str, Sequence[float]]],
    commands: Sequence[float],
    speed: Mapping[str, Sequence[Sequence[float | None]]],
) -> str:
    """Spectra of joint motion, and speed by command, as the paper's Fig. 7.

    Args:
        frequency: [Hz].
        density: by kind of joint and what moved [rad / sqrt(Hz)]; the first is what was
            measured.
        commands: [m/s].
        speed: by method, for each seed the mean speed at each command [m/s]; None where
            every episode fell.
    """
    figure, axes = grid(len(density) + 1, 2, height=2.2)
    handles = {}
    names = list(dict.fromkeys(name for found in density.values() for name in found))
    measured, simulated = names[0], names[1:]
    for axis, (joint, found) in zip(axes, density.items(), strict=False):
        for name, values in found.items():
            first = name == measured
            i = 0 if first else simulated.index(name)
            color = FAINT if first else SERIES[i % len(SERIES)]
            style = "-" if first else dash(i)
            axis.plot(frequency, values, color=color, lw=1.4, ls=style)
            handles[name] = Line2D([], [], color=color, lw=1.6, ls=style, label=name)
        every = np.concatenate([np.asarray(v, float) for v in found.values()])
        fit(axis, every, log=True)
        axis.set_title(f"{joint} [rad / √Hz]")
        axis.set_xlabel("frequency [Hz]")
    axis = axes[len(density)]
    axis.plot(commands, commands, **DASHED)
    for i, (method, seeds) in enumerate(speed.items()):
        color, style = SERIES[i % len(SERIES)], dash(i)
        for values in seeds:
            seen = [np.nan if v is None else v for v in values]
            # A single command between falls would be no line.
            axis.plot(commands, seen, color=color, lw=1.2, ls=style, marker="o", ms=2)
        shown = Line2D([], [], color=color, lw=1.6, ls=style, label=method)
        handles.setdefault(method, shown)
    axis.set_title("speed [m/s]")
    axis.set_xlabel("command [m/s]")
    legend_above(figure, [*handles.values(), Line2D([], [], **DASHED, label="as told")])
    return svg(figure)

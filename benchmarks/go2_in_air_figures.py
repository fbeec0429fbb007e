"""Pictures of a real Go2 in a stand: errors of its joints, values of two halves."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from easi_jax.io.report.figure_style import DASHED, SERIES, grid, styled, svg


@styled
def errors_by_joint(
    joints: Sequence[str],
    errors: Mapping[str, Sequence[float]],
    floor: Sequence[float],
) -> str:
    """Bars of held-out errors [rad] by what was simulated, and the noise beside."""
    figure, (axis,) = grid(1, 1, 2.8)
    at, width = np.arange(len(joints)), 0.8 / len(errors)
    for k, (name, values) in enumerate(errors.items()):
        x = at + (k - (len(errors) - 1) / 2) * width
        axis.bar(x, 1e3 * np.array(values), width, color=SERIES[k], label=name)
    for x, low in zip(at, 1e3 * np.array(floor), strict=True):
        axis.plot([x - 0.42, x + 0.42], [low, low], **DASHED)
    axis.plot([], [], label="noise of the readings", **DASHED)
    short = [j.removesuffix("_joint").replace("_", " ") for j in joints]
    axis.set_xticks(at, short, rotation=45, ha="right")
    axis.set_ylabel("held-out error over 0.2 s [mrad]")
    axis.legend(ncol=3, loc="upper left")
    return svg(figure)


@styled
def values_of_halves(even: Mapping[str, Any], odd: Mapping[str, Any]) -> str:
    """Each parameter's ``mean`` and ``std`` by even and by odd blocks of a recording,
    as shares of what both say together."""
    names = list(even)
    figure, (axis,) = grid(1, 1, 0.24 * len(names) + 1.0)
    at = np.arange(len(names))[::-1]
    middle = [math.sqrt(even[n]["mean"] * odd[n]["mean"]) for n in names]
    for k, (half, found) in enumerate((("even", even), ("odd", odd))):
        mean = np.array([found[n]["mean"] for n in names]) / middle
        std = np.array([found[n]["std"] for n in names]) / middle
        axis.errorbar(
            *(mean, at + (0.16 - 0.32 * k)),
            xerr=np.stack([np.minimum(std, 0.9 * mean), std]),
            fmt="o",
            ms=4,
            capsize=2,
            color=SERIES[k],
            label=f"{half} blocks",
        )
    axis.axvline(1.0, **DASHED)
    axis.set_xscale("log")
    axis.set_xlim(0.15, 4.0)
    axis.set_xticks([0.2, 0.5, 1, 2, 4], ["0.2", "0.5", "1", "2", "4"])
    axis.set_xticks([], minor=True)
    axis.set_yticks(at, [n.replace("_joint", "").replace("_", " ") for n in names])
    axis.set_xlabel("value and one deviation, over the middle of both halves")
    axis.legend(loc="upper right")
    return svg(figure)

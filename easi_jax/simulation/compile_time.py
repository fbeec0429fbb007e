"""How long the physics of MJX will take to compile, before it is compiled."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from easi_jax.devices.runtime import on_cpu
from easi_jax.model.contact_pairs import pair_ids

if TYPE_CHECKING:
    from easi_jax.simulation.simulator import Simulator

# Seconds of one core: for any program, and besides for each degree of freedom to the
# power of 1.5 and pair of geoms (benchmarks/results/compile_times.json, of arms with up
# to twelve joints). Effects take no time that could be measured.
CONSTANTS = (0.62, 0.901, 3.21)


@dataclass(frozen=True)
class Size:
    """What the time to compile depends on.

    Attributes:
        joints: degrees of freedom.
        pairs: of geoms that are compiled.
    """

    joints: int
    pairs: int


def size_of(simulator: "Simulator") -> Size:
    """The size of a simulator of MJX."""
    return Size(simulator.mj_model.nv, len(pair_ids(simulator.base.mjx)))


def fitted(sizes: Sequence[Size], seconds: Sequence[float]) -> list[float]:
    """The constants that fit times best, as shares of each; none is negative."""
    from scipy.optimize import nnls

    times = np.asarray(seconds, float)
    rows = np.array([_terms(s) for s in sizes])
    found, _ = nnls(rows / times[:, None], np.ones(len(times)))
    return [float(x) for x in found]


def _terms(s: Size) -> tuple[float, ...]:
    return 1.0, s.joints**1.5, s.pairs


def expected_of(size: Size) -> float:
    """Seconds that a program of this size takes to compile on one core."""
    return float(np.dot(CONSTANTS, _terms(size)))


def expected(simulator: "Simulator") -> float | None:
    """Seconds until a program that simulates is compiled; None where that was not
    measured (accelerators), or there is no physics to compile (``mujoco``).
    """
    if simulator.engine != "mjx" or not on_cpu():
        return None
    return expected_of(size_of(simulator))

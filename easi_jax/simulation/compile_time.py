"""How long the physics of MJX will take to compile, before it is compiled."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import mjx

from easi_jax.devices.runtime import on_cpu
from easi_jax.model.contact_pairs import contacts

# Seconds of one core: for any program, and besides for each degree of freedom to the
# power of 1.5, contact with a plane times degrees of freedom, and other contact
# (benchmarks/results/compile_times.json: arms with up to six joints, and single
# bodies). Effects take no time that could be measured.
CONSTANTS = (0.159, 0.759, 0.742, 4.15)


@dataclass(frozen=True)
class Size:
    """What the time to compile depends on.

    Attributes:
        joints: degrees of freedom.
        on_planes: contacts with planes that MJX computes at every step.
        others: contacts that it computes between other shapes.
    """

    joints: int
    on_planes: int
    others: int


def size_of(m: mujoco.MjModel | mjx.Model) -> Size:
    """The size of a model."""
    return Size(int(m.nv), *contacts(m))


def fitted(sizes: Sequence[Size], seconds: Sequence[float]) -> list[float]:
    """The constants by which times are off by the smallest factors; all positive."""
    from scipy.optimize import least_squares

    rows, times = np.array([_terms(s) for s in sizes]), np.asarray(seconds, float)
    start = np.zeros(rows.shape[1])
    found = least_squares(lambda x: np.log(rows @ np.exp(x) / times), start).x
    return [float(x) for x in np.exp(found)]


def _terms(s: Size) -> tuple[float, ...]:
    return 1.0, s.joints**1.5, s.on_planes * s.joints, s.others


def expected_of(size: Size) -> float:
    """Seconds that a program of this size takes to compile on one core."""
    return float(np.dot(CONSTANTS, _terms(size)))


def expected(simulator: Any) -> float | None:
    """Seconds until a program of a `Simulator` is compiled; None where that was not
    measured (accelerators), or there is no physics to compile (``mujoco``).
    """
    if simulator.engine != "mjx" or not on_cpu():
        return None
    return expected_of(size_of(simulator.base.mjx))

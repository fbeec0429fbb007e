"""Where a machine was in its logs: what of a simulation these states need."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import hidden_in_any
from easi_jax.model.addresses import resolve
from easi_jax.model.contact_pairs import (
    Pair,
    geom_name,
    never_near,
    pair_ids,
    without_pairs,
)
from easi_jax.model.quantities import length_of, long_axis

_MOST = 512  # states that a comparison of engines chooses from
_LISTED = 5


@dataclass(frozen=True, eq=False)
class Logged:
    """States of a machine in its logs, in order.

    Attributes:
        qpos: positions, ``(K, nq)`` [m, rad].
        qvel: velocities, ``(K, nv)`` [m/s, rad/s].
        ctrl: commands, ``(K, nu)``.
        hidden: degrees of freedom that nobody measured, ``(nv,)`` bool, whose positions
            and velocities are a guess.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    hidden: np.ndarray | None = None

    @staticmethod
    def of(runs: Sequence[Run]) -> "Logged":
        """All rows of some runs."""
        columns = zip(*((r.qpos, r.qvel, r.ctrl) for r in runs), strict=True)
        return Logged(*map(np.concatenate, columns), hidden=hidden_in_any(runs))

    def states(
        self, m: mujoco.MjModel
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities, activations and commands of some of them, evenly, as
        `easi_jax.simulation.guard.compare` takes them. Logs hold no activations: these
        are drawn."""
        rows = np.unique(np.linspace(0, len(self.qpos) - 1, _MOST).astype(int))
        act = np.random.default_rng(0).uniform(0.05, 0.95, (len(rows), m.na))
        return self.qpos[rows], self.qvel[rows], act, self.ctrl[rows]


def apart_in(
    logged: Logged,
    m: mujoco.MjModel,
    values: Iterable[tuple[Sequence[str], Sequence[float]]],
) -> frozenset[Pair]:
    """Pairs of geoms that never come near each other in the log.

    Args:
        logged: the states.
        m: the model.
        values: addresses that vary, each with the values that it may take; a geom that
            may be longer reaches further.
    """
    more: dict[int, float] = {}
    for addresses, ends in values:
        for w in resolve(m, [addresses]):
            if w.quantity != "length" or w.kind == "effect":
                continue
            g = w.id
            old = float(length_of(int(m.geom_type[g]), long_axis(m, g), m.geom_size[g]))
            share = 0.5 + float(np.linalg.norm(m.geom_pos[g])) / old
            moved = share * max(abs(float(x) - old) for x in ends)
            more[g] = max(more.get(g, 0.0), moved)
    return never_near(m, logged.qpos, more, logged.hidden)


def apart_note(m: mujoco.MjModel, apart: frozenset[Pair]) -> str:
    """What is left out, in words; empty where nothing is."""
    every = pair_ids(m)
    kept = pair_ids(without_pairs(m, apart))
    if len(kept) == len(every):
        return ""
    names = ["/".join(geom_name(m, g) for g in pair) for pair in kept]
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    stay = f"; {', '.join(names[:_LISTED])}{more} stay" if names else ""
    return (
        f"{len(every) - len(kept)} of {len(every)} pairs of geoms never come near each "
        f"other in the log, and MJX leaves them out{stay} (--engine mujoco simulates "
        "all)"
    )

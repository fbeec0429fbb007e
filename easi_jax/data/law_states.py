"""What laws remember in the rows of a recording, and the time of those rows."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.windows import fitted_velocity
from easi_jax.model import effects
from easi_jax.model.law_terms import Known, Memory, Term
from easi_jax.model.own_laws import Law

_SMALL = 1e5  # s; single precision tells 10 ms apart until then


def times(run: Run) -> np.ndarray:
    """Of the rows [s], ``(T,)``: as logged, so that what was cut out of a recording
    keeps its own; from the run's start where the clock counts years."""
    large = np.abs(run.time).max(initial=0.0) > _SMALL
    return run.time - run.time[0] if large else run.time


def known_rows(law: Law, run: Run) -> Known:
    """All rows of a run, as terms are evaluated on."""
    speed = fitted_velocity(run.qpos, run.dt, run.configuration)
    return law.known(run.qpos.T, speed.T, run.ctrl.T, times(run))


def memory_path(memory: Memory, known: Known, dt: float) -> np.ndarray:
    """States of one memory in all rows, ``(T,)``, from a start as
    `easi_jax.model.own_laws.first_states` has it."""
    target, rate = (np.asarray(x, float) for x in memory.follows(known))
    target, rate = np.broadcast_arrays(target, rate)
    first = target[0] if memory.kind == "lag" else 0.0
    path = _followed(first, target[:-1], np.exp(-rate[:-1] * dt))
    return np.concatenate([[first], np.asarray(path, float)])


def term_path(term: Term, known: Known, dt: float) -> np.ndarray:
    """A term in all rows, ``(T,)``, what it remembers included."""
    memory = tuple(memory_path(x, known, dt) for x in term.memories)
    return np.asarray(term.value(known, memory), float)


@jax.jit
def _followed(first: Any, target: Any, left: Any) -> jax.Array:
    """States after each row, of which a share ``left`` stays."""

    def row(state: Any, now: Any) -> Any:
        goal, share = now
        state = goal + (state - goal) * share
        return state, state

    return jax.lax.scan(row, jnp.asarray(first, target.dtype), (target, left))[1]


def law_states(m: mujoco.MjModel, run: Run) -> np.ndarray:
    """States of all laws of a model in the rows of a run, ``(T, S)``."""
    memories = [(law, x) for law in effects.laws_of(m) for x in law.memories]
    if not memories:
        return np.zeros((len(run), 0))
    known = known_rows(memories[0][0], run)  # names of the model, as all laws have them
    return np.stack([memory_path(x, known, run.dt) for _, x in memories], 1)

"""What small changes of a model do to its predictions, without simulating them.

Along the motion of a window under one vector, the state after some rows is linear in
the state before and in the torques that act meanwhile, x[k+1] = A[k] x[k] + B[k] f[k].
A and B are differences of simulations. What an effect adds to f at a state is what it
does to a single physics step from there; how long a window is, and how many steps a
row has, hardly matters then. Play of a gear and faults of readings are no torques: they
have to be simulated. So is everything where A and B do not tell what a constant torque
does, as where feet stick and slip, and what a limit of force cuts off.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.devices.mesh import sharded_map
from easi_jax.devices.runtime import quick_compile
from easi_jax.gap.predictor import BLOCK, Predictor, Window
from easi_jax.model.effect_numbers import OWN
from easi_jax.simulation.step import Physics, arrived_step

_SPACING = 0.01  # s between states, at most: commands and drives change in as much
_MOVED = 1e-3  # of the largest motion: a difference
_LEAST, _MOST = 1e-4, 1e-2  # of it [rad, m]: single precision; still a small angle
_ALIKE = 0.1  # of what a torque does, that the recursion may be off in a window
_STUCK = 1e-3  # of the most that a torque does: less is none
# Fields of `Effects` that are no torques of a state, or change with it at once.
_SIMULATED = frozenset(
    (
        *("bias", "late", "width", "rotor", "limit", "friction", "softness"),
        *("slip", "give", OWN),
    )
)
_BATCH = 8  # vectors at once on each device


class LinearResponse:
    """Changes of the predictions of some windows about one vector.

    Args:
        predictor: predictions by native MuJoCo, without sensors.
        x: the vector ``(n,)``.
        blocks: blocks of windows ``(nb,)``.
        moved: offsets of the windows' starts ``(W, s)``.

    Attributes:
        holds: windows in which constant torques do what simulations say they do,
            ``(W,)`` bool.
    """

    def __init__(
        self, predictor: Predictor, x: np.ndarray, blocks: np.ndarray, moved: np.ndarray
    ) -> None:
        self.predictor, self.x, self.blocks = predictor, x, blocks
        self.count = len(moved)  # of windows; the last block may not be full
        p, steps = predictor, predictor.steps
        fits = [k for k in range(1, steps + 1) if steps % k == 0]
        dt = p.simulator.dt
        self.rows = max(k for k in fits if k == 1 or k * dt <= _SPACING)
        size = np.clip(_MOVED * p.largest[: p.nv], _LEAST, _MOST)
        speed = size / (self.rows * dt)
        self._sizes = np.r_[size, speed, np.full(p.size - 2 * p.nv, _MOVED)]
        self._acceleration = speed / (self.rows * dt)
        self._offsets = np.zeros((len(blocks), BLOCK, p.size), np.float32)
        self._offsets.reshape(-1, p.size)[: len(moved)] = moved
        self.middle: Physics
        self._linearize()
        index = (blocks[:, None] * BLOCK + np.arange(BLOCK)).reshape(-1)[: self.count]
        led = p.windows.led
        self._later = p.later(x, led[np.minimum(index, len(led) - 1)])
        self.holds = self._checked(moved)

    def covers(self, vectors: np.ndarray) -> np.ndarray:
        """Which vectors ``(B, n)`` differ by torques alone, ``(B,)`` bool."""
        p = self.predictor
        fixed = [
            p.own + i for i, c in enumerate(p.layout.columns) if c.field in _SIMULATED
        ]
        return (vectors[:, fixed] == self.x[fixed]).all(1)

    def changes(self, vectors: np.ndarray) -> np.ndarray:
        """Of errors from those of ``x``, ``(B, W, H + 1, channels)``."""
        torque = (self._speeds(vectors) - self._still).astype(float)  # of one step
        return self._paths(torque, self._torques)

    def impulses(self) -> np.ndarray:
        """Changes of errors by 1 N m (1 N at a slide) at each degree of freedom during
        the rows from one state to the next, one by one, ``(N, nv, W, H + 1,
        channels)``."""
        count, nv = self._torques.shape[1], self.predictor.nv
        each = np.eye(count * nv).reshape(count * nv, 1, count, nv)
        each = np.broadcast_to(each, (len(each), len(self._torques), count, nv))
        paths = self._paths(each, self._pushes)
        return paths.reshape(count, nv, *paths.shape[1:])

    def _paths(self, torque: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Changes of errors ``(B, W, H + 1, channels)`` by what a torque ``(B, W, N,
        nv)`` does ``by (W, N, s, nv)``."""
        nv = self.predictor.nv
        path = np.zeros((*torque.shape[:3], 2 * nv))
        state = np.zeros((*torque.shape[:2], self.predictor.size))
        for k in range(torque.shape[2]):
            state = np.einsum("wij,bwj->bwi", self._after[:, k], state)
            state += np.einsum("wij,bwj->bwi", by[:, k], torque[:, :, k])
            path[:, :, k] = state[..., : 2 * nv]
        each = _each_row(path, self.rows)[:, : self.count]
        if self._later.any():
            ends = 2 * each[:, :, -1:] - each[:, :, -2:-1]
            ahead = np.diff(np.concatenate([each, ends], 2), axis=2)
            each += np.tile(self._later, 2)[:, None] * ahead
        return self.predictor.whole(each[..., :nv], each[..., nv:])

    # -- programs --------------------------------------------------------------

    def _program(self, fun: Any, left_out: tuple[str, ...]) -> Any:
        """``fun`` of this module, its first argument shared out among devices; kept
        with those of the predictor."""
        p, key = self.predictor, (fun, left_out, self.rows, self.predictor.steps)
        if key not in p.programs:

            def whole(sharded: Any, *shared: Any) -> Any:
                def local(some: Any, *shared: Any) -> Any:
                    return fun(p, left_out, self.rows, some, *shared)

                return sharded_map(local, p.mesh, sharded, *shared)

            p.programs[key] = jax.jit(whole, compiler_options=quick_compile())
        return p.programs[key]

    def _linearize(self) -> None:
        ((left_out, _),) = self.predictor.by_program(self.x[None])
        program = self._program(_linearized, left_out)
        sizes = self._sizes.astype(np.float32), self._acceleration.astype(np.float32)
        given = self.x.astype(np.float32), *sizes
        items = self.blocks.astype(np.int32), self._offsets
        self.middle, still, *found = program(items, *given, *self.predictor.data)
        self._still = np.asarray(still).reshape(-1, *still.shape[2:])
        after, torques, one = (
            np.nan_to_num(np.asarray(x, float).reshape(-1, *x.shape[2:])) for x in found
        )
        # What changes speeds in one step as much as a change does, over all of them.
        unit = self._acceleration[:, None]
        self._after = after
        felt = np.asarray(self.predictor.felt_inertia, float)
        self._pushes = torques / (self._acceleration * felt)
        self._torques = torques @ np.linalg.pinv(one / unit, rcond=_STUCK) / unit.T

    def _speeds(self, vectors: np.ndarray) -> np.ndarray:
        """After one physics step from each state, ``(B, W, N, nv)``."""
        p = self.predictor
        out = np.empty((len(vectors), *self._still.shape), np.float32)
        for left_out, at in p.by_program(vectors):
            program = self._program(_stepped, left_out)
            for i in range(0, len(at), _BATCH * p.devices):
                some = at[i : i + _BATCH * p.devices]
                filled = np.resize(some, _BATCH * p.devices)
                given = self.blocks.astype(np.int32), self._offsets, self.middle
                got = program(vectors[filled].astype(np.float32), *given, *p.data)
                got = np.asarray(got).reshape(len(filled), *out.shape[1:])
                out[some] = got[: len(some)]
        return out

    def _checked(self, moved: np.ndarray) -> np.ndarray:
        """`holds`, by constant torques at all joints; nowhere if there are none."""
        p = self.predictor
        at = [i for i, c in enumerate(p.layout.columns) if c.field == "constant"]
        if not at:
            return np.zeros(self.count, bool)
        vectors = np.repeat(self.x[None], len(at), 0)
        vectors[np.arange(len(at)), np.array(at, int) + p.own] += [
            p.layout.columns[i].size for i in at
        ]
        asked = np.concatenate([self.x[None], vectors])
        every = np.broadcast_to(moved, (len(asked), *moved.shape))
        errors = p.motion(p.errors(asked, self.blocks, every).astype(float))[0]
        true = (errors[1:] - errors[0])[:, : self.count]
        with np.errstate(invalid="ignore", over="ignore"):
            off = p.motion(self.changes(vectors))[0] - true
            share = np.sqrt((off**2).sum((2, 3)) / (true**2).sum((2, 3)))
        return (share <= _ALIKE).all(0)


def _each_row(path: np.ndarray, rows: int) -> np.ndarray:
    """Paths after every ``rows`` rows ``(B, W, N, nv)`` as those of each row from the
    start on, ``(B, W, N rows + 1, nv)``."""
    path = np.concatenate([np.zeros_like(path[:, :, :1]), path], 2)
    share = np.arange(rows) / rows
    first, last = path[:, :, :-1, None], path[:, :, 1:, None]
    between = first + share[:, None] * (last - first)
    flat = between.reshape(*path.shape[:2], -1, path.shape[-1])
    return np.concatenate([flat, path[:, :, -1:]], 2)


def _linearized(
    p: Predictor,
    left_out: tuple[str, ...],
    rows: int,
    blocks: tuple[jax.Array, jax.Array],
    x: jax.Array,
    sizes: jax.Array,
    acceleration: jax.Array,
    *data: jax.Array,
) -> tuple[Physics, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Of blocks of windows ``(nb,)``, with offsets of their starts: states in the
    middle of every ``rows`` rows, and speeds one physics step later; derivatives of the
    state after them with that before ``(nb, BLOCK, N, s, s)`` and with torques that
    accelerate so much, held for all of them ``(nb, BLOCK, N, s, nv)``; and what the
    same torques do to speeds in one physics step from the middle ``(nb, BLOCK, N, nv,
    nv)``."""
    model = p.model(x, left_out, ("constant",))
    e, nv = model.effects, p.nv
    assert e is not None
    torque = acceleration * e.effective_inertia

    def pushed(direction: jax.Array) -> Any:
        return model.replace(effects=e.replace(constant=e.constant + direction))

    def off(first: Physics, other: Physics) -> jax.Array:
        both = (first.qpos, first.qvel, other.qpos, other.qvel)
        path = p.simulator.difference(*both)
        return jnp.concatenate([path, other.act - first.act])

    def window(w: Window, moved: jax.Array) -> tuple:
        _, _, first, arrived = p.begun(model, w, moved)
        parts = _parts(arrived, p.steps, rows)
        half = parts.shape[1] // 2

        def on(state: Physics, u: jax.Array) -> tuple[Physics, tuple]:
            middle = arrived_step(model, state, u[:half]) if half else state
            end = arrived_step(model, middle, u[half:])
            return end, (state, middle, end)

        _, (before, middle, after) = jax.lax.scan(on, first, parts)

        def of_state(direction: jax.Array, state: Physics, u: Any, end: Any) -> Any:
            other = state.replace(
                qpos=p.simulator.move(state.qpos, direction[:nv]),
                qvel=state.qvel + direction[nv : 2 * nv],
                act=state.act + direction[2 * nv :],
            )
            return off(end, arrived_step(model, other, u))

        def of_torque(direction: jax.Array, state: Physics, u: Any, end: Any) -> Any:
            return off(end, arrived_step(pushed(direction), state, u))

        def one(direction: jax.Array, state: Physics, u: Any) -> jax.Array:
            return arrived_step(pushed(direction), state, u.mean(0)[None]).qvel

        each = jax.vmap(of_state, (None, 0, 0, 0), 0)
        after_state = jax.vmap(each, (0, None, None, None), -1)
        each = jax.vmap(of_torque, (None, 0, 0, 0), 0)
        after_torque = jax.vmap(each, (0, None, None, None), -1)
        each = jax.vmap(jax.vmap(one, (None, 0, 0), 0), (0, None, None), -1)
        still = each(jnp.zeros((1, nv)), middle, parts)
        return (
            middle,
            still[..., 0],
            after_state(jnp.diag(sizes), before, parts, after) / sizes,
            after_torque(jnp.diag(torque), before, parts, after),
            each(jnp.diag(torque), middle, parts) - still,
        )

    which, moved = blocks
    return jax.vmap(jax.vmap(window))(_some(which, data), moved)


def _stepped(
    p: Predictor,
    left_out: tuple[str, ...],
    rows: int,
    x: jax.Array,
    blocks: jax.Array,
    moved: jax.Array,
    middle: Physics,
    *data: jax.Array,
) -> jax.Array:
    """Speeds after one physics step from each state ``middle (nb, BLOCK, N, ...)`` of
    some blocks under vectors ``(B, n)``, ``(B, nb, BLOCK, N, nv)``."""

    def of_vector(x: jax.Array) -> jax.Array:
        model = p.model(x, left_out)

        def window(w: Window, moved: jax.Array, states: Physics) -> jax.Array:
            arrived = p.begun(model, w, moved)[-1]
            sent = _parts(arrived, p.steps, rows).mean(1)

            def one(state: Physics, u: jax.Array) -> jax.Array:
                return arrived_step(model, state, u[None]).qvel

            return jax.vmap(one)(states, sent)

        of_block = jax.vmap(jax.vmap(window))
        return of_block(_some(blocks, data), moved, middle)

    return jax.vmap(of_vector)(x)


def _some(which: jax.Array, data: tuple[jax.Array, ...]) -> Window:
    """Blocks of windows."""
    return jax.tree.map(lambda a: a[which], Window(*data))


def _parts(arrived: jax.Array, steps: int, rows: int) -> jax.Array:
    """Commands of the physics steps of every ``rows`` rows, ``(N, k, nu)``."""
    _, each, nu = arrived.shape
    return arrived[:steps].reshape(steps // rows, rows * each, nu)

"""EASI on logs of a robot that walks under its own controller: nothing is paired.

Nobody knows where such a robot was, so no simulation can start where a piece of its log
does. Every individual runs the controller instead, and the discriminator compares short
pieces of what sensors read, and of that alone: the readings and commands of a few rows,
and what the next row reads. So do EASI (NeurIPS 2024), for the Go2, and proprioceptive
distribution matching (arXiv 2604.11090).

What the next row reads is seen less the best linear prediction from the rows before, as
simulations of the generation have it: the discriminator then looks at how the robot
answers its commands, and little at where it happened to be.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from easi_jax.data.proprioception import Proprioception
from easi_jax.devices import distributed
from easi_jax.devices.mesh import placed, sharded_map
from easi_jax.devices.runtime import fast_loops
from easi_jax.errors import UserError
from easi_jax.model.parameters import Parameter
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchState, moments, pick
from easi_jax.simulation.reading import reading_env
from easi_jax.simulation.rollout import policy_rollout

MEMORY = 2  # rows before the last one that a prediction sees; delays show in them
_RIDGE = 1e-4  # of the features' variance, which nearly repeat each other
_SETTLED = 1.0  # s after a reset, in which a simulated gait is not yet a gait
_LIVED = 0.25  # of a rollout, at least, that must count
_CLIP = 4.0  # spreads of what is not predicted, from which on it is an outlier
_LATE = 2  # rows that the reading of a sensor may come late


@flax.struct.dataclass
class Pieces:
    """Pieces of what sensors read.

    Attributes:
        before: readings and commands of `MEMORY` + 1 rows, ``(..., F)``.
        change: how readings change to the next row, ``(..., C)``.
        weight: 1 where a piece counts, ``(...)``.
    """

    before: Any
    change: Any
    weight: Any


@flax.struct.dataclass
class UnpairedData:
    """What a search compares with.

    Attributes:
        pieces: of the log, ``(K, ...)``.
        noise: of readings, standard deviations ``(C,)``.
        policy: of the controller.
    """

    pieces: Pieces
    noise: jax.Array
    policy: Any


def pieces_of(rows: jax.Array, ctrl: jax.Array, weight: jax.Array) -> Pieces:
    """Pieces of readings ``(T, C)`` and commands ``(T, nu)``, ``T - MEMORY - 1`` of
    them; a row weighs ``weight (T,)``, 0 where the next one is none of the same run."""
    count = rows.shape[0] - MEMORY - 1
    past = [x[k : k + count] for k in range(MEMORY + 1) for x in (rows, ctrl)]
    now, then = (rows[MEMORY + k : MEMORY + k + count] for k in (0, 1))
    each = jnp.stack([weight[k : k + count] for k in range(MEMORY + 1)])
    return Pieces(jnp.concatenate(past, -1), then - now, each.min(0))


def linear_prediction(
    before: jax.Array, change: jax.Array, weight: jax.Array
) -> Callable[[jax.Array], jax.Array]:
    """The linear map from ``before (S, F)`` to ``change (S, C)`` of least squared
    error."""
    total = jnp.maximum(weight.sum(), 1.0)
    mid, std = moments(before, weight)
    out_mid = weight @ change / total
    x = (before - mid) / std
    gram = (x * weight[:, None]).T @ x / total + _RIDGE * jnp.eye(x.shape[1])
    slope = jnp.linalg.solve(gram, (x * weight[:, None]).T @ (change - out_mid) / total)
    return lambda b: (b - mid) / std @ slope + out_mid


@dataclass(frozen=True)
class Delays:
    """How late each kind of reading comes; what a joint's position is read at is now.

    Attributes:
        parameters: a delay [s] for each kind.
        late: channels of each.
    """

    parameters: tuple[Parameter, ...] = ()
    late: tuple[slice, ...] = ()

    def read(self, rows: jax.Array, delays: jax.Array, dt: float) -> jax.Array:
        """Readings ``(T, C)`` of what happens, ``delays (k,)`` [s] late: they lie
        between rows of before."""
        for at, late in zip(self.late, delays, strict=True):
            shares = jnp.maximum(0.0, 1.0 - jnp.abs(late / dt - jnp.arange(_LATE + 1)))
            held = jnp.concatenate([jnp.repeat(rows[:1, at], _LATE, 0), rows[:, at]])
            past = [held[_LATE - k : held.shape[0] - k] for k in range(_LATE + 1)]
            moved = sum(s * x for s, x in zip(shares, past, strict=True))
            rows = rows.at[:, at].set(moved)
        return rows


def reading_delays(of: Proprioception, dt: float) -> Delays:
    """Delays, up to `_LATE` control steps ``dt`` [s], of all kinds of readings but
    joint positions and whether something touches."""
    kinds = of.kinds.items()
    late = {k: at for k, at in kinds if k != "qpos" and not of.touches[at].any()}
    ends = 0.0, _LATE * dt
    parameters = [
        Parameter(name, (name,), 0.0, ends, ends, "s", log=False)
        for name in (f"reading.{kind}.delay" for kind in late)
    ]
    return Delays(tuple(parameters), tuple(late.values()))


def centered(rows: jax.Array, weight: jax.Array, of: Proprioception) -> jax.Array:
    """Readings ``(T, C)``, those of sensors less their mean over rows that count: how
    far a sensor is off says nothing of the robot."""
    mean = weight @ rows / jnp.maximum(weight.sum(), 1.0)
    sensors = np.arange(len(of)) >= len(of.positions) + len(of.speeds)
    return rows - jnp.where(sensors & ~of.touches, mean, 0.0)


def compared_steps(steps: int, dt: float) -> int:
    """How many of the control steps ``dt`` [s] of a simulation are compared.

    Raises:
        UserError: too few.
    """
    settled = round(_SETTLED / dt)
    if steps < settled + MEMORY + 2:
        raise UserError(
            f"search rollout_steps is {steps}: the first {settled} ({_SETTLED:g} s) "
            f"are not compared, so give more than {settled + MEMORY + 1}"
        )
    return steps - settled


class UnpairedSearch(Search):
    """A search whose individuals run the controller, as in the module's description.

    Args:
        env: the robot.
        act: ``act(policy, obs, key) -> action``.
        of: channels that the log and the simulation have.
        delays: of their readings, searched with the parameters.
        config: settings; `SearchConfig.source` is policy.
        mesh: as for `Search`.
    """

    def __init__(
        self,
        env: Any,
        act: Callable[..., jax.Array],
        of: Proprioception,
        delays: Delays,
        config: SearchConfig,
        mesh: Mesh | None = None,
    ) -> None:
        env = reading_env(env, of.sensors)
        super().__init__(
            env.simulator, config, env, act, mesh=mesh, more=delays.parameters
        )
        self.of, self.delays = of, delays
        steps = config.rollout_steps
        self.settled = steps - compared_steps(steps, self.simulator.dt)

    def _width(self, data: UnpairedData) -> int:  # type: ignore[override]
        before, change = data.pieces.before, data.pieces.change
        return int(before.shape[-1] + change.shape[-1])

    def simulated(
        self,
        theta: jax.Array,
        data: UnpairedData,
        key: jax.Array,
        steps: int,
        common: bool,
    ) -> tuple[Pieces, jax.Array]:
        """What individuals ``theta (N, n)`` (SI), the delays of their readings among
        them, read while they run the controller for ``steps``.

        Returns:
            Pieces ``(N, K, ...)``, and which individuals stayed finite and on their
            feet, ``(N,)``. With ``common`` random numbers all begin alike and have the
            same noise.
        """
        n, of = self.simulator.space.size, self.of
        k_roll, k_noise = jax.random.split(key)
        if common:
            k_roll, k_noise = (
                jnp.broadcast_to(k, theta.shape[:1]) for k in (k_roll, k_noise)
            )
        else:
            k_roll, k_noise = (
                jax.random.split(k, theta.shape[0]) for k in (k_roll, k_noise)
            )

        def one(item: Any, policy: Any, noise: jax.Array) -> tuple[Pieces, jax.Array]:
            t, k, k_read = item
            model = self.simulator.model(t[:n])
            seg = policy_rollout(
                *(self.env, model, lambda obs, kk: self.act(policy, obs, kk)),  # type: ignore[misc]
                *(k, steps),
            )
            read = jnp.zeros((steps, 0)) if not len(of.sensors) else seg.sensed[:, 0]
            rows = of.channels(seg.qpos, seg.qvel, read)
            rows = self.delays.read(rows, t[n:], self.simulator.dt)
            rows += noise * jax.random.normal(k_read, rows.shape)
            ok = jnp.isfinite(rows).all(-1)
            rows = jnp.where(ok[:, None], rows, 0.0)
            rows, ctrl, weight = (
                x[self.settled :] for x in (rows, seg.ctrl[:, 0], seg.weight * ok)
            )
            pieces = pieces_of(centered(rows, weight, of), ctrl, weight)
            return pieces, ok.all() & (pieces.weight.mean() >= _LIVED)

        def chunk(items: Any, policy: Any, noise: jax.Array) -> Any:
            return jax.lax.map(
                lambda item: one(item, policy, noise),
                items,
                batch_size=self.simulator.batch,
            )

        given = (theta, k_roll, k_noise), data.policy, data.noise
        return sharded_map(chunk, self.mesh, *given)

    def _simulate(  # type: ignore[override]
        self, state: SearchState, data: UnpairedData, population: jax.Array, key: Any
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Any]:
        c = self.config
        k_pick, k_roll = jax.random.split(key)
        theta = self.space.to_si(population)
        fake, sound = self.simulated(
            theta, data, k_roll, c.rollout_steps, c.common_random_numbers
        )
        count = min(c.real_batch, data.pieces.weight.shape[0])
        rows = pick(k_pick, data.pieces.weight, count)
        real = jax.tree.map(lambda x: x[rows], data.pieces)
        weight = fake.weight * sound[:, None]
        flat = (x.reshape(-1, *x.shape[2:]) for x in (fake.before, fake.change, weight))
        predicted = linear_prediction(*flat)
        mid, std = moments(data.pieces.before, data.pieces.weight)

        def shown(p: Pieces, spread: Any = 1.0) -> tuple[jax.Array, jax.Array]:
            return (p.before - mid) / std, (p.change - predicted(p.before)) / spread

        out, weigh = shown(fake)[1], weight[..., None]
        spread = jnp.sqrt((out**2 * weigh).sum((0, 1)) / jnp.maximum(weight.sum(), 1.0))
        spread = jnp.sqrt(spread**2 + (shown(real)[1] ** 2).mean(0))
        spread = jnp.where(spread > 0, spread, 1.0)

        def inputs(p: Pieces) -> jax.Array:
            parts = (jnp.clip(x, -_CLIP, _CLIP) for x in shown(p, spread))
            return jnp.concatenate([*parts], -1)

        fakes = jnp.where(weigh > 0, inputs(fake), 0.0)
        return inputs(real), fakes, weight, sound, ()


class Simulations:
    """Simulations of individuals outside of a search's generations, one program.

    Args:
        search: whose individuals they are, and ``data`` what it compares with.
    """

    size = 128  # of a call

    def __init__(self, search: UnpairedSearch, data: UnpairedData) -> None:
        self.search, steps = search, search.config.rollout_steps

        def simulated(theta: jax.Array, data: UnpairedData, key: jax.Array) -> Any:
            return search.simulated(theta, data, key, steps, common=False)

        like = jnp.zeros((self.size, search.space.size)), data, jax.random.key(0)
        program = jax.jit(simulated, compiler_options=fast_loops())
        self._program, self._data = program.lower(*placed(like)).compile(), data

    def __call__(self, unit: np.ndarray, key: jax.Array) -> tuple[Pieces, np.ndarray]:
        """What individuals ``unit (N, n)`` read, double precision, and which stayed
        finite and on their feet, ``(N,)``; each by itself, from its own start."""
        out = []
        for k, first in enumerate(range(0, len(unit), self.size)):
            some = np.resize(
                unit[first : first + self.size], (self.size, unit.shape[1])
            )
            theta = self.search.space.to_si(jnp.asarray(some, float))
            given = placed((theta, self._data, jax.random.fold_in(key, k)))
            out.append(distributed.local(self._program(*given)))
        whole = jax.tree.map(lambda *x: np.concatenate(x)[: len(unit)], *out)
        pieces, sound = whole
        return jax.tree.map(lambda x: np.asarray(x, float), pieces), sound

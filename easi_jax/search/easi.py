"""The EASI search: one generation as a pure function, all of them in one scan.

Algorithm 1 of EASI (NeurIPS 2024): sample individuals, simulate them, train the
discriminator on measured against simulated transitions, let its mean score be the
fitness, update the distribution.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import make_mesh, sharded_map
from easi_jax.errors import UserError
from easi_jax.model.distribution import gaussian
from easi_jax.model.joint_space import widths
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.search import discriminator as critic
from easi_jax.search.config import SearchConfig
from easi_jax.search.evolution import make_strategy
from easi_jax.simulation import open_loop
from easi_jax.simulation.rollout import last_seen, policy_rollout
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.slopes import shift_start

_USUAL_UPDATES = 20  # of the discriminator in a generation
_CLIP = 4.0  # innovations beyond this many spreads are outliers
# Inputs that are larger teach the discriminator "far" before "on which side".
_WIDER = 2.0**0.5


@flax.struct.dataclass
class SearchData:
    """What a search compares with.

    Attributes:
        segments: measured pieces of ``horizon`` steps (1 for policy rollouts).
        noise: measurement noise of positions and velocities, ``(2 nv,)`` standard
            deviations, added to what is simulated. Zero where there is none; where
            hidden, how far a start may be off.
        hidden: positions and velocities that nobody measured, ``(2 nv,)`` bool, which
            the discriminator is not told; () where there are none.
        policy: parameters of the controller, for ``source="policy"``.
    """

    segments: Segments
    noise: jax.Array
    policy: Any = None
    hidden: Any = ()


@flax.struct.dataclass
class SearchState:
    """All that a search carries; saved in checkpoints.

    Attributes:
        mean, cov: the distribution in unit coordinates, ``(n,)``, ``(n, n)``.
        result_mean, result_cov: what `last_evaluation` says is the result.
        observed: by `stale_first_observation`, where each individual's trajectory of
            the generation before ended, ``(N, obs_size)``; () without it.
    """

    strategy: Any
    critic: critic.CriticState
    mean: jax.Array
    cov: jax.Array
    result_mean: jax.Array
    result_cov: jax.Array
    generation: jax.Array
    key: jax.Array
    training: Any
    observed: Any = ()


@flax.struct.dataclass
class SearchInfo:
    """What one generation reports.

    Attributes:
        mean, std: the distribution after it, unit coordinates, ``(n,)``.
        loss: discriminator loss of its last step.
        score: mean score of the individuals; ``best`` the highest.
        non_finite: individuals whose simulation was no longer finite.
        at_bound: individuals clipped to a bound, per parameter, ``(n,)``.
        suspects: how far the non-finite individuals are from the others (or, where
            there are no others, from the nominal values), per parameter, ``(n,)``.
        training: info of policy training, where there is some.
    """

    mean: jax.Array
    std: jax.Array
    loss: jax.Array
    score: jax.Array
    best: jax.Array
    non_finite: jax.Array
    at_bound: jax.Array
    suspects: jax.Array
    training: Any


class Search:
    """EASI on a machine: ``init``, ``step`` and ``run`` are pure.

    Args:
        simulator: what is simulated; its space starts where the search starts.
        config: settings.
        env: environment for ``source="policy"``.
        act: ``act(policy, obs, key) -> action`` for ``source="policy"``.
        trainer: ``step(state, distribution) -> (state, info)`` of policy training,
            for ``policy_updates_per_generation``.
        mesh: devices to spread the population over (default: all).
        more: numbers that are searched besides the simulator's, none of its model.
    """

    def __init__(
        self,
        simulator: Simulator,
        config: SearchConfig,
        env: Any = None,
        act: Callable[..., jax.Array] | None = None,
        trainer: Callable[..., Any] | None = None,
        mesh: Mesh | None = None,
        more: tuple[Parameter, ...] = (),
    ) -> None:
        if not simulator.space.size:
            raise UserError("no parameters to search for: name at least one")
        if config.source == "policy" and (env is None or act is None):
            raise ValueError('source="policy" needs env and act')
        if config.policy_updates_per_generation and trainer is None:
            raise ValueError("policy_updates_per_generation needs a trainer")
        self.simulator, self.config, self.env, self.act = simulator, config, env, act
        self.trainer = trainer if config.policy_updates_per_generation else None
        self.mesh = mesh or make_mesh()
        every = ParameterSpace((*simulator.space.parameters, *more))
        self.space = every.with_scale(config.log_scale)
        self.strategy = make_strategy(
            config.strategy,
            config.population,
            self.space.size,
            config.elite_ratio,
            config.spread_about,
            config.positive_weights,
        )
        self.critic_config = critic.CriticConfig(
            hidden=config.hidden,
            loss=config.loss,
            regularizer=config.regularizer,
            clip_after_update=config.clip_after_update,
            learning_rate=config.learning_rate * _pace(config),
            epsilon_in_root=config.epsilon_in_root,
            loss_scale=0.5 if config.half_loss else 1.0,
        )

    # -- state ---------------------------------------------------------------

    def init(self, key: jax.Array, data: SearchData, training: Any = ()) -> SearchState:
        """Starts from the space's initial range, moment-matched.

        ``training`` is the trainer's state, where the search trains a policy too.
        """
        n = self.space.size
        k_es, k_critic, k_run = jax.random.split(key, 3)
        mean, std = jnp.full(n, 0.5), jnp.full(n, 12.0**-0.5)
        stale = self.config.stale_first_observation
        size = (self.config.population, self.env.obs_size) if stale else ()
        cov = jnp.diag(std**2)
        return SearchState(
            strategy=self.strategy.init(k_es, mean, std),
            critic=critic.init(self.critic_config, k_critic, self._width(data)),
            mean=mean,
            cov=cov,
            result_mean=mean,
            result_cov=cov,
            generation=jnp.zeros((), jnp.int32),
            key=k_run,
            training=training if self.trainer else (),
            observed=jnp.zeros(size) if stale else (),
        )

    def _width(self, data: SearchData) -> int:
        """How many numbers the discriminator sees."""
        if self.config.observation_inputs:
            if isinstance(data.segments.seen, tuple):
                raise UserError(
                    "search observation_inputs compares what the controller saw, which "
                    "these demonstrations do not hold: record them with sees=True "
                    "(easi_jax.simulation.rollout.collect), or set "
                    "observation_inputs=false"
                )
            return int(data.segments.seen.shape[1])

        def inputs(s: Segments) -> tuple[jax.Array, jax.Array]:
            outcome = self._outcome(s, (s.next_qpos, s.next_qvel))
            return open_loop.features(self.simulator, s), outcome

        return sum(x.shape[1] for x in jax.eval_shape(inputs, data.segments))

    def run(
        self, state: SearchState, data: SearchData, generations: int
    ) -> tuple[SearchState, SearchInfo]:
        """``generations`` steps in one scan; info stacked along the first axis."""
        return jax.lax.scan(
            lambda s, _: self.step(s, data), state, None, length=generations
        )

    # -- one generation ------------------------------------------------------

    def step(
        self, state: SearchState, data: SearchData
    ) -> tuple[SearchState, SearchInfo]:
        """One generation of Algorithm 1."""
        c = self.config
        key, k_ask, k_sim, k_critic, k_tell = jax.random.split(state.key, 5)
        raw, es = self.strategy.ask(k_ask, state.strategy)
        if c.uniform_first_generation:
            uniform = jax.random.uniform(k_ask, raw.shape)
            raw = jnp.where(state.generation == 0, uniform, raw)
        low, high = self.space.unit_bounds
        population = jnp.clip(raw, low, high) if c.respect_bounds else raw

        simulated = self._simulate(state, data, population, k_sim)
        real, fake, weight, finite, observed = simulated
        trained, loss = self._train_critic(state.critic, k_critic, real, fake, weight)
        fitness = critic.fitness(self.critic_config, trained, fake, weight)
        neutral = None if c.positive_weights else state.mean
        told, cost = _only_finite(population, -fitness, finite, neutral)
        es_new = self.strategy.tell(k_tell, told, cost, es)
        mean, cov = self.strategy.moments(es_new, told, cost)
        # A generation without one finite simulation, or with all of one score, teaches
        # nothing: the first of them would be taken for the best.
        some = finite.any() & (cost.min() < cost.max())
        keep = lambda new, old: jax.tree.map(  # noqa: E731
            lambda a, b: jnp.where(some, a, b), new, old
        )
        es_new, mean, cov, trained = keep(
            (es_new, mean, cov, trained), (es, state.mean, state.cov, state.critic)
        )
        if c.respect_bounds:
            mean = jnp.clip(mean, low, high)
        training, training_info = state.training, ()
        if self.trainer:
            train_step, dist = self.trainer, gaussian(self.space, mean, cov)
            training, training_info = jax.lax.scan(
                lambda s, _: train_step(s, dist),
                training,
                None,
                length=c.policy_updates_per_generation,
            )
        result = (mean, cov) if c.last_evaluation else (state.mean, state.cov)
        new = SearchState(
            strategy=es_new,
            critic=trained,
            mean=mean,
            cov=cov,
            result_mean=result[0],
            result_cov=result[1],
            generation=state.generation + 1,
            key=key,
            training=training,
            observed=observed,
        )
        info = SearchInfo(
            mean=mean,
            std=jnp.sqrt(jnp.diag(cov)),
            loss=loss,
            score=jnp.where(finite, fitness, 0.0).sum() / jnp.maximum(finite.sum(), 1),
            best=jnp.max(jnp.where(finite, fitness, -jnp.inf)),
            non_finite=jnp.sum(~finite),
            at_bound=jnp.sum(raw != population, axis=0),
            suspects=self._suspects(population, finite),
            training=training_info,
        )
        return new, info

    def _suspects(self, population: jax.Array, finite: jax.Array) -> jax.Array:
        good = finite.astype(population.dtype)
        lost = (1.0 - good) @ population / jnp.maximum((1.0 - good).sum(), 1.0)
        kept = good @ population / jnp.maximum(good.sum(), 1.0)
        nominal = self.space.to_unit(jnp.asarray(self.space.nominal))
        apart = lost - jnp.where(finite.any(), kept, nominal)
        return jnp.where(finite.all(), 0.0, apart)

    def _train_critic(
        self,
        state: critic.CriticState,
        key: jax.Array,
        real: jax.Array,
        fake: jax.Array,
        weight: jax.Array,
    ) -> tuple[critic.CriticState, jax.Array]:
        c = self.config
        n, k = fake.shape[:2]
        take = min(c.fake_per_individual, k)
        batch = min(c.real_batch, real.shape[0])

        def update(s: Any, k_step: jax.Array) -> Any:
            k_real, k_fake, k_loss = jax.random.split(k_step, 3)
            if batch < real.shape[0]:
                rows = jax.random.randint(k_real, (batch,), 0, real.shape[0])
                chosen = real[rows]
            else:
                chosen = real
            cols = jax.random.randint(k_fake, (n, take), 0, k)
            some = jnp.take_along_axis(fake, cols[..., None], axis=1)
            w = jnp.take_along_axis(weight, cols, axis=1)
            return critic.update(
                self.critic_config,
                s,
                k_loss,
                chosen,
                some.reshape(n * take, -1),
                w.reshape(-1),
            )

        keys = jax.random.split(key, max(1, c.discriminator_updates))
        if not c.discriminator_updates:
            return state, jnp.zeros(())
        state, losses = jax.lax.scan(update, state, keys)
        return state, losses[-1]

    # -- simulation ----------------------------------------------------------

    def _simulate(
        self, state: SearchState, data: SearchData, population: jax.Array, key: Any
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Any]:
        """Discriminator inputs: real ``(K, F)``, simulated ``(N, K', F)``, weights
        ``(N, K')``, which individuals stayed finite ``(N,)``, and what the next state
        has as ``observed``."""
        theta = self.space.to_si(population)
        center = self.space.to_si(state.mean)
        if self.config.source == "replay":
            simulated = self._replay(data, theta, center, key)
        else:
            simulated = self._roll(state, data, theta, center, key)
        if self.config.observation_inputs:
            return self._observed(data, simulated[0], simulated[2])
        real_seg, real_ref, fake_seg, fake_ref = simulated
        real_out = self._outcome(real_seg, real_ref)
        fake_out = jax.vmap(self._outcome)(fake_seg, fake_ref)
        ok = jnp.isfinite(fake_out).all(-1)
        # Masked, counted and ranked last; zeros only keep NaN out of the sums.
        fake_out = jnp.where(ok[..., None], fake_out, 0.0)
        weight = fake_seg.weight * ok
        real_out, fake_out = self._scaled(data, real_out, fake_out, weight)
        real_out, fake_out = (self._told(data, x) for x in (real_out, fake_out))
        base = self._base_inputs(data)
        real = jnp.concatenate([base(real_seg), real_out], -1)
        fake = jnp.concatenate([jax.vmap(base)(fake_seg), fake_out], -1)
        fake = jnp.where(ok[..., None], fake, 0.0)
        return real, fake, weight, ok.all(1), ()

    def _observed(
        self, data: SearchData, real: Segments, fake: Segments
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Any]:
        """As `_simulate`: what the controller saw and did."""
        c, seen = self.config, fake.seen
        ok = jnp.isfinite(seen).all(-1)
        seen = jnp.where(ok[..., None], seen, 0.0)
        last = ()
        if c.stale_first_observation:
            last = last_seen(seen, self.env.obs_size)
        told, weight = real.seen, fake.weight * ok
        if c.standardize_inputs:
            mid, std = moments(data.segments.seen, data.segments.weight)
            told, seen = (told - mid) / std, (seen - mid) / std
        return told, seen, weight, ok.all(1), last

    def _replay(
        self, data: SearchData, theta: jax.Array, center: jax.Array, key: Any
    ) -> tuple[Segments, Any, Segments, Any]:
        """Every individual replays the same measured pieces."""
        c, nv = self.config, self.simulator.mj_model.nv
        k_pick, k_start, k_end = jax.random.split(key, 3)
        count = data.segments.count
        seg = data.segments
        if c.segments < count:
            seg = seg.take(pick(k_pick, seg.weight, c.segments))
        m, n = seg.qpos.shape[0], theta.shape[0]
        # What is simulated gets the noise that what is measured has: in its start
        # (the log's start is off by it) and in its end, the same for everybody.
        z = data.noise * jax.random.normal(k_start, (m, 2 * nv))
        spread = (
            data.noise
            if isinstance(data.hidden, tuple)
            else jnp.where(data.hidden, 0.0, data.noise)
        )
        noise = spread * jax.random.normal(k_end, (m, c.horizon, 2 * nv))
        starts = (shift_start(self.simulator, seg, z), seg)

        def states(chunk: Any, starts: Any) -> Any:
            def one(item: Any) -> Any:
                t, exact = item
                start = jax.tree.map(
                    lambda a, b: jnp.where(exact, b, a), starts[0], starts[1]
                )
                return open_loop.predict(self.simulator, self.simulator.model(t), start)

            return jax.lax.map(one, chunk, batch_size=max(1, self.simulator.batch // m))

        # The mean model goes along as one more individual, from the starts as
        # measured: one compiled simulation serves both.
        everyone = jnp.concatenate([theta, center[None]])
        exact = jnp.arange(n + 1) == n
        out = sharded_map(states, self.mesh, (everyone, exact), starts)
        (qpos, qvel), reference = (
            jax.tree.map(lambda x, s=s: x[s], out) for s in (slice(n), n)
        )
        qpos = self.simulator.move(qpos, noise[..., :nv])
        tile = lambda x: jnp.broadcast_to(x, (n, *x.shape))  # noqa: E731
        fake = Segments(
            qpos=tile(seg.qpos),
            qvel=tile(seg.qvel),
            ctrl=tile(seg.ctrl),
            next_qpos=qpos,
            next_qvel=qvel + noise[..., nv:],
            weight=tile(seg.weight),
            past=jax.tree.map(tile, seg.past),
            act=jax.tree.map(tile, seg.act),
            time=jax.tree.map(tile, seg.time),
            hidden=jax.tree.map(tile, seg.hidden),
        )
        return seg, reference, fake, jax.tree.map(tile, reference)

    def _roll(
        self,
        state: SearchState,
        data: SearchData,
        theta: jax.Array,
        center: jax.Array,
        key: Any,
    ) -> tuple[Segments, Any, Segments, Any]:
        """Every individual runs the controller from a reset."""
        c, n = self.config, theta.shape[0]
        k_pick, k_roll = jax.random.split(key)
        keys = jax.random.split(k_roll, n)
        if c.common_random_numbers:
            keys = jnp.broadcast_to(keys[:1], keys.shape)
        model = self.simulator.model(center)

        def trajectories(chunk: Any, policy: Any, model: Any) -> Any:
            def one(item: Any) -> Any:
                t, k, *stale = item
                seg = policy_rollout(
                    self.env,
                    self.simulator.model(t),
                    lambda obs, kk: self.act(policy, obs, kk),  # type: ignore[misc]
                    k,
                    c.rollout_steps,
                    auto_reset=c.crosses_resets,
                    past=self.simulator.past_steps,
                    sees=c.observation_inputs,
                    stale=stale[0] if stale else None,
                )
                return seg, self._reference(model, seg)

            return jax.lax.map(one, chunk, batch_size=self.simulator.batch)

        items = (theta, keys)
        if c.stale_first_observation:
            items += (state.observed,)
        fake, reference = sharded_map(
            trajectories, self.mesh, items, data.policy, model
        )
        # Each step of the discriminator draws its batch from all that was measured,
        # but where a prediction is needed of each row.
        known = data.segments
        count = known.count
        if c.innovation_inputs:
            count = min(c.real_batch, count)
        if c.crosses_resets:
            fake = dataclasses.replace(fake, weight=jnp.ones_like(fake.weight))
            known = dataclasses.replace(known, weight=jnp.ones_like(known.weight))
        real = known.take(pick(k_pick, known.weight, count))
        return real, self._reference(model, real), fake, reference

    # -- discriminator inputs ------------------------------------------------

    def _reference(self, center: Any, seg: Segments) -> Any:
        """The mean model's prediction, where the inputs need it."""
        if not self.config.innovation_inputs:
            return ()
        return open_loop.predict(self.simulator, center, seg)

    def _outcome(self, seg: Segments, reference: Any) -> jax.Array:
        """Innovation, s' - s or s', flat ``(M, H 2 nv)``."""
        if self.config.innovation_inputs:
            states = (seg.next_qpos, seg.next_qvel)
            out = open_loop.prediction_residuals(self.simulator, reference, states)
        elif self.config.delta_inputs:
            out = open_loop.motion(self.simulator, seg)
        else:
            out = jnp.concatenate([seg.next_qpos, seg.next_qvel], axis=-1)
        return out.reshape(seg.qpos.shape[0], -1)

    def _scaled(
        self, data: SearchData, real: jax.Array, fake: jax.Array, weight: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Outcomes in units of order one."""
        c = self.config
        if c.innovation_inputs:
            # The spread of both, anew each generation: inputs stay in range however
            # narrow the population is, and however far from what was measured. In
            # units of its own spread, what is measured far away is out of range on
            # either side and says no more than "far".
            square = (fake**2 * weight[..., None]).sum((0, 1))
            mean_square = square / jnp.maximum(weight.sum(), 1.0)
            spread = _WIDER * jnp.sqrt(mean_square + (real**2).mean(0))
            spread = jnp.where(spread > 0, spread, 1.0)
            return (
                jnp.clip(real / spread, -_CLIP, _CLIP),
                jnp.clip(fake / spread, -_CLIP, _CLIP),
            )
        if c.standardize_inputs:
            known = self._outcome(data.segments, ())
            mid, std = moments(known, data.segments.weight)
            return (real - mid) / std, (fake - mid) / std
        return real, fake

    def _told(self, data: SearchData, outcome: jax.Array) -> jax.Array:
        """Outcomes ``(..., F)`` without what nobody measured."""
        if isinstance(data.hidden, tuple):
            return outcome
        c, hidden = self.config, data.hidden
        if not (c.innovation_inputs or c.delta_inputs):
            m = self.simulator.mj_model
            joints = np.repeat(
                np.arange(m.njnt), [widths(m, j)[0] for j in range(m.njnt)]
            )
            hidden = jnp.concatenate([hidden[m.jnt_dofadr[joints]], hidden[m.nv :]])
        steps = outcome.shape[-1] // len(hidden)
        return jnp.where(jnp.tile(hidden, steps), 0.0, outcome)

    def _base_inputs(self, data: SearchData) -> Callable[[Segments], jax.Array]:
        if not self.config.standardize_inputs:
            return lambda seg: open_loop.features(self.simulator, seg)
        known = open_loop.features(self.simulator, data.segments)
        mid, std = moments(known, data.segments.weight)
        return lambda seg: (open_loop.features(self.simulator, seg) - mid) / std


def _pace(config: SearchConfig) -> float:
    """Factor on the learning rate by which few steps move as far as many."""
    if not (config.steady_learning and config.discriminator_updates):
        return 1.0
    return _USUAL_UPDATES / config.discriminator_updates


def pick(key: jax.Array, weight: jax.Array, count: int) -> jax.Array:
    """``count`` different rows among those of weight above zero.

    Where there are fewer, some come twice: rows are drawn by their Gumbel keys.
    """
    keys = jax.random.gumbel(key, weight.shape)
    rows = jax.lax.top_k(jnp.where(weight > 0, keys, -jnp.inf), count)[1]
    good = jnp.maximum((weight > 0).sum(), 1)
    return rows[jnp.arange(count) % good]


def moments(x: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Weighted mean and standard deviation ``(F,)`` of ``(M, F)``; 1 for constants."""
    w = weight / jnp.maximum(weight.sum(), 1.0)
    mid = w @ x
    std = jnp.sqrt(w @ (x - mid) ** 2)
    return mid, jnp.where(std > 1e-9, std, 1.0)


def _only_finite(
    population: jax.Array,
    cost: jax.Array,
    finite: jax.Array,
    neutral: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Ranks non-finite individuals last, in places where they pull nothing.

    Their coordinates become those of finite individuals in turn, so that a strategy
    which recombines many never moves towards a failure; where the last may weigh less
    than nothing, those of the mean, ``neutral (n,)``.
    """
    order = jnp.argsort(jnp.where(finite, cost, jnp.inf))
    count = jnp.maximum(finite.sum(), 1)
    stand_in = order[jnp.arange(cost.shape[0]) % count]
    worst = jnp.max(jnp.where(finite, cost, -jnp.inf))
    instead = population[stand_in] if neutral is None else neutral
    population = jnp.where(finite[:, None], population, instead)
    return population, jnp.where(finite, cost, worst + 1.0)

"""UDR training, demonstrations, search, retraining and evaluation as pure functions.

Every stage works on all seeds at once (leading axis ``S``) and is a function of arrays
alone, so that the stages compose into one compiled program; the commands cut the same
functions at their seams.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from easi_jax.data.segments import Segments, windows
from easi_jax.devices.mesh import make_mesh, sharded_map
from easi_jax.errors import UserError, nearest
from easi_jax.estimation.pieces import finish_pieces
from easi_jax.estimation.posterior import Estimate, finish
from easi_jax.model import distribution
from easi_jax.model.distribution import Distribution
from easi_jax.model.parameters import ParameterSpace
from easi_jax.rl.config import SacConfig
from easi_jax.rl.episodes import Tested
from easi_jax.rl.evaluate import play
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.rl.seeds import init_seeds, run_seeds
from easi_jax.rl.trainer import TrainingConfig, make_trainer
from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData, SearchInfo, SearchState
from easi_jax.simulation.rollout import collect, last_seen, measured


@dataclass(frozen=True)
class PipelineConfig:
    """What the stages share."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """The search."""
    training: TrainingConfig = field(default_factory=SacConfig)
    """Policy training, the same budget for UDR, final policy and Oracle."""
    trajectories: int = 200
    """Demonstration trajectories recorded in the target."""
    noise: tuple[float, ...] = ()
    """Measurement noise of positions, then velocities (SI); empty: none."""
    refine: bool = False
    """Finish with least squares on the paired data, where the search has a finish."""
    restarts: int | None = None
    """More starts of the least-squares finish, drawn from the search's spread; the best
    fit counts. Not given: 2 for noisy data, none for clean ones and larger robots."""
    refine_horizon: int | None = None
    """Control steps of a piece in the least-squares finish; not given: 25, or a
    quarter of a second for larger robots, whose motion is stiffer."""
    refine_pieces: int | None = None
    """Pieces that it takes at most; not given: as
    `easi_jax.estimation.pieces.finish_pieces` and `finish_rest` have it."""
    warm_start: bool = True
    """Final training and Oracle go on from the networks of the policy that recorded the
    demonstrations, in place of new ones, where the search's recipe allows that."""
    eval_episodes: int = 100
    """Episodes of a final evaluation."""

    @property
    def finishes(self) -> bool:
        """Whether searches end with least squares."""
        return self.refine and self.search.finish

    @property
    def goes_on(self) -> bool:
        """Whether trainings go on from the first policy."""
        return self.warm_start and self.search.goes_on

    def __post_init__(self) -> None:
        """Raises UserError for values that cannot work."""
        if self.trajectories < 1:
            raise UserError(f"trajectories is {self.trajectories}: give at least 1")
        if self.eval_episodes < 1:
            raise UserError(f"eval_episodes is {self.eval_episodes}: give at least 1")
        if self.restarts is not None and self.restarts < 0:
            raise UserError(f"restarts is {self.restarts}: give 0 or more")
        for name in ("refine_horizon", "refine_pieces"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UserError(f"{name} is {value}: give at least 1")
        if any(not np.isfinite(x) or x < 0 for x in self.noise):
            raise UserError(f"noise is {self.noise}: give finite numbers, 0 or more")


class Runner(Protocol):
    """How the stages of a chain are run."""

    def stage(
        self,
        name: str,
        total: int,
        init: Callable[[], Any],
        step: Callable[..., tuple[Any, Any]],
        *args: Any,
    ) -> tuple[Any, Any]:
        """The state after ``total`` steps, and what was told of them.

        ``step(state, *args, n) -> (state, info)`` takes ``n`` of them.
        """
        ...

    def kept(self, name: str, fun: Callable[..., Any], *args: Any) -> Any:
        """``fun(*args)``, a result that is costly to make again."""
        ...

    def call(self, fun: Callable[..., Any], *args: Any) -> Any:
        """``fun(*args)``."""
        ...


class Whole:
    """Each stage in one piece, so that a chain is a pure function."""

    def stage(
        self, name: str, total: int, init: Any, step: Any, *args: Any
    ) -> tuple[Any, Any]:
        """As `Runner.stage`."""
        return step(init(), *args, total)

    def kept(self, name: str, fun: Any, *args: Any) -> Any:
        """As `Runner.kept`."""
        return fun(*args)

    def call(self, fun: Any, *args: Any) -> Any:
        """As `Runner.call`."""
        return fun(*args)


def target_parameters(space: ParameterSpace, changes: tuple[str, ...]) -> np.ndarray:
    """Nominal parameters ``(n,)`` with some changed: ``("cart_kp*0.25", "a=1.5")``.

    Raises:
        UserError: unknown name, no number, or a value outside the bounds.
    """
    theta = np.array(space.nominal, float)
    low, high = space.bounds
    for change in changes:
        sign = "*" if "*" in change else "="
        name, _, text = change.partition(sign)
        if name not in space.names:
            raise UserError(
                f'target "{change}": unknown parameter "{name}"'
                f"{nearest(name, space.names)}"
            )
        i = space.names.index(name)
        try:
            number = float(text)
        except ValueError:
            raise UserError(
                f'target "{change}": write NAME*FACTOR or NAME=VALUE'
            ) from None
        theta[i] = theta[i] * number if sign == "*" else number
        if not low[i] <= theta[i] <= high[i]:
            raise UserError(
                f'target "{change}": {theta[i]:g} is outside the physical bounds '
                f"[{low[i]:g}, {high[i]:g}]"
            )
    return theta


class Pipeline:
    """All stages for one built-in robot. Methods are pure.

    Args:
        env: the robot, with ``simulator``, ``space``, ``model(theta)``.
        config: settings.
        start: where the search starts, as factors on the nominal value; None for
            the range that UDR has.
        mesh: devices (default: all).
        real: the robot that stands for the real one, where it is another than ``env``:
            its physics may hold what ``env`` lacks. ``target`` is always one of its
            parameters.
    """

    def __init__(
        self,
        env: Any,
        config: PipelineConfig,
        start: tuple[float, float] | None = None,
        mesh: Mesh | None = None,
        real: Any = None,
    ) -> None:
        nv = env.mj_model.nv
        if config.noise and len(config.noise) != 2 * nv:
            raise UserError(
                f"noise has {len(config.noise)} numbers: {env.name} needs {2 * nv}, "
                f"for {', '.join(env.simulator.state_names)}"
            )
        if config.search.observation_inputs and any(x > 0 for x in config.noise):
            raise UserError(
                "noise is of positions and velocities, and the search compares what "
                "the controller observes: set observation_inputs=false (and "
                "stale_first_observation=false) to compare positions and velocities"
            )
        self.env, self.config, self.mesh = env, config, mesh or make_mesh()
        self.real = env if real is None else real
        space = env.space if start is None else env.space.scaled(*start)
        self.simulator = env.simulator.rebuilt(space=space)
        tested = None
        if real is not None:
            tested = Tested(real, real.model, self._draw_real)
        self.trainer = make_trainer(env, config.training, env.model, self._draw, tested)
        self.search = Search(
            self.simulator,
            config.search,
            env=env,
            act=lambda policy, obs, key: act(policy, obs, key),
            trainer=self.trainer.step,
            mesh=self.mesh,
        )
        self.space = self.search.space
        self.noise = jnp.asarray(config.noise or (0.0,) * (2 * nv))

    def _draw(self, dist: Distribution, key: jax.Array) -> jax.Array:
        return distribution.draw(self.space, dist, key)

    def _draw_real(self, dist: Distribution, key: jax.Array) -> jax.Array:
        return distribution.draw(self.real.space, dist, key)

    # -- distributions -------------------------------------------------------

    def udr(self) -> Distribution:
        """Uniform over the environment's range about the nominal values."""
        low, high = self.env.space.initial
        return distribution.uniform(self.space, low, high)

    def point(self, theta: Any) -> Distribution:
        """All mass at ``theta (n,)``: what the Oracle trains under."""
        return distribution.point(self.space, theta)

    def real_point(self, theta: Any) -> Distribution:
        """All mass at ``theta`` of the robot that stands for the real one."""
        space = self.space if self.real is self.env else self.real.space
        return distribution.point(space, theta)

    def spread(self, dist: Distribution, seeds: int) -> Distribution:
        """The same distribution for each of ``seeds``."""
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *x.shape)), dist)

    # -- stages --------------------------------------------------------------

    def train_init(self, keys: jax.Array, dist: Distribution, start: Any = None) -> Any:
        """Fresh training states, ``(S, ...)``; ``dist`` has a leading axis S.

        With the networks and observation statistics of ``start``, training states of
        another training, where given.
        """
        fresh = init_seeds(self.trainer, keys, dist, 0, self.mesh)
        return (
            fresh if start is None else jax.vmap(self.trainer.continued)(fresh, start)
        )

    def train_chunk(
        self, states: Any, dist: Distribution, target: jax.Array, n: int
    ) -> tuple[Any, dict[str, jax.Array]]:
        """``n`` steps of training; evaluations are in the target ``theta (n,)``.

        One signature for UDR, Oracle and final training, so that they share one
        compiled program.
        """
        return run_seeds(
            self.trainer, states, dist, n, self.real_point(target), 0, None, self.mesh
        )

    def policies(self, states: Any) -> PolicyParams:
        """Policies of training states, ``(S, ...)``."""
        return jax.vmap(self.trainer.policy)(states)

    def demonstrate(
        self, policies: PolicyParams, target: jax.Array, keys: jax.Array
    ) -> Segments:
        """What sensors record of the policies in the target, ``(S, B, T, 1, ...)``.

        The controller acts stochastically, as in the paper. Resets, and what the
        controller sees first, are as in the search's simulations.
        """
        c, env, search = self.config, self.real, self.config.search

        def one(item: Any) -> Segments:
            policy, key = item
            k_run, k_noise = jax.random.split(key)

            def trajectories(key: jax.Array, stale: Any = None) -> Segments:
                return collect(
                    *(env, env.model(target), lambda obs, k: act(policy, obs, k)),
                    *(key, c.trajectories, env.episode_length),
                    past=self.simulator.past_steps,
                    auto_reset=search.crosses_resets,
                    sees=search.observation_inputs,
                    stale=stale,
                )

            stale = None
            if search.stale_first_observation:
                before = trajectories(jax.random.fold_in(k_run, 1))
                stale = last_seen(before.seen, env.obs_size)
            return measured(
                *(trajectories(k_run, stale), self.noise, k_noise),
                self.simulator.configuration,
            )

        return jax.lax.map(one, (policies, keys))

    def search_data(self, demos: Segments, policies: PolicyParams) -> SearchData:
        """Data of one seed for the search, from its trajectories ``(B, T, ...)``."""
        horizon = self.config.search.horizon
        if self.config.search.source == "policy":
            horizon = 1
        pieces = windows(demos, horizon, max(1, horizon // 2))
        return SearchData(segments=pieces, noise=self.noise, policy=policies)

    def search_init(
        self,
        keys: jax.Array,
        demos: Segments,
        policies: PolicyParams,
        training: Any = (),
    ) -> SearchState:
        """Fresh search states, ``(S, ...)``."""

        def one(item: Any) -> SearchState:
            key, demo, policy, state = item
            return self.search.init(key, self.search_data(demo, policy), state)

        return jax.lax.map(one, (keys, demos, policies, training))

    def search_chunk(
        self, states: SearchState, demos: Segments, policies: PolicyParams, n: int
    ) -> tuple[SearchState, SearchInfo]:
        """``n`` generations; info ``(S, n, ...)``."""

        def one(item: Any) -> Any:
            state, demo, policy = item
            return self.search.run(state, self.search_data(demo, policy), n)

        return jax.lax.map(one, (states, demos, policies))

    def estimate(self, states: SearchState, demos: Segments) -> Estimate:
        """Results of searches, refined where asked, ``(S, ...)``."""
        c = self.config

        def one(item: Any) -> Estimate:
            mean, cov, demo = item
            return finish(
                self.simulator,
                self.space,
                mean,
                cov,
                demo,
                self.noise,
                any(x > 0 for x in c.noise),
                c.finishes,
                c.search.informed_spread,
                self.mesh,
                c.restarts,
                c.refine_horizon,
                c.refine_pieces,
            )

        return jax.lax.map(one, (states.result_mean, states.result_cov, demos))

    def pieces(self, demos: Segments) -> Segments:
        """Pieces of one seed for the least-squares finish, from ``(B, T, 1, ...)``."""
        c = self.config
        return finish_pieces(self.simulator, demos, c.refine_horizon, c.refine_pieces)

    def play(
        self, policies: PolicyParams, target: jax.Array, keys: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Deterministic policies in the target: returns ``(S, episodes)``, and
        positions of the first episodes ``(S, T + 1, nq)``."""
        model = self.real.model(target)

        def local(items: Any) -> Any:
            def one(item: Any) -> Any:
                policy, key = item
                n = self.config.eval_episodes
                return play(self.real, model, policy, act, jax.random.split(key, n))

            return jax.lax.map(one, items)

        return sharded_map(local, self.mesh, (policies, keys))

    # -- all of it -----------------------------------------------------------

    def chain(
        self,
        keys: jax.Array,
        target: jax.Array,
        runner: "Runner",
        first: Any = None,
        oracle: bool = False,
    ) -> dict[str, Any]:
        """UDR, demonstrations, search, final training and evaluation for seeds.

        Args:
            keys: ``(S,)``, of `seed_keys`.
            target: parameters of the real robot, ``(n,)``.
            runner: how the stages are run.
            first: training states of the policy that records the demonstrations,
                where it is trained already.
            oracle: train a policy in the target itself, too.

        Returns:
            ``estimate``; of each policy, ``udr``, ``easi`` and, where asked for,
            ``oracle``: its parameters, its ``_returns (S, episodes)`` in the target,
            and its ``_history`` as the runner has it, as is ``search``; ``motion``:
            positions of EASI's first episodes, ``(S, T + 1, nq)``.
        """
        n, k = self.config.training.iterations, stage_keys(keys)
        out: dict[str, Any] = {}

        def train(
            name: str, stage: str, dist: Any, total: int, init: Any, pipe: Pipeline
        ) -> Any:
            step = pipe.train_chunk
            states, history = runner.stage(stage, total, init, step, dist, target)
            out[name] = pipe.policies(states)
            out[f"{name}_history"] = history
            return states

        if first is None:
            wide = self.spread(self.udr(), len(keys))
            first = train(
                "udr", "udr", wide, n, lambda: self.train_init(k["udr"], wide), self
            )
        else:
            out["udr"] = self.policies(first)
        udr = out["udr"]
        demos = runner.call(self.demonstrate, udr, target, k["demonstrate"])
        training = first if self.search.trainer else ()
        state, out["search"] = runner.stage(
            "search",
            self.config.search.generations,
            lambda: self.search_init(k["search"], demos, udr, training),
            self.search_chunk,
            demos,
            udr,
        )
        found = out["estimate"] = runner.kept("estimate", self.estimate, state, demos)
        dist = found.distribution
        train(
            *("easi", "final", dist, self.final_iterations()),
            lambda: self.final_init(k["final"], dist, state, first),
            self,
        )
        if oracle:
            there = self if self.real is self.env else Pipeline(self.real, self.config)
            point = there.spread(there.point(target), len(keys))
            warm = first if self.config.goes_on else None
            train(
                *("oracle", "oracle", point, n),
                lambda: there.train_init(k["oracle"], point, warm),
                there,
            )
        for name in ("udr", "easi", "oracle"):
            if name in out:
                played = runner.call(self.play, out[name], target, k["evaluate"])
                out[f"{name}_returns"], motion = played
                if name == "easi":
                    out["motion"] = motion
        return out

    def run(self, keys: jax.Array, target: jax.Array) -> dict[str, Any]:
        """`chain`, each stage in one piece; one jit makes it one program.

        Histories are of every step, ``(S, n, ...)``; ``search`` is a `SearchInfo`.
        """
        return self.chain(keys, target, Whole())

    def final_init(
        self, keys: jax.Array, dist: Any, search: SearchState, first: Any = None
    ) -> Any:
        """Where final training starts: with what the search trained, with the networks
        of ``first`` (`PipelineConfig.goes_on`), or afresh."""
        if self.search.trainer:
            return search.training
        return self.train_init(keys, dist, first if self.config.goes_on else None)

    def final_iterations(self) -> int:
        """Steps of final training; those made inside the search are taken off."""
        c = self.config.search
        if not self.search.trainer:
            return self.config.training.iterations
        done = c.policy_updates_per_generation * c.generations
        return max(1, self.config.training.iterations - done)


STAGES = ("udr", "demonstrate", "search", "final", "evaluate", "oracle")


def stage_keys(keys: jax.Array) -> dict[str, jax.Array]:
    """One key a stage and seed, the same in every command, each ``(S,)``."""
    return {
        name: jax.vmap(lambda k, i=i: jax.random.fold_in(k, i))(keys)
        for i, name in enumerate(STAGES)
    }


def seed_keys(seeds: list[int]) -> jax.Array:
    """Keys ``(S,)`` of integer seeds."""
    return jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))

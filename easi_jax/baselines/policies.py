"""Methods that end with a policy: UDR, Oracle, FineTune and GARAT's retraining."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from easi_jax.baselines.task import Budget
from easi_jax.data.segments import Segments
from easi_jax.errors import UserError
from easi_jax.rl.config import SacConfig
from easi_jax.rl.networks import PolicyParams
from easi_jax.rl.seeds import init_seeds, run_seeds
from easi_jax.rl.trainer import TrainingConfig, make_trainer


@dataclass(frozen=True)
class Practice:
    """A policy that does not transfer, and where it may be trained.

    Attributes:
        env: what is simulated, nominal parameters at ``theta``.
        theta: of the simulation, SI units ``(n,)``.
        real: the machine that the policy is for, as an environment.
        target: its parameters, ``(m,)``.
        training: settings of a whole training, and its control steps where the budget
            says nothing.
        state: of the training that the policy comes from.
        policy: the policy, which recorded the demonstrations.
    """

    env: Any
    theta: jax.Array
    real: Any
    target: jax.Array
    training: TrainingConfig
    state: Any
    policy: PolicyParams


@dataclass(frozen=True)
class Learned:
    """A method's policy.

    Attributes:
        policy: to be tested.
        simulated: control steps simulated for it.
        measured: control steps of the real machine beyond the demonstrations.
    """

    policy: PolicyParams
    simulated: int
    measured: int = 0


class PolicyMethod(Protocol):
    """A way from demonstrations to a policy."""

    def fit(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> Learned:
        """Learns; ``demonstrations`` are trajectories ``(B, T, 1, ...)``."""
        ...


@dataclass(frozen=True)
class Udr:
    """A whole training in the simulation, every parameter anew in each episode.

    Uniform domain randomization (Tobin et al. 2017, arXiv:1703.06907; of dynamics, Peng
    et al. 2018, arXiv:1710.06537), with the range of EASI's paper (NeurIPS 2024): from
    a third to three times what is assumed, on Go2 from a half to twice.
    """

    factor: float = 3.0
    """Largest factor between a parameter and what is assumed, either way."""

    def fit(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> Learned:
        """Trains from scratch in the simulation; nothing is learned from the target.

        Raises:
            UserError: a factor below 1.
        """
        del demonstrations
        if not self.factor >= 1.0:
            raise UserError(f"the range's factor is {self.factor}: give at least 1")
        training, k = budgeted(practice.training, budget), self.factor

        def draw(theta: jax.Array, key: jax.Array) -> jax.Array:
            return theta * jax.random.uniform(key, theta.shape, minval=1 / k, maxval=k)

        policy = trained(practice.env, training, draw, practice.theta, key)
        return Learned(policy, training.env_steps)


@dataclass(frozen=True)
class Oracle:
    """A whole training in the target itself: what knowing everything would bring."""

    warm_start: bool = False
    """From the networks of the policy's training in place of new ones."""

    def fit(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> Learned:
        """Trains in the target."""
        del demonstrations
        training = budgeted(practice.training, budget)
        start = practice.state if self.warm_start else None
        policy = trained_at(practice.real, training, practice.target, key, start)
        return Learned(policy, 0, training.env_steps)


@dataclass(frozen=True)
class FineTune:
    """The policy's own training, continued in the target.

    As in EASI's reference (NeurIPS 2024): 40,000 control steps of the target, of which
    the first 10,000 are uniformly random actions. ``random_steps=0`` leaves that
    handicap out, but for what fills the replay buffer first.
    """

    env_steps: int = 40_000
    """Control steps in the target; fewer where the budget does not pay for them."""
    random_steps: int = 10_000
    """Of them, with random actions (SAC)."""

    def fit(
        self,
        practice: Practice,
        demonstrations: Segments,
        budget: Budget,
        key: jax.Array,
    ) -> Learned:
        """Goes on from the networks of the policy's training.

        Raises:
            UserError: random actions with PPO, or more of them than steps.
        """
        del demonstrations
        steps = min(self.env_steps, budget.trained or self.env_steps)
        if self.random_steps > steps:
            raise UserError(
                f"{self.random_steps} random actions do not go into {steps} steps"
            )
        training = replace(quiet(practice.training), env_steps=steps)
        if isinstance(training, SacConfig):
            training = replace(training, random_steps=self.random_steps)
        elif self.random_steps:
            raise UserError(
                "random actions are for SAC's buffer: with PPO give random_steps=0"
            )
        policy = trained_at(
            practice.real, training, practice.target, key, practice.state
        )
        return Learned(policy, 0, steps)


def budgeted(training: TrainingConfig, budget: Budget) -> TrainingConfig:
    """A training of as many steps as the budget says, without evaluations."""
    return replace(quiet(training), env_steps=budget.trained or training.env_steps)


def quiet(training: TrainingConfig) -> TrainingConfig:
    """The same training without evaluations on the way."""
    return replace(training, evaluate_every=0)


def trained_at(
    env: Any,
    training: TrainingConfig,
    theta: Any,
    key: jax.Array,
    start: Any = None,
) -> PolicyParams:
    """A policy trained in one model, from the networks of ``start`` where given.

    Args:
        theta: what ``env.model`` takes; any pytree.
    """
    return trained(env, training, lambda given, _: given, theta, key, start)


def trained(
    env: Any,
    training: TrainingConfig,
    draw: Callable[[Any, jax.Array], Any],
    dist: Any,
    key: jax.Array,
    start: Any = None,
) -> PolicyParams:
    """A policy trained under ``draw(dist, key) -> theta``, from the networks of
    ``start`` where given; PPO's environments are split over all devices."""
    return watched(env, training, draw, dist, dist, key, start)[0]


def watched(
    env: Any,
    training: TrainingConfig,
    draw: Callable[[Any, jax.Array], Any],
    dist: Any,
    tested: Any,
    key: jax.Array,
    start: Any = None,
) -> tuple[PolicyParams, jax.Array]:
    """`trained`, with the mean return under ``tested`` after each of the training's
    iterations ``(iterations,)``, NaN where it was not evaluated."""
    trainer = make_trainer(env, training, env.model, draw)

    def run(key: jax.Array, dist: Any, tested: Any, start: Any) -> Any:
        states = init_seeds(trainer, key[None], dist)
        if start is not None:
            states = jax.vmap(trainer.continued, (0, None))(states, start)
        states, info = run_seeds(trainer, states, dist, training.iterations, tested)
        state, info = jax.tree.map(lambda x: x[0], (states, info))
        never = jnp.full(training.iterations, jnp.nan)
        return trainer.policy(state), info.get("eval_return", never)

    return jax.jit(run)(key, dist, tested, start)

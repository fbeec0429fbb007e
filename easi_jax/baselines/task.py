"""What every method is given, and what it gives back."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from easi_jax.data.segments import Segments
from easi_jax.devices.mesh import make_mesh
from easi_jax.errors import UserError
from easi_jax.model.distribution import Distribution
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator

Act = Callable[[Any, jax.Array, jax.Array], jax.Array]


@dataclass(frozen=True)
class Budget:
    """What may be spent, the same for all methods.

    Attributes:
        simulated: control steps that may be simulated to identify the machine, or for
            GARAT to imitate it; what EASI's 50 generations of 300 individuals and 200
            steps take where not given.
        trained: control steps that a training of a policy may take; those of the
            training's own settings where not given.
    """

    simulated: int = 3_000_000
    trained: int | None = None

    def __post_init__(self) -> None:
        """Raises UserError for a budget that buys nothing."""
        for steps in (self.simulated, self.trained):
            if steps is not None and steps < 1:
                raise UserError(f"a budget of {steps} control steps buys nothing")

    def rounds(self, steps: int) -> int:
        """How many rounds of ``steps`` control steps it pays for.

        Raises:
            UserError: not even one.
        """
        if steps > self.simulated:
            raise UserError(
                f"a budget of {self.simulated} control steps does not pay for one "
                f"round of {steps}"
            )
        return self.simulated // steps


@dataclass(frozen=True)
class Task:
    """A machine to be identified, and what may be asked of it.

    Attributes:
        simulator: what is simulated; its space says where a search starts and may go.
        noise: of what is measured, standard deviations ``(2 nv,)``; zero: none.
        env: the machine as an environment, for methods that simulate the controller.
        act: ``act(policy, obs, key) -> action``, what recorded the demonstrations.
        act_best: the same without exploration; ``act`` where not given.
        policy: its parameters.
        record: ``record(policy, keys) -> Segments``: further trajectories of the real
            machine, one for each key, ``(B, T, 1, ...)``, from the starts that
            `easi_jax.simulation.rollout.policy_rollout` has with these keys; None where
            there are none to be had.
        train: ``train(space, distribution, key) -> policy``, under the method's
            training budget; None where policies are not asked for.
        mesh: devices.
    """

    simulator: Simulator
    noise: Any
    env: Any = None
    act: Act | None = None
    act_best: Act | None = None
    policy: Any = None
    record: Callable[[Any, jax.Array], Segments] | None = None
    train: Callable[[ParameterSpace, Distribution, jax.Array], Any] | None = None
    mesh: Mesh = field(default_factory=make_mesh)

    @property
    def space(self) -> ParameterSpace:
        return self.simulator.space

    @property
    def start_mean(self) -> jax.Array:
        """The middle of where a search starts, unit coordinates ``(n,)``."""
        return jnp.full(self.space.size, 0.5)

    @property
    def start_std(self) -> jax.Array:
        """Of a uniform draw from there, ``(n,)``."""
        return jnp.full(self.space.size, 12.0**-0.5)


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("distribution", "trace"),
    meta_fields=("space", "simulated", "measured", "unreached"),
)
@dataclass(frozen=True)
class Identified:
    """What a method found; a pytree, so `jax.block_until_ready` waits for it.

    Attributes:
        distribution: over the parameters.
        space: whose unit coordinates it is in.
        simulated: control steps simulated to identify it; a derivative counts as one
            more.
        measured: control steps of the real machine beyond the demonstrations.
        trace: mean and standard deviation after each generation, unit coordinates,
            ``(G, n)`` each; None where a method has no generations to show.
        unreached: parameters that the method has no word for; they are as at the start.
    """

    distribution: Distribution
    space: ParameterSpace
    simulated: int
    measured: int = 0
    trace: tuple[jax.Array, jax.Array] | None = None
    unreached: tuple[str, ...] = ()


class Method(Protocol):
    """A way from demonstrations to a distribution over parameters."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """Identifies; ``demonstrations`` are trajectories ``(B, T, 1, ...)``."""
        ...

"""An environment whose robot reads the sensors that a log has."""

import copy
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.sensor_channels import Sensors, only_read
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics
from easi_jax.simulation.with_effects import needs_simulator


@dataclass(frozen=True)
class _Both:
    """Reads what an environment reads by itself, and then the sensors."""

    own: Any
    sensors: Any

    def __call__(self, m: Any, d: Any) -> jax.Array:
        return jnp.concatenate([self.own(m, d), self.sensors(m, d)])

    @property
    def native(self) -> "_NativeBoth | None":
        """The same of native MuJoCo; None where the environment has none."""
        own = getattr(self.own, "native", None)
        return None if own is None else _NativeBoth(own, self.sensors.native)


@dataclass(frozen=True)
class _NativeBoth:
    own: Any
    sensors: Any

    @property
    def fields(self) -> tuple[str, ...]:
        return (*self.own.fields, *self.sensors.fields)

    @property
    def size(self) -> int:
        return self.own.size + self.sensors.size

    def __call__(self, *given: np.ndarray) -> np.ndarray:
        first = len(self.own.fields)
        return np.concatenate(
            [self.own(*given[:first]), self.sensors(*given[first:])], axis=1
        )


class ReadingSimulator(Simulator):
    """A simulator that keeps what sensors read as `Physics.read`.

    A log's row holds what sensors read where its command begins to act, which is the
    first physics step of a control step. What an environment reads by itself
    (`Physics.sensed`) stays as it is, the last physics step.

    Args:
        simulator: the machine.
        sensors: what is read of it.
    """

    def __init__(self, simulator: Simulator, sensors: Sensors) -> None:
        own, size = simulator.base.sense, simulator.base.sense_size
        m, sense = simulator.mj_model, sensors.reading
        # Not where an environment's own reading may be of other sensors.
        if own is None and simulator.engine == "mjx":
            m = only_read(m, sensors)
        super().__init__(
            *(m, simulator.space, simulator.dt),
            sense if own is None else _Both(own, sense),
            size + len(sensors),
            simulator.base.torque_speed,
            simulator.fixed,
            simulator.engine,
            simulator.logged,
        )
        self._own = size if own is not None else None

    def rebuilt(self, *args: Any, **more: Any) -> Simulator:
        """Not of this one: what an environment reads by itself would be lost."""
        raise NotImplementedError("rebuild the simulator, then let it read sensors")

    def start(self, *args: Any, **more: Any) -> Physics:
        """As `Simulator.start`; nothing is read yet."""
        state = super().start(*args, **more)
        return self._parted(state, state.sensed, state.sensed)

    def step(self, model: Any, state: Physics, ctrl: jax.Array) -> Physics:
        """As `Simulator.step`."""
        # As steps return it: a scan over them keeps the form of a state.
        bare = state.replace(sensed=jnp.zeros(self.base.sense_size), read=())
        after, (first, last) = self.sensed_step(model, bare, ctrl)
        return self._parted(after, first, last)

    def _parted(self, state: Physics, first: Any, last: Any) -> Physics:
        own = self._own
        sensed = () if own is None else last[:own]
        return state.replace(sensed=sensed, read=first[own or 0 :])


def reading_env(env: Any, sensors: Sensors) -> Any:
    """The environment with a `ReadingSimulator`; the given one stays as it is.

    Raises:
        UserError: the environment simulates with something else than its
            ``simulator``.
    """
    if not len(sensors):
        return env
    needs_simulator(env, "readings of sensors")
    out = copy.copy(env)
    out.simulator = ReadingSimulator(env.simulator, sensors)
    return out

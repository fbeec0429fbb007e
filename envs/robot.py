"""What the built-in robots share: model file, parameters, simulator."""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from easi_jax.io.models.completed import as_read
from easi_jax.model.mjx_model import Model
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation import engine
from easi_jax.simulation.env import EnvState
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.step import Physics

_FACTOR = 1e3  # of the nominal value, that bounds allow either way


class Robot:
    """A robot with a task; subclasses say what it observes and what it is asked to do.

    Attributes:
        mj_model: the robot in MuJoCo.
        space: its parameters; a search starts in [nominal / k, k nominal].
        simulator: how it is simulated.
        default_target: how the pseudo-real robot differs where nothing else is said.
        training: settings by algorithm, the default first; presets where empty.
    """

    name: str
    obs_size: int
    action_size: int
    episode_length: int
    dt: float
    k: float = 3.0
    default_target: tuple[str, ...] = ()
    training: Mapping[str, Any] = MappingProxyType({})

    def __init__(
        self,
        addresses: dict[str, str],
        model: Path | mujoco.MjModel | None = None,
    ) -> None:
        """Builds the simulator.

        Args:
            addresses: parameter names and what each is in the model
                (docs/your_own_robot.md).
            model: MJCF file or model; a built-in robot's own where not given.
        """
        self.mj_model = _read(self.name, model)
        self.space = parameter_space(self.mj_model, addresses, self.k)
        own = engine.of_built_in(self.mj_model) if model is None else None
        self.simulator = Simulator(self.mj_model, self.space, self.dt, engine=own)

    @property
    def machine(self) -> Simulator:
        """`simulator` under its name of version 0.1, for environment files of then."""
        return self.simulator

    @machine.setter
    def machine(self, value: Simulator) -> None:
        self.simulator = value

    def model(self, theta: jax.Array | None = None) -> Model:
        """The model at ``theta (n,)`` in SI units; nominal without it."""
        return self.simulator.model(
            jnp.asarray(self.space.nominal) if theta is None else theta
        )

    def control(self, state: EnvState, action: jax.Array) -> jax.Array:
        """What ``step`` sends to the actuators, ``(nu,)``."""
        raise NotImplementedError

    def advance_physics(
        self, model: Model, state: EnvState, action: jax.Array
    ) -> Physics:
        """The physics after a control step."""
        return self.simulator.step(model, state.physics, self.control(state, action))


def model_file(name: str) -> Path:
    """The MJCF of a built-in robot."""
    return Path(str(resources.files("envs") / "assets" / f"{name}.xml"))


def _read(name: str, model: Path | mujoco.MjModel | None) -> mujoco.MjModel:
    if isinstance(model, mujoco.MjModel):
        return model
    if model is not None:
        return as_read(model).compile()
    return mujoco.MjModel.from_xml_string(model_file(name).read_text())


def parameter_space(
    mj_model: mujoco.MjModel, addresses: dict[str, str], k: float
) -> ParameterSpace:
    """Parameters by name and address, nominal values from the model."""

    def one(name: str, address: str) -> Any:
        p = declare(mj_model, name, address)
        low = 0.0 if "friction" in name else p.nominal / _FACTOR
        return declare(
            mj_model,
            name,
            address,
            initial=(p.nominal / k, p.nominal * k),
            bounds=(low, _FACTOR * p.nominal),
        )

    return ParameterSpace(tuple(one(n, a) for n, a in addresses.items()))


def vector(name: str) -> tuple[str, ...]:
    """Names of its entries, for ``obs_names``."""
    return tuple(f"{name}.{axis}" for axis in "xyz")


def not_finite(*arrays: jax.Array) -> jax.Array:
    """Whether any number is not finite, ``()`` bool."""
    return ~jnp.stack([jnp.isfinite(a).all() for a in arrays]).all()

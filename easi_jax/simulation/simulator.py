"""A robot as it is simulated: MuJoCo model, what may vary, control step."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.recording import physics_steps
from easi_jax.data.sensor_channels import Sensors, only_read
from easi_jax.devices.runtime import on_cpu
from easi_jax.errors import UserError
from easi_jax.model import effects
from easi_jax.model.addresses import describe, resolve
from easi_jax.model.contact_pairs import Pair
from easi_jax.model.joint_space import Configuration, tangent_names
from easi_jax.model.mjx_model import (
    Model,
    Sense,
    put_model,
    simulated,
    with_parameters,
)
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.torque_speed import TorqueSpeed
from easi_jax.simulation import native_step
from easi_jax.simulation.engine import Engine, resolved
from easi_jax.simulation.logged import Logged, apart_in, apart_note
from easi_jax.simulation.step import (
    WRITTEN_OUT,
    Physics,
    arrived_sensed,
    arriving,
    at_rest,
    control_step,
)

# Small enough for XLA to run a simulation as one piece (see `runtime`).
_BATCH = 128  # of a Cartpole, tried by hand
_WIDE_BATCH = 32  # benchmarks/engines.py
_ACCELERATOR_BATCH = 16_384  # benchmarks/scaling.py
_NATIVE_BATCH = 4_096  # few calls, and 100 MB at most of models' numbers
FORWARD_MODE = 3  # degrees of freedom: of six, written out, it compiles for minutes
_SETTLED = 4.0  # time constants after which a lag has forgotten


class Simulator:
    """A MuJoCo model, its parameters and its control step.

    Attributes:
        mj_model: the model as given, nominal values in it.
        space: the parameters that may vary.
        base: the model on the device, nominal values in it, gates opened.
        dt: control step [s].
        engine: ``mjx`` or ``mujoco`` (`easi_jax.simulation.engine`).
        substeps: physics steps in a control step. The physics step is ``dt``
            divided by the smallest whole number that brings it to the model's own
            timestep or below.
        wide: whether it is too large to be written out entry by entry.
        by_differences: whether slopes of a fit are differences in single precision,
            of simulations that are compiled once for them and for trials
            (`easi_jax.simulation.slopes`).
        fixed: values by address that are not those of ``mj_model``, effects among them.
        logged: states that it simulates from, and near them; None where it may get
            anywhere. MJX is compared with MuJoCo C there, and leaves out `apart`.
        past_steps: commands before a measured start that its simulation has use for;
            0 where no effect lies on the way of a command.

    Raises:
        UserError: what MJX cannot simulate, or an address that the model lacks.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        space: ParameterSpace,
        dt: float | None = None,
        sense: Sense | None = None,
        sense_size: int = 0,
        torque_speed: TorqueSpeed | None = None,
        fixed: Mapping[str, float] | None = None,
        engine: Engine | None = None,
        logged: Logged | None = None,
    ) -> None:
        simulated(mj_model)
        self.mj_model, self.space, self.fixed = mj_model, space, dict(fixed or {})
        self.logged = logged
        self.engine: Engine = resolved(engine, mj_model, logged, lambda: self._apart)
        step = float(mj_model.opt.timestep)
        self.dt = float(dt) if dt is not None else step
        if not 0 < self.dt < 10:
            raise UserError(f"control step {self.dt} s: give one above 0 and below 10")
        self.substeps = physics_steps(self.dt, step)
        native = self.engine == "mujoco"
        self.wide = mj_model.nv > WRITTEN_OUT
        self.by_differences = not native and mj_model.nv > FORWARD_MODE
        self.base = self._put(sense is not None).replace(
            sense=sense,
            sense_size=sense_size,
            torque_speed=torque_speed,
            delay_steps=_steps(self._longest("effect.delay.") / self.dt),
        )
        self.past_steps = 0
        if self.base.effects is not None and effects.has_command_memory(
            self.base.present
        ):
            settled = _SETTLED * self._longest("effect.lag.") / self.dt
            self.past_steps = self.base.delay_steps + 1 + _steps(settled)

    @cached_property
    def batch(self) -> int:
        """Simulations at once on a device. More would leave a CPU core's cache; an
        accelerator hides behind thousands what each step waits for."""
        if self.engine == "mujoco":
            return _NATIVE_BATCH
        if not on_cpu():
            return _ACCELERATOR_BATCH
        return _WIDE_BATCH if self.wide else _BATCH

    @property
    def is_timed(self) -> bool:
        """Whether something in it may depend on the time: an owner's effect."""
        return effects.has_own(self.base.effects, self.base.present)

    @property
    def moves_centers(self) -> bool:
        """Whether a parameter or a fixed value moves a center of mass, which MuJoCo C
        may not be able to."""
        every = (*self.space.addresses, *((a,) for a in self.fixed))
        return any(w.row.moves_center for w in resolve(self.mj_model, every))

    def _longest(self, kind: str) -> float:
        """The largest value that effects of a kind may have [s]; 0 without any."""
        fixed = [v for a, v in self.fixed.items() if a.startswith(kind)]
        free = [
            min(p.bounds[1], describe(self.mj_model, p.addresses)[1][1])
            for p in self.space.parameters
            if p.addresses[0].startswith(kind)
        ]
        return max([0.0, *fixed, *free])

    @cached_property
    def _apart(self) -> frozenset[Pair]:
        if self.logged is None:
            return frozenset()
        varied = [(p.addresses, p.bounds) for p in self.space.parameters]
        varied += [((a,), (v, v)) for a, v in self.fixed.items()]
        return apart_in(self.logged, self.mj_model, varied)

    @property
    def apart(self) -> frozenset[Pair]:
        """Pairs of geoms that are left out: on MJX, what never comes near each other in
        the log."""
        return self._apart if self.engine == "mjx" else frozenset()

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of how it simulates, a line each."""
        note = apart_note(self.mj_model, self.apart)
        return (note,) if note else ()

    def _put(self, sensors: bool) -> Model:
        # Eagerly, also where a machine is made while something is traced.
        with jax.ensure_compile_time_eval():
            return put_model(
                self.mj_model,
                self.space.addresses,
                self.fixed,
                sensors,
                self.engine == "mujoco",
                self.dt / self.substeps,
                self.apart,
            )

    def rebuilt(
        self,
        mj_model: mujoco.MjModel | None = None,
        space: ParameterSpace | None = None,
        fixed: Mapping[str, float] | None = None,
        sense: tuple[Sense, int] | None = None,
    ) -> "Simulator":
        """The same machine, its drives included, of another model, with other
        parameters or fixed values, or which senses something else: ``sense`` and its
        size."""
        base = self.base
        return Simulator(
            self.mj_model if mj_model is None else mj_model,
            self.space if space is None else space,
            self.dt,
            *(sense or (base.sense, base.sense_size)),
            base.torque_speed,
            self.fixed if fixed is None else fixed,
            self.engine,
            self.logged,
        )

    def sensing(self, sensors: Sensors) -> "Simulator":
        """The same machine, which reads some numbers of named sensors.

        On MJX other sensors are left out: they would be compiled, too.
        """
        m = only_read(self.mj_model, sensors) if self.engine == "mjx" else None
        return self.rebuilt(m, sense=(sensors.reading, len(sensors)))

    def model(self, theta: jax.Array) -> Model:
        """The model at parameters ``theta`` ``(n,)`` in SI units."""
        return with_parameters(self.base, theta)

    def start(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        model: Model | None = None,
        act: jax.Array | None = None,
    ) -> Physics:
        """A measured state, nothing known of what came before it.

        ``model`` is given where it has effects, which remember; activations ``act
        (na,)`` are zero where they are not given.
        """
        state = at_rest(self.base if model is None else model, qpos, qvel)
        return state if act is None else replace(state, act=act)

    def after(self, model: Model, state: Physics, past: jax.Array) -> Physics:
        """A state with commands ``past (D, nu)`` sent before it, oldest first."""
        e = model.effects
        if e is None or not self.past_steps:
            return state
        memory = effects.warmed(e, state.memory, past, self.dt, self.substeps)
        return replace(state, memory=memory)

    def without_sense(self, model: Model) -> Model:
        """The model with nothing read but the state."""
        return model.replace(sense=None) if self.base.sense else model

    def step(self, model: Model, state: Physics, ctrl: jax.Array) -> Physics:
        """One control step with ``ctrl`` ``(nu,)`` held."""
        return control_step(model, state, ctrl, self.substeps)

    def sensed_step(
        self, model: Model, state: Physics, ctrl: jax.Array
    ) -> tuple[Physics, jax.Array]:
        """One control step, and what is sensed in its first and its last physics step,
        ``(2, sense_size)``."""
        arrived, memory = arriving(model, state, ctrl, self.substeps)
        after, sensed = arrived_sensed(model, state.replace(memory=()), arrived)
        return after.replace(memory=memory), sensed

    def replay(
        self, model: Model, state: Physics, ctrl: jax.Array, steps: Any = None
    ) -> tuple[jax.Array, jax.Array, jax.Array] | None:
        """Positions and velocities ``(H, ...)`` after each of the commands ``(H, nu)``,
        and what is sensed in the first and the last physics step of each, ``(H, 2,
        sense_size)``, where the engine has a call for all of them; else None.
        ``steps``: as for `easi_jax.simulation.open_loop.predict`."""
        if self.engine != "mujoco":
            return None
        e, substeps = model.effects, self.substeps
        if e is None or not effects.has_command_memory(model.present):
            shape = (len(ctrl), substeps, ctrl.shape[1])
            arrived = jnp.broadcast_to(ctrl[:, None], shape)
        else:

            def sent(memory: Any, u: jax.Array) -> Any:
                arrived, memory = effects.commands(e, memory, u, self.dt, substeps)
                return memory, arrived

            arrived = jax.lax.scan(sent, state.memory, ctrl)[1]
        return native_step.replay(model, state, arrived, steps)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the ``2 nv`` entries of `difference`: positions, velocities."""
        names = tangent_names(self.mj_model)
        return tuple(f"{kind}.{name}" for kind in ("qpos", "qvel") for name in names)

    @cached_property
    def configuration(self) -> Configuration:
        """Where numbers and quaternions lie in the positions."""
        return Configuration.of(self.mj_model)

    def difference(
        self,
        qpos_a: jax.Array,
        qvel_a: jax.Array,
        qpos_b: jax.Array,
        qvel_b: jax.Array,
    ) -> jax.Array:
        """State b minus state a, ``(..., 2 nv)``: positions in the tangent space
        (rotation vectors for free and ball joints), then velocities.

        Hinges are subtracted as they are: simulated angles do not wrap.
        """
        dq = self.configuration.difference(qpos_a, qpos_b)
        return jnp.concatenate([dq, qvel_b - qvel_a], -1)

    def move(self, qpos: jax.Array, tangent: jax.Array) -> jax.Array:
        """Positions ``(..., nq)`` moved by tangent vectors ``(..., nv)``."""
        return self.configuration.integrate(qpos, tangent)


def _steps(x: float) -> int:
    """Whole steps that cover ``x`` of them, up to rounding."""
    return int(np.ceil(x - 1e-6))

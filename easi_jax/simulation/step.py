"""One control step of physics: the state, the substeps, and nothing else."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import forward as mjx_forward
from mujoco.mjx._src import sensor as mjx_sensor
from mujoco.mjx._src import smooth as mjx_smooth
from mujoco.mjx._src import solver as mjx_solver
from mujoco.mjx._src.collision_driver import collision
from mujoco.mjx._src.constraint import make_constraint
from mujoco.mjx._src.types import IntegratorType

from easi_jax.model import effects
from easi_jax.model.backlash import first_rotor
from easi_jax.model.contact_pairs import Pair
from easi_jax.model.effects import Effects
from easi_jax.model.joint_space import scalar_places
from easi_jax.model.mjx_data import make_data
from easi_jax.model.mjx_model import refusals
from easi_jax.model.native_model import NativeModel
from easi_jax.model.own_laws import first_states, next_states
from easi_jax.simulation import constraint_solver, native_step
from easi_jax.simulation.cpu.unroll import scalarized
from easi_jax.simulation.mjx_patches import with_velocity_products
from easi_jax.simulation.native import first_rest

WRITTEN_OUT = 8  # degrees of freedom up to which a step is written out by entries


@flax.struct.dataclass
class Physics:
    """What the simulation carries from step to step; small, and can be saved.

    Attributes:
        qpos: joint positions, ``(nq,)`` [m, rad].
        qvel: joint velocities, ``(nv,)`` [m/s, rad/s].
        act: actuator activations, ``(na,)``.
        warmstart: last acceleration, where the solver starts, ``(nv,)``.
        sensed: what ``model.sense`` read in the last physics step; zeros before.
        memory: what the way of a command remembers, where effects lie on it.
        rotor: drives with play, where there are any.
        rest: on the engine ``mujoco`` what else its state has (delayed commands and
            readings, plugins, plastic deformation), as words, ``(k,)`` uint32.
        time: of the recording or episode, where owners' effects may ask for it, ``()``
            [s].
        hidden: what laws remember, ``(S,)``; likewise.
        read: what the sensors of a log read where the step that led here began
            (`easi_jax.simulation.reading`), ``(N,)``; () where none are asked for.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warmstart: jax.Array
    sensed: Any = ()
    memory: Any = ()
    rotor: Any = ()
    rest: Any = ()
    time: Any = ()
    hidden: Any = ()
    read: Any = ()

    if TYPE_CHECKING:  # made by flax

        def replace(self, **changes: Any) -> "Physics": ...


def at_rest(model: Any, qpos: jax.Array, qvel: jax.Array) -> Physics:
    """A state with nothing known of what came before it."""
    m = model.mjx
    act, warm = jnp.zeros(m.na), jnp.zeros(m.nv)
    sensed = jnp.zeros(model.sense_size) if model.sense else ()
    memory, rotor, e = (), (), model.effects
    if e is not None and effects.has_backlash(model.present):
        rotor = first_rotor(scalar_places(m), qpos, qvel)
    if e is not None and effects.has_command_memory(model.present):
        memory = effects.first_memory(model.delay_steps, m.nu)
    native = isinstance(m, NativeModel)
    rest = jnp.asarray(first_rest(m.template.mj)) if native else ()
    time, hidden = (), ()
    if e is not None and effects.has_own(e, model.present):
        time = jnp.zeros(())
        hidden = first_states(e.laws, qpos, qvel, jnp.zeros(m.nu), time)
    return Physics(qpos, qvel, act, warm, sensed, memory, rotor, rest, time, hidden)


def data_at(model: Any, state: Physics, ctrl: jax.Array) -> mjx.Data:
    """The `mjx.Data` of a state, before `forward`."""
    return make_data(model.mjx).replace(
        qpos=state.qpos,
        qvel=state.qvel,
        act=state.act,
        qacc_warmstart=state.warmstart,
        ctrl=ctrl,
    )


@dataclass(frozen=True)
class Within:
    """Effects that act between the parts of a physics step.

    Attributes:
        effects: their strengths.
        pairs: that may touch in the model as given.
        has_body_drag: whether bodies may have drag, which needs their velocities.
        has_contact_effects: whether contacts are changed where they are made.
    """

    effects: Effects
    pairs: tuple[Pair, ...]
    has_body_drag: bool
    has_contact_effects: bool


def _within(model: Any) -> Within | None:
    has_body_drag = effects.has_body_drag(model.present)
    has_contact_effects = effects.has_contact_effects(model.present)
    if model.effects is None or not (has_body_drag or has_contact_effects):
        return None
    return Within(model.effects, model.pairs, has_body_drag, has_contact_effects)


def _position(m: mjx.Model, d: mjx.Data, within: Within) -> mjx.Data:
    """`fwd_position`, contacts changed where their constraints are made."""
    for part in (
        *(mjx_smooth.kinematics, mjx_smooth.com_pos, mjx_smooth.camlight),
        *(mjx_smooth.tendon, mjx_smooth.crb, mjx_smooth.tendon_armature),
        *(mjx_smooth.factor_m, collision),
    ):
        d = part(m, d)
    d = effects.pair_contacts(m, d, within.effects, within.pairs)
    return mjx_smooth.transmission(m, make_constraint(m, d))


def forward(
    m: mjx.Model, d: mjx.Data, wide: bool = False, within: Within | None = None
) -> mjx.Data:
    """`mjx.forward` with this package's constraint solver where it applies.

    ``wide`` is the solver for batches of larger robots
    (`easi_jax.simulation.cpu.batched_newton`).
    """
    own = constraint_solver.supported(m)
    if not own and within is None:
        return mjx.forward(m, d)
    if within is not None and within.has_contact_effects:
        d = _position(m, d, within)
    else:
        d = mjx_forward.fwd_position(m, d)
    d = mjx_sensor.sensor_pos(m, d)
    d = mjx_forward.fwd_velocity(m, d)
    if own:
        d = with_velocity_products(m, d)
    d = mjx_sensor.sensor_vel(m, d)
    if within is not None and within.has_body_drag:
        d = effects.body_resistance(m, d, within.effects)
    d = mjx_forward.fwd_actuation(m, d)
    d = mjx_forward.fwd_acceleration(m, d)
    if d._impl.efc_J.size == 0:
        d = d.replace(qacc=d.qacc_smooth)
    elif own:
        d = constraint_solver.solve(m, d, int(m.opt.iterations), wide)
    else:
        d = mjx_solver.solve(m, d)
    return mjx_sensor.sensor_acc(m, d)


def mjx_step(
    m: mjx.Model, d: mjx.Data, wide: bool = False, within: Within | None = None
) -> mjx.Data:
    """`mjx.step`, its constraint solve and small matrices batched well; see `forward`.

    RK4 leaves effects within a step out.
    """
    if m.opt.integrator == IntegratorType.RK4:
        return mjx.step(m, d)  # RK4 solves inside its stages
    d = forward(m, d, wide, within)
    if m.opt.integrator == IntegratorType.EULER:
        return mjx_forward.euler(m, d)
    return mjx_forward.implicit(_without_clamped(m, d), d)


def _without_clamped(m: mjx.Model, d: mjx.Data) -> mjx.Model:
    """The model as `implicit` must see it: no velocity feedback where it is cut off.

    MuJoCo C (4.0) leaves an actuator at its force limit out of the derivative; MJX
    3.17 does not, and a saturated servo then brakes too softly.
    """
    limited = m.actuator_forcelimited.astype(bool)
    if not limited.any():
        return m
    force, edge = d.actuator_force, m.actuator_forcerange
    clamped = limited & ((force <= edge[:, 0]) | (force >= edge[:, 1]))
    free = jnp.where(clamped, 0.0, 1.0)
    return m.replace(
        actuator_gainprm=m.actuator_gainprm.at[:, 2].set(
            m.actuator_gainprm[:, 2] * free
        ),
        actuator_biasprm=m.actuator_biasprm.at[:, 2].set(
            m.actuator_biasprm[:, 2] * free
        ),
    )


def substep(model: Any, state: Physics, ctrl: jax.Array, wide: bool = False) -> Physics:
    """One physics step; the joint speed limit, which MuJoCo lacks, clips after it."""
    m = model.mjx
    if model.torque_speed is not None:
        m = model.torque_speed.limited(m, state.qvel)
    d = data_at(model, state, ctrl)
    e, rotor, own = model.effects, state.rotor, {}
    if effects.has_own(e, model.present):
        d, own = d.replace(time=state.time), later(model, state, ctrl, m.opt.timestep)
    if e is not None:
        m, d, rotor = effects.in_step(m, d, e, rotor, state.hidden)
    with refusals(NotImplementedError):
        d = mjx_step(m, d, wide, _within(model))
    qvel = jnp.clip(d.qvel, -model.speed_limit, model.speed_limit)
    sensed = model.sense(model.mjx, d) if model.sense else ()
    return Physics(*(d.qpos, qvel, d.act, d.qacc_warmstart, sensed, (), rotor), **own)


def later(model: Any, state: Physics, ctrl: jax.Array, h: Any) -> dict[str, Any]:
    """Time, and what laws remember, after a physics step ``h`` [s]."""
    laws, now = model.effects.laws, (state.qpos, state.qvel, ctrl, state.time)
    hidden = next_states(laws, state.hidden, *now, h)
    return {"time": state.time + h, "hidden": hidden}


# What is too large to be written out (benchmarks/engines.py) takes the wide solver.
_batched_substep = scalarized(substep, otherwise=partial(substep, wide=True))


def control_step(model: Any, state: Physics, ctrl: jax.Array, substeps: int) -> Physics:
    """Holds ``ctrl`` ``(nu,)`` for ``substeps`` physics steps."""
    if isinstance(model.mjx, NativeModel) or _remembers(model):
        arrived, memory = arriving(model, state, ctrl, substeps)
        bare = state.replace(memory=())
        return arrived_step(model, bare, arrived).replace(memory=memory)

    def step(s: Physics, _: None) -> tuple[Physics, None]:
        return _batched_substep(model, s, ctrl), None

    return jax.lax.scan(step, state, None, length=substeps)[0]


def _remembers(model: Any) -> bool:
    return model.effects is not None and effects.has_command_memory(model.present)


def arriving(
    model: Any, state: Physics, ctrl: jax.Array, substeps: int
) -> tuple[jax.Array, Any]:
    """What reaches the actuators in each physics step of a control step, ``(substeps,
    nu)``, and the memory of commands after it."""
    if not _remembers(model):
        return jnp.broadcast_to(ctrl, (substeps, *ctrl.shape)), state.memory
    dt = model.mjx.opt.timestep * substeps
    return effects.commands(model.effects, state.memory, ctrl, dt, substeps)


def arrived_step(model: Any, state: Physics, arrived: jax.Array) -> Physics:
    """One control step in which ``arrived (substeps, nu)`` reaches the actuators."""
    if isinstance(model.mjx, NativeModel):
        return native_step.steps(model, state, arrived)

    def step(s: Physics, u: jax.Array) -> tuple[Physics, None]:
        return _batched_substep(model, s, u), None

    return jax.lax.scan(step, state, arrived)[0]


def arrived_sensed(
    model: Any, state: Physics, arrived: jax.Array
) -> tuple[Physics, jax.Array]:
    """`arrived_step`, and what is sensed in its first and its last physics step,
    ``(2, sense_size)``."""
    if isinstance(model.mjx, NativeModel):
        at_once = native_step.steps_sensed(model, state, arrived)
        if at_once is not None:
            return at_once

    def step(s: Physics, u: jax.Array) -> tuple[Physics, jax.Array]:
        s = arrived_step(model, s, u[None])
        return s, s.sensed

    state, each = jax.lax.scan(step, state, arrived)
    return state, jnp.stack([each[0], each[-1]])

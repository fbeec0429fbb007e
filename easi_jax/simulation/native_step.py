"""A control step on native MuJoCo, with what this package adds to a model.

Effects are those of `easi_jax.model.effects`, by the same functions: what never changes
within a control step is written into the model's fields and into held forces, and
MuJoCo is called once; where something depends on the state it is called once a physics
step.
"""

from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.model import effects
from easi_jax.model.effect_numbers import fields_that_act
from easi_jax.model.joint_space import scalar_places
from easi_jax.model.own_laws import next_states
from easi_jax.simulation import native

AT_PAIRS = ("slip", "give")  # for which MuJoCo is called simulation by simulation
# Effects in the step that are the same at every state.
_STEADY = ("coulomb", "damping", "stiffness", "spring", "constant", "force", *AT_PAIRS)
_IN_STEPS = (*fields_that_act("step"), *fields_that_act("drive"), *AT_PAIRS)
# Those for which MuJoCo is called once a physics step.
STATE_DEPENDENT = tuple(f for f in _IN_STEPS if f not in _STEADY)
# Those without which a call goes through all steps of all simulations.
SLOW = (*STATE_DEPENDENT, *AT_PAIRS)


@flax.struct.dataclass
class StepData:
    """What effects read and change of a step; names are those of `mjx.Data`."""

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    ctrl: jax.Array
    qfrc_applied: jax.Array
    xfrc_applied: jax.Array
    time: Any = ()
    xipos: Any = ()
    subtree_com: Any = ()
    cvel: Any = ()

    if TYPE_CHECKING:  # made by flax

        def replace(self, **changes: Any) -> "StepData": ...


def _acting(model: Any) -> tuple[str, ...]:
    """Fields of effects that act in the steps themselves."""
    if model.effects is None:
        return ()
    present = model.present
    return tuple(f for f in _IN_STEPS if present is None or f in present)


def _varies(model: Any) -> bool:
    """Whether something must be done between physics steps."""
    m = model.mjx.template
    sprung = not m.mj.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SPRING
    steady = [f for f in _STEADY if f != "stiffness" or sprung]
    unsteady = any(f not in steady for f in _acting(model))
    return model.torque_speed is not None or unsteady


def _edge(model: Any) -> Any:
    """Speed limits of joints, where there may be any."""
    return model.speed_limit if model.mjx.template.limits_speed else None


def _pairs(model: Any) -> Any:
    """Factors on the contacts of pairs of geoms, where there may be any."""
    if not {*AT_PAIRS} & {*_acting(model)}:
        return None
    return jnp.concatenate([model.effects.slip[:, None], model.effects.give], 1)


def _reading(model: Any) -> Any:
    if model.sense is None:
        return None
    read = getattr(model.sense, "native", None)
    if read is None:
        raise UserError(
            "this environment reads its simulation from MJX: use --engine mjx, or give "
            "its sense a `native` (easi_jax.simulation.native.Reading)"
        )
    return read


def _of_model(model: Any) -> dict[str, Any]:
    """What every call of MuJoCo is given of a model besides its numbers."""
    return {"read": _reading(model), "pairs": _pairs(model), "edge": _edge(model)}


def steps(model: Any, state: Any, arrived: jax.Array) -> Any:
    """The state after physics steps in which ``arrived (T, nu)`` reaches the
    actuators."""
    if _varies(model):
        return jax.lax.scan(lambda s, u: (_one(model, s, u), None), state, arrived)[0]
    changed, qfrc, xfrc = _steady(model)
    out, _, sensed = native.run(
        *(changed, state, arrived, qfrc, xfrc),
        **_of_model(model),
    )
    return _after(model, state, out, sensed)


def steps_sensed(
    model: Any, state: Any, arrived: jax.Array
) -> tuple[Any, jax.Array] | None:
    """`steps`, and what ``model.sense`` reads in the first and the last of them,
    ``(2, size)``, by one call of MuJoCo; None where it takes more."""
    if _varies(model):
        return None
    changed, qfrc, xfrc = _steady(model)
    out, _, sensed = native.run(
        *(changed, state, arrived, qfrc, xfrc),
        **_of_model(model),
        each=True,
    )
    return _after(model, state, out, sensed[0, 1]), sensed[0]


def replay(
    model: Any, state: Any, arrived: jax.Array, steps: Any = None
) -> tuple[jax.Array, jax.Array, jax.Array] | None:
    """Positions and velocities ``(H, ...)`` after each of H control steps in which
    ``arrived (H, substeps, nu)`` reaches the actuators, and what ``model.sense`` reads
    in the first and the last physics step of each, ``(H, 2, size)``, by one call of
    MuJoCo; None where it takes more. ``steps``: as for
    `easi_jax.simulation.open_loop.predict`."""
    if _varies(model):
        return None
    h, substeps, nu = arrived.shape
    changed, qfrc, xfrc = _steady(model)
    ctrl = arrived.reshape(h * substeps, nu)
    count = None if steps is None else jnp.asarray(steps * substeps)
    given = changed, state, ctrl, qfrc, xfrc
    more = {"every": substeps, "count": count, "each": True, **_of_model(model)}
    _, path, sensed = native.run(*given, **more)
    return (*path, sensed)


def _after(model: Any, state: Any, out: tuple[jax.Array, ...], sensed: Any) -> Any:
    qpos, qvel, act, warmstart, rest = out
    return state.replace(
        qpos=qpos,
        qvel=qvel,
        act=act,
        warmstart=warmstart,
        rest=rest,
        sensed=sensed if model.sense is not None else (),
    )


def _steady(model: Any) -> tuple[Any, Any, Any]:
    """The model, and forces on joints and bodies, where all stay as they are."""
    m, e, acting = model.mjx, model.effects, _acting(model)
    if not acting:
        return m, None, None
    at, dof = scalar_places(m).T
    new: dict[str, Any] = {}
    torque = e.constant + e.spring
    if "coulomb" in acting:
        new["dof_frictionloss"] = m.dof_frictionloss + e.coulomb
    if "damping" in acting:
        new["dof_damping"] = m.dof_damping + e.damping
    if "stiffness" in acting:
        # MuJoCo's spring rests at `qpos_spring`, the effect's at zero.
        joint = np.asarray(m.dof_jntid)[dof]
        new["jnt_stiffness"] = m.jnt_stiffness.at[joint].add(e.stiffness[dof])
        rest = m.qpos_spring[at]
        torque = torque.at[dof].add(-e.stiffness[dof] * rest)
    xfrc = None
    if "force" in acting:
        xfrc = jnp.concatenate([e.force, jnp.zeros_like(e.force)], 1)
    return m.tree_replace(new), torque, xfrc


def _one(model: Any, state: Any, ctrl: jax.Array) -> Any:
    """One physics step."""
    m, e, rotor = model.mjx, model.effects, state.rotor
    acting = _acting(model)
    if model.torque_speed is not None:
        m = model.torque_speed.limited(m, state.qvel)
    zero = jnp.zeros((m.nbody, 6), state.qpos.dtype)
    d = StepData(
        *(state.qpos, state.qvel, state.act, ctrl),
        *(jnp.zeros_like(state.qvel), zero, state.time),
    )
    if acting:
        m, d, rotor = effects.in_step(m, d, e, rotor, state.hidden)  # type: ignore[arg-type]
        if "resistance" in acting:
            places = native.bodies(m, state)
            d = d.replace(**dict(zip(native.PLACES, places, strict=True)))
            d = effects.body_resistance(m, d, e)  # type: ignore[arg-type]
    out, _, sensed = native.run(
        *(m, state, d.ctrl[None], d.qfrc_applied, d.xfrc_applied),
        **_of_model(model),
    )
    after = _after(model, state, out, sensed).replace(rotor=rotor)
    if isinstance(state.time, tuple):
        return after
    h, now = m.opt.timestep, (state.qpos, state.qvel, ctrl, state.time)
    hidden = next_states(e.laws, state.hidden, *now, h)
    return after.replace(time=state.time + h, hidden=hidden)

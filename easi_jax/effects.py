"""Physical effects that a model lacks, as values in the physics step.

An `Effects` holds one number for every effect at every place of a model; all at zero
strength (`none`) it changes nothing. Static ones (masses, armature, gravity, force
limits, contacts) are written into the model once by `with_effects`; the others act in
each physics step (`in_step`) and on the way of a command to its actuator (`commands`).
Names and meanings: `easi_jax.gap.table`.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from easi_jax.constants import set_const

_NO_LIMIT = 1e9
_TINY = 1e-9


@flax.struct.dataclass
class Effects:
    """Strength of every effect at every place; SI units.

    Attributes:
        coulomb: dry friction, ``(nv,)``; hinges and slides, as all of its size.
        static: what friction at rest has beyond ``coulomb``, ``(nv,)``.
        stribeck: speed at which that has fallen to 1/e, ``(nv,)``.
        damping: torque per speed, ``(nv,)``.
        drag: torque per squared speed, ``(nv,)``.
        stiffness: of a spring, ``(nv,)``.
        spring: torque of that spring at position zero, ``(nv,)``.
        constant: torque that never changes, ``(nv,)``.
        ripple: amplitude of a torque periodic in position, ``(nv,)``.
        cycles: of the ripple per 2 pi of position, ``(nv,)``.
        phase: of the ripple at position zero, ``(nv,)`` [rad].
        armature: inertia beyond the model's, ``(nv,)``.
        gain: factor on a command within its range, ``(nu,)``.
        delay: of a command, ``(nu,)`` [s].
        lag: time constant of a first-order response to a command, ``(nu,)`` [s].
        limit: largest force, ``(nu,)``.
        deadband: commands up to this have no effect, ``(nu,)``.
        jump: share of ``deadband`` that a larger command has at once, ``(nu,)``.
        mass: beyond the model's, ``(nbody,)``.
        spread: 0: ``mass`` is a point at the body's center of mass; 1: it is spread
            like the body's own, ``(nbody,)``.
        com: shift of the center of mass in the body's frame, ``(nbody, 3)``.
        force: on the body's center of mass, world frame, ``(nbody, 3)``.
        tilt: roll and pitch of the base, ``(2,)`` [rad].
        friction: factor on every contact's sliding friction, ``()``.
        softness: factors on stiffness and damping of every contact, ``(2,)``.
        bias: reading less truth, ``(nv,)``.
        late: how late a reading is, ``(nv,)`` [s].
    """

    coulomb: jax.Array
    static: jax.Array
    stribeck: jax.Array
    damping: jax.Array
    drag: jax.Array
    stiffness: jax.Array
    spring: jax.Array
    constant: jax.Array
    ripple: jax.Array
    cycles: jax.Array
    phase: jax.Array
    armature: jax.Array
    gain: jax.Array
    delay: jax.Array
    lag: jax.Array
    limit: jax.Array
    deadband: jax.Array
    jump: jax.Array
    mass: jax.Array
    spread: jax.Array
    com: jax.Array
    force: jax.Array
    tilt: jax.Array
    friction: jax.Array
    softness: jax.Array
    bias: jax.Array
    late: jax.Array


@flax.struct.dataclass
class CommandMemory:
    """What the way of a command to its actuator remembers.

    Attributes:
        past: commands of the last steps, oldest first, ``(n, nu)``.
        response: what has arrived through the lag, ``(nu,)``.
        known: whether there was a command yet, ``()`` bool.
    """

    past: jax.Array
    response: jax.Array
    known: jax.Array


def none(m: mujoco.MjModel) -> Effects:
    """No effect anywhere."""
    dof, act, body = jnp.zeros(m.nv), jnp.zeros(m.nu), jnp.zeros(m.nbody)
    ones = jnp.ones
    return Effects(
        coulomb=dof,
        static=dof,
        stribeck=ones(m.nv),
        damping=dof,
        drag=dof,
        stiffness=dof,
        spring=dof,
        constant=dof,
        ripple=dof,
        cycles=ones(m.nv),
        phase=dof,
        armature=dof,
        gain=ones(m.nu),
        delay=act,
        lag=act,
        limit=jnp.full(m.nu, _NO_LIMIT),
        deadband=act,
        jump=act,
        mass=body,
        spread=body,
        com=jnp.zeros((m.nbody, 3)),
        force=jnp.zeros((m.nbody, 3)),
        tilt=jnp.zeros(2),
        friction=ones(()),
        softness=ones(2),
        bias=dof,
        late=dof,
    )


def with_effects(m: mjx.Model, e: Effects) -> mjx.Model:
    """The model with all static effects; pure.

    The model must have been put with force limits on, and contacts in direct form
    where ``softness`` varies.
    """
    mass = m.body_mass + e.mass
    share = jnp.where(
        m.body_mass > 0, e.mass / jnp.where(m.body_mass > 0, m.body_mass, 1.0), 0.0
    )
    inertia = m.body_inertia * (1.0 + e.spread * share)[:, None]
    limit = e.limit
    edge = m.actuator_forcerange
    m = m.tree_replace(
        {
            "body_mass": mass,
            "body_inertia": inertia,
            "body_ipos": m.body_ipos + e.com,
            "dof_armature": m.dof_armature + e.armature,
            "actuator_forcerange": jnp.stack(
                [jnp.maximum(edge[:, 0], -limit), jnp.minimum(edge[:, 1], limit)], 1
            ),
            # Not on the command itself, which MuJoCo clips to its range.
            "actuator_gainprm": m.actuator_gainprm.at[:, :3].multiply(e.gain[:, None]),
            "opt.gravity": tilted(m.opt.gravity, e.tilt),
        }
    )
    friction = m.geom_friction.at[:, 0].multiply(e.friction)
    m = m.replace(geom_friction=friction)
    if m.npair:
        m = m.replace(
            pair_friction=m.pair_friction.at[:, :2].multiply(e.friction),
            pair_solref=_softened(m.pair_solref, e.softness),
        )
    m = m.replace(geom_solref=_softened(m.geom_solref, e.softness))
    return set_const(m)


def _softened(solref: jax.Array, factors: jax.Array) -> jax.Array:
    # Only the direct form (-stiffness, -damping) scales like this.
    return jnp.where(solref < 0, solref * factors, solref)


def tilted(gravity: jax.Array, tilt: jax.Array) -> jax.Array:
    """Gravity in the frame of a base that is rolled, then pitched."""
    (cr, cp), (sr, sp) = jnp.cos(tilt), jnp.sin(tilt)
    x, y, z = gravity
    # transpose of Ry(pitch) Rx(roll)
    x, z = cp * x - sp * z, sp * x + cp * z
    y, z = cr * y + sr * z, -sr * y + cr * z
    return jnp.stack([x, y, z])


def in_step(
    m: mjx.Model, d: mjx.Data, e: Effects, scalar: tuple[tuple[int, int], ...]
) -> tuple[mjx.Model, mjx.Data]:
    """Model and data of one physics step.

    Args:
        scalar: places in ``qpos`` and ``qvel`` of the hinges and slides.
    """
    at, dof = (np.array(x, int) for x in zip(*scalar, strict=True))
    v = d.qvel
    fall = jnp.exp(-jnp.square(v / e.stribeck))
    m = m.replace(
        dof_frictionloss=m.dof_frictionloss + e.coulomb + e.static * fall,
        # As damping it is treated implicitly, and stays stable.
        dof_damping=m.dof_damping + e.damping + e.drag * jnp.abs(v),
    )
    q = jnp.zeros(m.nv, d.qpos.dtype).at[dof].set(d.qpos[at])
    torque = e.constant + e.spring - e.stiffness * q
    torque += e.ripple * jnp.sin(e.cycles * q + e.phase)
    force = jnp.concatenate([e.force, jnp.zeros_like(e.force)], 1)
    return m, d.replace(
        qfrc_applied=d.qfrc_applied + torque, xfrc_applied=d.xfrc_applied + force
    )


def first_memory(steps: int, nu: int) -> CommandMemory:
    """Before any command; delays of up to ``steps`` control steps fit."""
    return CommandMemory(jnp.zeros((steps + 1, nu)), jnp.zeros(nu), jnp.zeros((), bool))


def commands(
    e: Effects, memory: CommandMemory, ctrl: jax.Array, dt: float, substeps: int
) -> tuple[jax.Array, CommandMemory]:
    """What arrives at the actuators during a control step.

    Delay, deadband and lag, in this order. Commands are held; of a physics step
    in which a late command changes the mean counts, and so it does of the lag's
    response. Before the first command the first one is taken to have been sent for
    ever.

    Args:
        ctrl: sent at the start of the step, ``(nu,)``.
        dt: control step [s].

    Returns:
        Commands in each physics step ``(substeps, nu)``, and the memory after.
    """
    n, nu = memory.past.shape
    past = jnp.where(memory.known, memory.past, ctrl)
    line = jnp.concatenate([past, ctrl[None]])  # row n is now
    h = dt / substeps
    start = np.arange(substeps)[:, None] / substeps - e.delay / dt  # (substeps, nu)
    start = jnp.clip(start, -float(n) + 1, 1.0)
    whole = jnp.floor(start)
    old = jnp.clip((whole + 1 - start) * substeps, 0.0, 1.0)
    row = whole.astype(jnp.int32) + n
    column = jnp.arange(nu)
    u = old * line[row, column]
    u += (1 - old) * line[jnp.minimum(row + 1, n), column]
    size = jnp.maximum(jnp.abs(u) - e.deadband, 0.0)
    size = jnp.where(size > 0, size + e.jump * e.deadband, 0.0)
    u = jnp.where(e.deadband > 0, jnp.sign(u) * size, u)
    tau = jnp.maximum(e.lag, _TINY)
    left = jnp.exp(-h / tau)
    mean = tau / h * (1 - left)
    response = jnp.where(memory.known, memory.response, u[0])
    out = []
    for i in range(substeps):
        out.append(u[i] + (response - u[i]) * mean)
        response = u[i] + (response - u[i]) * left
    return jnp.stack(out), CommandMemory(line[1:], response, jnp.ones((), bool))


def reading(
    e: Effects, before: jax.Array, q: jax.Array, v: jax.Array, dt: float
) -> jax.Array:
    """What late and biased sensors say of a motion.

    Args:
        before: readings at the start and after each step as they were measured, for
            what has not arrived yet, ``(H + 1, nv)``.
        q, v: positions and velocities at the same times, ``(H + 1, nv)``.

    Returns:
        Readings after each step, ``(H, nv)``.
    """
    h, nv = q.shape[0] - 1, q.shape[1]
    when = jnp.arange(1, h + 1)[:, None] - e.late / dt
    row = jnp.clip(jnp.floor(when), 0, h - 1).astype(jnp.int32)
    s = when - row
    column = jnp.arange(nv)
    a, b = q[row, column], q[row + 1, column]
    va, vb = v[row, column] * dt, v[row + 1, column] * dt
    # Hermite's cubic
    s2, s3 = s * s, s * s * s
    between = (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + s) * va
    between += (3 * s2 - 2 * s3) * b + (s3 - s2) * vb
    return jnp.where(when < 0, before[1:], between + e.bias)


def scalar_joints(m: Any) -> tuple[tuple[int, int], ...]:
    """(place in qpos, place in qvel) of every hinge and slide."""
    return tuple(
        (int(q), int(v))
        for kind, q, v in zip(m.jnt_type, m.jnt_qposadr, m.jnt_dofadr, strict=True)
        if kind >= 2
    )

"""Physical effects that a model lacks, as values in the physics step.

An `Effects` holds one number for every effect at every place of a model; all at zero
strength (`none`) it changes nothing. Static ones (masses, armature, gravity, force
limits, contacts of the whole model) are written into the model once by `with_effects`;
the others act in each physics step (`in_step`, `body_resistance`, `pair_contacts`) and
on the way of a command to its actuator (`commands`).
Their names: `easi_jax.model.effect_catalog`.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src.types import DisableBit, IntegratorType

from easi_jax.model import backlash
from easi_jax.model.backlash import MotorState
from easi_jax.model.contact_pairs import Pair, pair_ids
from easi_jax.model.effect_numbers import (
    NO_FORCE_LIMIT,
    NUMBERS,
    OWN,
    OWN_LAWS,
    EffectNumber,
    field_of,
    fields_that_act,
    is_vector,
)
from easi_jax.model.joint_space import scalar_places
from easi_jax.model.native_model import NativeModel, as_precise
from easi_jax.model.own_laws import Law, acting, actuators_of, joints_of, widest
from easi_jax.model.set_const import set_const

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
        kp: factor on how strongly a drive holds its position, ``(nu,)``.
        kv: factor on how strongly a drive resists or holds its speed, ``(nu,)``.
        strength: factor on an actuator's force within its limit, ``(nu,)``.
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
        resistance: force on the body's center of mass per squared speed, against it,
            ``(nbody,)``.
        tilt: roll and pitch of the base, ``(2,)`` [rad].
        friction: factor on every contact's sliding friction, ``()``.
        softness: factors on stiffness and damping of every contact, ``(2,)``.
        slip: factor on the sliding friction of a pair of geoms, ``(P,)``
            (`easi_jax.model.contact_pairs`).
        give: factors on stiffness and damping of a pair's contacts, ``(P, 2)``.
        bias: reading less truth, ``(nv,)``.
        late: how late a reading is, ``(nv,)`` [s].
        width: total play between a drive and its joint, ``(nv,)``.
        rotor: inertia of the drive's side, part of the joint's, ``(nv,)``.
        effective_inertia: that a torque at the joint alone meets, ``(nv,)``; no effect,
            but what `backlash` goes by.
        own: numbers of what owners wrote, a row each, ``(K, P)``; () without any.
        laws: what that does (static).
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
    kp: jax.Array
    kv: jax.Array
    strength: jax.Array
    delay: jax.Array
    lag: jax.Array
    limit: jax.Array
    deadband: jax.Array
    jump: jax.Array
    mass: jax.Array
    spread: jax.Array
    com: jax.Array
    force: jax.Array
    resistance: jax.Array
    tilt: jax.Array
    friction: jax.Array
    softness: jax.Array
    slip: jax.Array
    give: jax.Array
    bias: jax.Array
    late: jax.Array
    width: jax.Array
    rotor: jax.Array
    effective_inertia: jax.Array
    own: Any = ()
    laws: tuple[Law, ...] = flax.struct.field(pytree_node=False, default=())

    if TYPE_CHECKING:  # made by flax

        def replace(self, **changes: Any) -> "Effects": ...


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
    count = {"joint": m.nv, "actuator": m.nu, "body": m.nbody}
    count["geom"] = len(pair_ids(m))
    fields: dict[str, list[EffectNumber]] = {}
    for column, number in NUMBERS.items():
        if (field := field_of(column)) != OWN:
            fields.setdefault(field, []).append(number)

    def leaf(field: str, numbers: Sequence[EffectNumber]) -> jax.Array:
        places = [count[n.on] for n in numbers[:1] if n.on != "model"]
        entries = [len(numbers)] if is_vector(field) else []
        neutral = min(numbers[0].neutral, NO_FORCE_LIMIT)
        return jnp.full((*places, *entries), neutral, jnp.float32)

    return Effects(
        effective_inertia=jnp.asarray(backlash.felt_inertia(m), jnp.float32),
        **{field: leaf(field, numbers) for field, numbers in fields.items()},
        **_own(m),
    )


def laws_of(m: mujoco.MjModel) -> tuple[Law, ...]:
    """What owners wrote, and laws that were found, in a model."""
    if not OWN_LAWS:
        return ()
    laws: list[Law] = []
    dofs = {name: dof for name, _, dof in joints_of(m)}
    sites = {"joint": dofs, "model": {"": 0}}
    sites["actuator"] = {name: a for a, name in enumerate(actuators_of(m))}
    row = states = 0
    for own in OWN_LAWS.values():
        mine = [(name, at) for name, at in sites[own.on].items() if own.fits(name)]
        if own.names <= {*dofs, *sites["actuator"]}:
            what = (own.name, own.numbers, row, tuple(mine))
            about = (joints_of(m), actuators_of(m))
            does = (own.force, own.command, own.reading, own.memories)
            laws.append(Law(*what, *about, *does, states))
            states += len(own.memories)
        row += len(own.numbers)
    return tuple(laws)


def _own(m: mujoco.MjModel) -> dict[str, Any]:
    """What owners wrote, without strength."""
    if not OWN_LAWS:
        return {}
    columns = (f"{own.name}.{n}" for own in OWN_LAWS.values() for n in own.numbers)
    neutral = [NUMBERS[column].neutral for column in columns]
    known = jnp.broadcast_to(jnp.array(neutral)[:, None], (len(neutral), widest(m)))
    return {OWN: known.astype(jnp.float32), "laws": laws_of(m)}


_STATIC = fields_that_act("model")
_IN_CONTACTS = fields_that_act("contacts")
_ON_COMMANDS = fields_that_act("command")


def has_step_effects(present: tuple[str, ...] | None) -> bool:
    """Whether some of these fields (None: all) act in the steps themselves."""
    return present is None or any(name not in _STATIC for name in present)


def has_command_memory(present: tuple[str, ...] | None) -> bool:
    """Whether some of these fields (None: all) lie on the way of a command."""
    return present is None or any(name in _ON_COMMANDS for name in present)


def has_backlash(present: tuple[str, ...] | None) -> bool:
    """Whether drives may have play."""
    return present is None or "width" in present


def has_own(e: Effects | None, present: tuple[str, ...] | None) -> bool:
    """Whether something acts that an owner wrote."""
    return e is not None and bool(e.laws) and (present is None or OWN in present)


def has_bias(present: tuple[str, ...] | None) -> bool:
    """Whether readings of joints may have an offset."""
    return present is None or "bias" in present


def has_body_drag(present: tuple[str, ...] | None) -> bool:
    """Whether bodies may have drag."""
    return present is None or "resistance" in present


def has_contact_effects(present: Iterable[str] | None) -> bool:
    """Whether contacts are changed in the step, where they are made."""
    return present is None or any(name in _IN_CONTACTS for name in present)


def with_effects(
    m: mjx.Model, e: Effects, present: tuple[str, ...] | None = None
) -> mjx.Model:
    """The model with all static effects; pure.

    The model must have been put with force limits on where ``limit`` varies, and, for
    RK4, with `effect_numbers.direct_contacts` where ``softness`` does.

    Args:
        present: fields that may differ from none; None: any of them.
    """

    def on(*names: str) -> bool:
        return present is None or any(name in present for name in names)

    native = isinstance(m, NativeModel)
    new: dict[str, Any] = {}
    if on("mass", "spread"):
        mass = m.body_mass
        share = jnp.where(mass > 0, e.mass / jnp.where(mass > 0, mass, 1.0), 0.0)
        new["body_mass"] = mass + e.mass
        new["body_inertia"] = m.body_inertia * (1.0 + e.spread * share)[:, None]
    if on("com"):
        new["body_ipos"] = m.body_ipos + e.com
    if on("armature", "width"):
        new["dof_armature"] = m.dof_armature + e.armature - _apart(e)
    if on("limit"):
        low, high = m.actuator_forcerange[:, 0], m.actuator_forcerange[:, 1]
        edge = jnp.maximum(low, -e.limit), jnp.minimum(high, e.limit)
        new["actuator_forcerange"] = jnp.stack(edge, 1)
    if on("gain", "kp", "kv", "strength"):
        gain, bias = m.actuator_gainprm, m.actuator_biasprm
        # Not on the command itself, which MuJoCo clips to its range.
        gains, biases = drive_factors(bias, e.gain, e.kp, e.kv, e.strength, jnp)
        new["actuator_gainprm"] = _times(gain, 3, gains)
        if np.any(np.asarray(m.actuator_biastype) == mujoco.mjtBias.mjBIAS_AFFINE):
            new["actuator_biasprm"] = _times(bias, 3, biases)
    if on("tilt"):
        new["opt.gravity"] = tilted(m.opt.gravity, e.tilt)
    if on("friction"):
        new["geom_friction"] = _times(m.geom_friction, 1, e.friction)
        if m.npair:
            new["pair_friction"] = _times(m.pair_friction, 2, e.friction)
    if on("softness") and (native or m.opt.integrator == IntegratorType.RK4):
        new["geom_solref"] = _softened(m.geom_solref, e.softness)
        if m.npair:
            new["pair_solref"] = _softened(m.pair_solref, e.softness)
    m = m.tree_replace(new)
    return set_const(m) if on("mass", "com", "armature", "width") else m


def drive_factors(
    bias: Any, gain: Any, kp: Any, kv: Any, strength: Any, xp: Any
) -> tuple[Any, Any]:
    """Factors on the gains and biases of actuators, ``(n, 1)`` and ``(n, 3)``.

    What says how strongly a drive goes for its target multiplies all that makes up the
    target: the gain on the command and the constant bias, beside the feedback. That is
    ``kp``; of a drive without feedback of its position, ``kv``.

    Args:
        bias: ``actuator_biasprm (n, 10)``.
        gain, kp, kv, strength: as in `Effects`, ``(n,)``.
        xp: numpy or jax.numpy.
    """
    target = xp.where(bias[:, 1] == 0, kv, kp)
    gains = (gain * target * strength)[:, None]
    return gains, strength[:, None] * xp.stack([target, kp, kv], 1)


def _apart(e: Effects) -> jax.Array:
    """Inertia of drives with play, ``(nv,)``."""
    return jnp.where(e.width > 0, e.rotor, 0.0)


def _times(leaf: jax.Array, columns: int, factors: jax.Array) -> jax.Array:
    """``leaf (n, k)``, its first columns times ``factors``; as precise as either."""
    return as_precise(leaf, factors).at[:, :columns].multiply(factors)


def _softened(solref: jax.Array, factors: jax.Array) -> jax.Array:
    """Solver references ``(n, 2)``: (time constant, damping ratio), the stiffness of
    which goes with the inverse square of both, or the direct (-stiffness, -damping)."""
    stiffer, damped = factors[..., 0], factors[..., 1]
    standard = jnp.stack([1 / damped, damped / jnp.sqrt(stiffer)], -1)
    return solref * jnp.where(solref[:, :1] > 0, standard, factors)


def _direct(m: mjx.Model, solref: jax.Array) -> jax.Array:
    """Solver references ``(n, 2)`` in direct form; as `quantities.direct_solref`."""
    time, ratio = solref.T
    standard = time > 0
    if not m.opt.disableflags & DisableBit.REFSAFE:
        time = jnp.maximum(time, 2 * m.opt.timestep)
    time, ratio = (jnp.where(standard, x, 1.0) for x in (time, ratio))
    square = jnp.maximum((time * ratio) ** 2, mujoco.mjMINVAL)
    direct = -jnp.stack([1 / square, 2 / time], 1)
    return jnp.where(standard[:, None], direct, solref)


def tilted(gravity: jax.Array, tilt: jax.Array) -> jax.Array:
    """Gravity in the frame of a base that is rolled, then pitched."""
    (cr, cp), (sr, sp) = jnp.cos(tilt), jnp.sin(tilt)
    x, y, z = gravity
    # transpose of Ry(pitch) Rx(roll)
    x, z = cp * x - sp * z, sp * x + cp * z
    y, z = cr * y + sr * z, -sr * y + cr * z
    return jnp.stack([x, y, z])


def in_step(
    m: mjx.Model,
    d: mjx.Data,
    e: Effects,
    rotor: Any,
    hidden: Any = (),
) -> tuple[mjx.Model, mjx.Data, Any]:
    """Model, data and drives with play of one physics step.

    Args:
        d: before `forward`.
        rotor: drives before the step (`backlash.Rotor`); empty where none has play.
        hidden: what laws remember (`own_laws.next_states`); an empty tuple where none
            acts (`has_own`).
    """
    at, dof = scalar_places(m).T
    if e.laws and not isinstance(hidden, tuple):
        d = acting(d, e.own, e.laws, hidden)
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
    drives = backlash.geared(m)
    if drives and isinstance(rotor, MotorState):
        load = jnp.maximum(
            e.effective_inertia + e.armature - e.rotor, 0.05 * e.effective_inertia
        )
        u = backlash.sent(m, d.ctrl, d.act)
        rotor = backlash.pushes(
            *(m, drives, rotor, e.width, e.rotor, load, (q, v), u, m.opt.timestep)
        )
        m, torque = _driven(m, e, drives), torque + rotor.push
    d = d.replace(
        qfrc_applied=d.qfrc_applied + torque, xfrc_applied=d.xfrc_applied + force
    )
    return m, d, rotor


def _driven(m: mjx.Model, e: Effects, drives: dict[int, list[int]]) -> mjx.Model:
    """The model without the actuators that push on rotors."""
    left = jnp.ones(m.nu)
    for dof, actuators in drives.items():
        left = left.at[np.array(actuators)].set(jnp.where(e.width[dof] > 0, 0.0, 1.0))
    return m.replace(
        actuator_gainprm=m.actuator_gainprm * left[:, None],
        actuator_biasprm=m.actuator_biasprm * left[:, None],
    )


def body_resistance(m: mjx.Model, d: mjx.Data, e: Effects) -> mjx.Data:
    """Data with the quadratic drag of bodies, after `fwd_velocity`."""
    arm = d.xipos - d.subtree_com[np.asarray(m.body_rootid)]
    v = d.cvel[:, 3:] + jnp.cross(d.cvel[:, :3], arm)
    speed = jnp.sqrt(jnp.sum(v * v, 1) + 1e-12)
    force = -(e.resistance * speed)[:, None] * v
    return d.replace(xfrc_applied=d.xfrc_applied.at[:, :3].add(force))


def pair_contacts(
    m: mjx.Model, d: mjx.Data, e: Effects, pairs: Sequence[Pair]
) -> mjx.Data:
    """Data whose contacts have the softness of all and what their pair of geoms has,
    after `collision`.

    ``pairs`` are all that may touch in the model as given, by whose places effects are
    numbered; some may be left out of ``m``.
    """
    if not d._impl.ncon:
        return d
    number = np.zeros((m.ngeom, m.ngeom), np.int32)
    for k, (a, b) in enumerate(pairs):
        number[a, b] = number[b, a] = k
    contact = d._impl.contact
    pair = jnp.asarray(number)[contact.geom1, contact.geom2]
    friction = contact.friction.at[:, :2].multiply(e.slip[pair][:, None])
    factors = e.softness * e.give[pair]
    solref = _softened(_direct(m, contact.solref), factors)
    contact = contact.replace(friction=friction, solref=solref)
    return d.tree_replace({"_impl.contact": contact})


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
    whole, old = _late(e, n, dt, substeps)
    column = jnp.arange(nu)
    u = old * line[whole + n, column]
    u += (1 - old) * line[jnp.minimum(whole + 1 + n, n), column]
    u = _beyond_deadband(e, u)
    response = jnp.where(memory.known, memory.response, u[0])
    out = []
    for i in range(substeps):
        arrived, response = _lagging(e, response, u[i], dt / substeps)
        out.append(arrived)
    return jnp.stack(out), CommandMemory(line[1:], response, jnp.ones((), bool))


def command_sequence(
    e: Effects, ctrl: jax.Array, steps: int, dt: float, substeps: int
) -> jax.Array:
    """What arrives in each physics step of many control steps, ``(T, substeps, nu)``.

    As `commands` step by step, with all commands known.

    Args:
        ctrl: sent at the start of each step, ``(T, nu)``.
        steps: control steps that a command can be late.
    """
    t, nu = ctrl.shape
    whole, old = _late(e, steps, dt, substeps)
    row = jnp.arange(t)[:, None, None] + whole
    column = jnp.arange(nu)
    before = ctrl[jnp.maximum(row, 0), column]
    after = ctrl[jnp.clip(row + 1, 0, jnp.arange(t)[:, None, None]), column]
    u = _beyond_deadband(e, old * before + (1 - old) * after)
    flat = u.reshape(t * substeps, nu)

    def step(response: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        arrived, response = _lagging(e, response, u, dt / substeps)
        return response, arrived

    return jax.lax.scan(step, flat[0], flat)[1].reshape(u.shape)


def _late(
    e: Effects, steps: int, dt: float, substeps: int
) -> tuple[jax.Array, jax.Array]:
    """Which command a physics step gets, relative to the present one, and the share of
    the step in which it does; the rest has the one after, ``(substeps, nu)`` both."""
    start = np.arange(substeps)[:, None] / substeps - e.delay / dt
    start = jnp.clip(start, -float(steps) + 1, 1.0)
    whole = jnp.floor(start)
    old = jnp.clip((whole + 1 - start) * substeps, 0.0, 1.0)
    return whole.astype(jnp.int32), old


def _beyond_deadband(e: Effects, u: jax.Array) -> jax.Array:
    size = jnp.maximum(jnp.abs(u) - e.deadband, 0.0)
    size = jnp.where(size > 0, size + e.jump * e.deadband, 0.0)
    return jnp.where(e.deadband > 0, jnp.sign(u) * size, u)


def _lagging(
    e: Effects, response: jax.Array, u: jax.Array, h: float
) -> tuple[jax.Array, jax.Array]:
    """Mean response in a step to a held command, and the response at its end."""
    tau = jnp.maximum(e.lag, _TINY)
    left = jnp.exp(-h / tau)
    mean = tau / h * (1 - left)
    return u + (response - u) * mean, u + (response - u) * left


def warmed(
    e: Effects, memory: CommandMemory, past: jax.Array, dt: float, substeps: int
) -> CommandMemory:
    """The memory after commands ``past (D, nu)``, oldest first; see `commands`."""

    def one(memory: CommandMemory, u: jax.Array) -> tuple[CommandMemory, None]:
        return commands(e, memory, u, dt, substeps)[1], None

    return jax.lax.scan(one, memory, past)[0]

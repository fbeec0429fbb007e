"""An MJX model whose physical parameters are an argument."""

import contextlib
import copy
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from easi_jax.devices.mesh import own_device
from easi_jax.errors import UserError
from easi_jax.model import effects as physical
from easi_jax.model.addresses import Writer, open_gates, resolve
from easi_jax.model.contact_pairs import Pair, pair_ids, without_pairs
from easi_jax.model.effect_numbers import direct_contacts, field_of
from easi_jax.model.effects import Effects
from easi_jax.model.mjx_data import make_data, without_idle_cone
from easi_jax.model.native_model import NativeModel, Template, as_precise
from easi_jax.model.quantities import length_of, long_axis, unit_inertia
from easi_jax.model.set_const import set_const
from easi_jax.model.torque_speed import TorqueSpeed

Sense = Callable[[mjx.Model, mjx.Data], jax.Array]


@flax.struct.dataclass
class Model:
    """What a simulation runs on; a pytree.

    Attributes:
        mjx: the MJX model; for the engine ``mujoco`` a `NativeModel`, which has the
            same fields.
        speed_limit: largest joint speed, ``(nv,)`` [m/s, rad/s]; inf where none.
        writers: which numbers follow which parameter (static).
        long_axes: the axis of each geom that its length is measured along (static).
        sense: ``sense(mjx_model, data) -> (sense_size,)``, read in every physics step
            (static); None for nothing.
        sense_size: how many numbers it reads (static).
        torque_speed: what the actuators can give at which speed, within their force
            limits; None for no such curve.
        effects: what acts beyond the model; None for nothing.
        present: fields of the effects that may differ from none; None: any (static).
        delay_steps: control steps that a command can be late (static).
        pairs: of geoms that may touch in the model as given (static).
    """

    mjx: mjx.Model
    speed_limit: jax.Array
    writers: tuple[Writer, ...] = flax.struct.field(pytree_node=False, default=())
    long_axes: tuple[int, ...] = flax.struct.field(pytree_node=False, default=())
    sense: Sense | None = flax.struct.field(pytree_node=False, default=None)
    sense_size: int = flax.struct.field(pytree_node=False, default=0)
    torque_speed: TorqueSpeed | None = None
    effects: Effects | None = None
    present: tuple[str, ...] | None = flax.struct.field(pytree_node=False, default=None)
    delay_steps: int = flax.struct.field(pytree_node=False, default=0)
    pairs: tuple[Pair, ...] = flax.struct.field(pytree_node=False, default=())

    if TYPE_CHECKING:  # made by flax

        def replace(self, **changes: Any) -> "Model": ...


# What MJX carries from step to step, or is given with each.
_CARRIED = ("TIME", "QPOS", "QVEL", "ACT", "WARMSTART", "CTRL", "QFRC_APPLIED")
_CARRIED += ("XFRC_APPLIED", "EQ_ACTIVE", "MOCAP_POS", "MOCAP_QUAT", "USERDATA")
# Other state that MuJoCo carries: one step from a fresh start does not show it.
_STATE_WORDS = {
    "HISTORY": (
        "actuator or sensor delay (delay, nsample)",
        "take it out; a delay can be found and fixed as an effect "
        "(effect.delay.ACTUATOR)",
    ),
    "PLASTIC": ("springs that yield (springyield)", "take springyield out"),
    "PLUGIN": ("plugins", "take them out"),
}

# Numbers of a model that MJX ignores without a word where they are not zero: what they
# are, and what to do. What it refuses by itself is not here, nor what it computes
# wrongly: that the guard finds (`easi_jax.simulation.guard`).
_IGNORED: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("nplugin",), "plugins", "take them out"),
    (
        ("actuator_damping", "actuator_armature", "actuator_dampingpoly"),
        "actuator damping or armature",
        "give both to the joint",
    ),
    (
        (
            *("jnt_stiffnesspoly", "dof_dampingpoly"),
            *("tendon_stiffnesspoly", "tendon_dampingpoly"),
        ),
        "polynomial stiffness or damping",
        "keep the first number only",
    ),
    (("opt.disableactuator",), "actuatorgroupdisable", "take these actuators out"),
    (("opt.noslip_iterations",), "noslip_iterations", "set it to 0"),
    (("flg_surfacevel",), "surface velocity", "take it out"),
    (("geom_adhesion", "pair_adhesion"), "adhesion of geoms", "take it out"),
)


def _unsupported(m: mujoco.MjModel) -> tuple[str, str] | None:
    """What MJX would ignore without a word, and what to do."""
    for i in range(int(mujoco.mjtState.mjNSTATE)):
        part = mujoco.mjtState(1 << i)
        name = part.name.removeprefix("mjSTATE_")
        if name not in _CARRIED and mujoco.mj_stateSize(m, part):
            unknown = (f"state ({name.lower()})", "take what has it out")
            return _STATE_WORDS.get(name, unknown)
    for fields, what, do in _IGNORED:
        if any(np.any(attrgetter(field)(m)) for field in fields):
            return what, do
    motors = m.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR  # refused by MJX itself
    if np.any(m.actuator_actearly[~motors]):
        return 'actearly="true"', "take it out"
    fluid = m.opt.density > 0 or m.opt.viscosity > 0
    if fluid and np.any(m.geom_fluid[:, 0]):
        return 'fluidshape="ellipsoid"', 'set fluidshape="none"'
    return None


# Words in what MJX says, and what to do then; the first that fits counts.
_CURES = (
    ("mjINT_", 'set integrator="implicitfast" or "Euler"'),
    ("fluid", 'set integrator="Euler"'),
    ("mjSOL_", 'set solver="Newton"'),
    ("margin/gap", "set the margin of these geoms to 0"),
    (
        "collisions",
        "give these geoms another shape, or exclude their contact (contype and "
        "conaffinity, or <exclude>)",
    ),
    ("sensor", "take these sensors out"),
    ("mjSENS", "take these sensors out"),
    ("mjENBL_", "take this flag out of <option>"),
    ("mjEQ_", "take these constraints out"),
    ("mjTRN_", "write these actuators with joint= or tendon="),
    ("mjDYN_", "write these actuators as <motor>, <position> or <velocity>"),
    ("mjGAIN_", "write these actuators as <motor>, <position> or <velocity>"),
    ("mjBIAS_", "write these actuators as <motor>, <position> or <velocity>"),
)


@contextlib.contextmanager
def refusals(*kinds: type[Exception]) -> Iterator[None]:
    """Turns what MJX says of a model into a line for its owner.

    Args:
        kinds: exceptions by which MJX refuses.

    Raises:
        UserError: one of them was raised: what MJX lacks, and what to do.
    """
    try:
        yield
    except kinds as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        cures = (do for word, do in _CURES if word.lower() in reason.lower())
        do = next(cures, "state it another way or take it out")
        raise UserError(
            f"MJX cannot simulate this model ({reason}): {do} in the model file"
        ) from error


def simulated(m: mujoco.MjModel) -> None:
    """Refuses what no engine here simulates.

    Raises:
        UserError: what it is, and what to do.
    """
    if not 0.0 < m.opt.timestep < float("inf"):
        raise UserError(
            f"the timestep is {m.opt.timestep:g} s, and has to be positive: write "
            '<option timestep="0.002"/> in the model file'
        )
    shared = mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_IPC
    if m.opt.enableflags & shared:
        raise UserError(
            "the model enables sleep or ipc, whose state no engine here carries: take "
            "this flag out of <option> in the model file"
        )
    if len(m.actuator_trntype) != m.nu:
        raise UserError(
            "an actuator has several commands (<pid>), and here each has one: write it "
            "as <position> or <motor>"
        )


def put_model(
    mj_model: mujoco.MjModel,
    addresses_per_parameter: Iterable[Iterable[str]] = (),
    fixed: Mapping[str, float] | None = None,
    sensors: bool = True,
    native: bool = False,
    timestep: float | None = None,
    apart: Collection[Pair] = (),
) -> Model:
    """Puts a MuJoCo model on the device, ready to have parameters written into it.

    Args:
        mj_model: nominal model; it is not changed.
        addresses_per_parameter: for each parameter its addresses.
        fixed: values by address that stay, effects among them.
        sensors: whether ``sensordata`` is computed; without, sensors that MJX lacks
            do no harm.
        native: for the engine ``mujoco``, which simulates all that MuJoCo can.
        timestep: physics step [s]; the model's own where None.
        apart: pairs of geoms that MJX leaves out; native MuJoCo never does.

    Raises:
        UserError: an address that does not fit the model; or the model uses what MJX
            cannot simulate or would ignore, by name.
    """
    simulated(mj_model)
    per_parameter = tuple(tuple(a) for a in addresses_per_parameter)
    ignored = None if native else _unsupported(mj_model)
    if ignored is not None:
        what, do = ignored
        raise UserError(
            f"the model uses {what}, which MJX does not simulate: {do} in the model "
            "file"
        )
    fixed = dict(fixed or {})
    every = (*per_parameter, *((a,) for a in fixed))
    writers = resolve(mj_model, every)
    opened = open_gates(mj_model, [a for p in every for a in p])
    if not sensors:
        opened.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        opened.sensor_type[:] = mujoco.mjtSensor.mjSENS_CLOCK  # known to MJX
    if timestep is not None:
        opened.opt.timestep = timestep
    if native:
        put: Any = _put_native(opened, writers)
    else:
        opened = without_pairs(opened, apart) if apart else opened
        with refusals(Exception):
            put = mjx.put_model(without_idle_cone(opened), own_device(), impl="jax")
            make_data(put)
        moved = {w.body(opened) for w in writers if w.row.moves_center}
        put = full_structure(put, moved) if moved else put
    n = len(per_parameter)
    lasting = [replace(w, parameter=w.parameter - n) for w in writers]
    lasting = tuple(w for w in lasting if w.parameter >= 0)
    present = {field_of(w.quantity) for w in writers if w.kind == "effect"}
    model = Model(
        mjx=put,
        speed_limit=jnp.full(mj_model.nv, jnp.inf),
        writers=lasting,
        long_axes=tuple(long_axis(mj_model, g) for g in range(mj_model.ngeom)),
        effects=physical.none(mj_model) if present else None,
        present=tuple(sorted(present)) if present else None,
        pairs=tuple(pair_ids(mj_model)),
    )
    values = jnp.array(list(fixed.values()), jnp.result_type(float))
    return _written(model, values).replace(
        writers=tuple(w for w in writers if w.parameter < n)
    )


def _put_native(opened: mujoco.MjModel, writers: Iterable[Writer]) -> NativeModel:
    """The model for MuJoCo C, which must not take shortcuts that a parameter undoes."""
    # What diverges is told, not put back to its start.
    opened.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    bodies = sorted({w.body(opened) for w in writers if w.row.moves_center})
    if bodies:
        for b in bodies:
            if not _full_rows(opened, b):
                raise UserError(
                    f'the center of mass of body "{opened.body(b).name}" cannot vary '
                    "on the engine mujoco, which leaves out what is zero in its "
                    "inertia: use --engine mjx"
                )
        _without_shortcuts(opened)
    if any(w.quantity.startswith("softness") for w in writers):
        direct_contacts(opened)
    limits = any(e.field == "speed_limit" for w in writers for e in w.entries)
    return NativeModel(Template(opened, limits))


def _full_rows(m: mujoco.MjModel, body: int) -> bool:
    """Whether MuJoCo C keeps every entry of the inertia of a body's joints."""
    rows = slice(m.body_dofadr[body], m.body_dofadr[body] + m.body_dofnum[body])
    for i in range(*rows.indices(m.nv)):
        count, j = 0, i
        while j >= 0:
            count, j = count + 1, int(m.dof_parentid[j])
        if m.M_rownnz[i] < count:
            return False
    return True


def _without_shortcuts(m: mujoco.MjModel) -> None:
    """Centers of mass are read, not taken to be where the model file has them."""
    m.body_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    m.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    # Of a body that only slides (2) the center does not matter, and `mj_setConst` takes
    # the inverse of its mass for the weight of its contacts.
    m.body_simple[m.body_simple < 2] = 0
    m.dof_simplenum[:] = 0


def for_every_effect(m: Any) -> Any:
    """A model that was put without effects, ready for all of them."""
    if not isinstance(m, NativeModel):
        return full_structure(m)
    opened = copy.deepcopy(m.template.mj)
    _without_shortcuts(opened)
    direct_contacts(opened)
    return NativeModel(Template(opened, m.template.limits_speed), m.changed)


def full_structure(m: mjx.Model, bodies: Collection[int] | None = None) -> mjx.Model:
    """Lets every degree of freedom that moves one of some bodies, by default any,
    couple with all its ancestors.

    MuJoCo drops the off-diagonals of a body whose center of mass is at its joints;
    once the center moves they are no longer zero, but MJX keeps the mask.
    """
    rows, moved = [], set(range(m.nbody) if bodies is None else bodies)
    while (more := moved | {int(m.body_parentid[b]) for b in moved}) != moved:
        moved = more
    for i in range(m.nv):
        if m.dof_bodyid[i] not in moved:
            first = int(m.M_rowadr[i])
            rows.append(m.M_colind[first : first + m.M_rownnz[i]].tolist())
            continue
        chain = [i]
        while m.dof_parentid[chain[-1]] >= 0:
            chain.append(int(m.dof_parentid[chain[-1]]))
        rows.append(chain[::-1])
    count = np.array([len(r) for r in rows], m.M_rownnz.dtype)
    columns = np.array([j for r in rows for j in r], m.M_colind.dtype)
    start = (np.cumsum(count) - count).astype(m.M_rowadr.dtype)
    return m.replace(M_rownnz=count, M_rowadr=start, M_colind=columns, nC=len(columns))


def with_parameters(model: Model, theta: jax.Array) -> Model:
    """The model at parameters ``theta`` ``(n,)``, SI units, in `put_model`'s order.

    Pure; works under jit, vmap and forward derivatives. Leaves that no parameter
    touches are passed through, so that under vmap only the others get a batch axis.
    A body's inertia scales with its mass; derived constants are computed again where
    some address asks for it. The result does not depend on the order of writing.
    Static effects are in its ``mjx``; ``effects`` holds all, or None where no other
    is present.
    """
    model = _written(model, theta)
    e = model.effects
    if e is None:
        return model
    return model.replace(
        mjx=physical.with_effects(model.mjx, e, model.present),
        effects=e if physical.has_step_effects(model.present) else None,
    )


def _written(model: Model, theta: jax.Array) -> Model:
    if not model.writers:
        return model
    old = model.mjx
    m, speed, acting = old, model.speed_limit, model.effects
    numbers: dict[str, list[tuple[tuple[int, ...], int, int]]] = {}
    for w in model.writers:
        if w.quantity not in ("gravity", "length") or w.kind == "effect":
            for e in w.entries:
                numbers.setdefault(e.field, []).append((e.index, w.parameter, e.sign))
    for field, items in numbers.items():
        if field == "speed_limit":
            speed = _write(speed, items, theta)
        elif field.startswith("effects."):
            name = field.partition(".")[2]
            assert acting is not None
            value = _write(getattr(acting, name), items, theta)
            acting = acting.replace(**{name: value})
        else:
            m = m.tree_replace({field: _write(_leaf(m, field), items, theta)})
    m = _scale_inertia(model.writers, old, m)
    for w in model.writers:
        if w.quantity == "length":
            m = _write_length(m, w, model.long_axes[w.id], theta)
        elif w.quantity == "gravity":
            g = m.opt.gravity
            value = theta[w.parameter].astype(g.dtype)
            m = m.tree_replace({"opt.gravity": g / jnp.linalg.norm(g) * value})
    if any(w.row.derived for w in model.writers):
        m = set_const(m)
    return model.replace(mjx=m, speed_limit=speed, effects=acting)


def _leaf(m: mjx.Model, field: str) -> jax.Array:
    target: Any = m
    for part in field.split("."):
        target = getattr(target, part)
    return target


def _write(leaf: jax.Array, items: list[Any], theta: jax.Array) -> jax.Array:
    index = tuple(np.array(k) for k in zip(*(i for i, _, _ in items), strict=True))
    leaf = as_precise(leaf, theta)
    sign = np.array([s for _, _, s in items], leaf.dtype)
    values = theta[np.array([p for _, p, _ in items])].astype(leaf.dtype) * sign
    if not index:  # a scalar
        return values[0]
    return leaf.at[index].set(values)


def _put(leaf: jax.Array, index: Any, values: jax.Array) -> jax.Array:
    """``leaf`` with ``values``, as precise as either."""
    return as_precise(leaf, values).at[index].set(values)


def _scale_inertia(writers: Iterable[Writer], old: mjx.Model, m: Any) -> Any:
    heavy = {w.id for w in writers if (w.kind, w.quantity) == ("body", "mass")}
    bodies = np.array(sorted(heavy), int)
    if not bodies.size:
        return m
    ratio = m.body_mass[bodies] / old.body_mass[bodies]
    inertia = m.body_inertia[bodies] * ratio[:, None]
    return m.replace(body_inertia=_put(m.body_inertia, bodies, inertia))


def _write_length(m: Any, w: Writer, axis: int, theta: jax.Array) -> Any:
    """A uniform solid of another length and the same mass, from the body's frame."""
    g, b, kind = w.id, m.geom_bodyid[w.id], int(m.geom_type[w.id])
    size, pos = as_precise(m.geom_size[g], theta), m.geom_pos[g]
    length = theta[w.parameter].astype(size.dtype)
    old = length_of(kind, axis, size)
    # The stored half length; a capsule's does not include its ends.
    changed = size.at[w.entries[0].index[1]].add((length - old) / 2)
    along = _axis_of(m.geom_quat[g], axis)
    pos = pos + (length / old - 1) * jnp.dot(pos, along) * along
    inertia = m.body_mass[b] * unit_inertia(kind, changed, jnp)
    return m.replace(
        geom_size=_put(m.geom_size, g, changed),
        geom_pos=_put(m.geom_pos, g, pos),
        geom_rbound=_put(m.geom_rbound, g, _bound(kind, changed)),
        geom_aabb=_put(m.geom_aabb, (g, 3 + axis), length / 2),
        body_ipos=_put(m.body_ipos, b, pos),
        body_inertia=_put(m.body_inertia, b, inertia),
    )


def _axis_of(quat: jax.Array, axis: int) -> jax.Array:
    """Column ``axis`` of the rotation matrix of a unit quaternion ``(4,)``."""
    w, v = quat[0], quat[1:]
    e = jnp.zeros(3, quat.dtype).at[axis].set(1.0)
    return e + 2 * jnp.cross(v, jnp.cross(v, e) + w * e)


def _bound(kind: int, size: jax.Array) -> jax.Array:
    """Radius of the ball about the geom's center that holds it."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return jnp.linalg.norm(size)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return size[0] + size[1]
    return jnp.hypot(size[0], size[1])

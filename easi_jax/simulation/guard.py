"""The guard: one step of MJX beside MuJoCo C, on the user's own model.

A list of what MJX lacks never ends. A comparison of one step does not need one: the
step is computed by both, in double precision and with converged solvers, from states
that make the model's constraints act. Where the velocities differ, the terms of the
step (forces, activations, rows of constraints) are compared to say what differs.
"""

import copy
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco.mjx._src import support

from easi_jax.devices.mesh import own_device
from easi_jax.errors import UserError
from easi_jax.model.contact_pairs import Pair
from easi_jax.model.mjx_data import make_data
from easi_jax.model.mjx_model import put_model
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.simulation.step import WRITTEN_OUT, mjx_step

# Share of a step's velocity change. What MJX computes as MuJoCo does agrees to 1e-12,
# spheres, capsules and boxes that touch to 6e-4 (MJX rounds distances so that it does
# not divide by zero); the weakest fault seen is 2e-2 (benchmarks/parity.py).
TOLERANCE = 3e-3
_STATES = 16  # compared; more cost milliseconds each, and rarely find more
_LOOKED_AT = 512  # states among which those are chosen, at most
_SHARE = 0.05  # of the largest cause: what is smaller is not named
_ROUNDING = 1e-9  # of the velocities: forces that change them by less are not compared
_MODERATE = 1.0  # rad/s or m/s, a joint's speed
_ITERATIONS = 100  # of both solvers: far more than convergence takes
_REFUSED = (np.inf, np.inf)
_SIMULATED = 150  # physics steps at most before a random state
_FACES = ("actuator", "jnt", "dof", "tendon", "geom", "pair", "eq", "body")


@dataclass(frozen=True)
class Deviation:
    """How one step of MJX differs from MuJoCo C's.

    Attributes:
        error: largest difference of a velocity after the step, or of an activation, as
            a share of its largest change in that state, or in the median state if that
            is more; inf where MJX refuses.
        force_error: largest difference of a generalized force (inertial, passive, of
            actuators) as a share of the largest such force over the states: what is
            weak beside impacts is still to be right.
        causes: what deviates, the largest first; empty where nothing does.
        refusal: why MJX cannot take the model; empty where it can.
        states: how many states were compared.
        seconds: how long it took, compilation included.
    """

    error: float
    force_error: float = 0.0
    causes: tuple[str, ...] = ()
    refusal: str = ""
    states: int = 0
    seconds: float = 0.0

    @property
    def deviates(self) -> bool:
        return not max(self.error, self.force_error) <= TOLERANCE

    def __str__(self) -> str:
        if self.refusal:
            return f"MJX cannot simulate this model: {self.refusal}"
        what = ", ".join(self.causes) or "no single term of it"
        size = f"{100 * self.error:.2g} % of a step's acceleration"
        if not self.deviates:
            return f"MJX agrees with MuJoCo to {size}"
        if self.error <= TOLERANCE:
            size = f"{100 * self.force_error:.2g} % of a force"
        return f"MJX deviates from MuJoCo by {size}: {what}"


def compare(
    mj_model: mujoco.MjModel,
    qpos: np.ndarray,
    qvel: np.ndarray,
    act: np.ndarray | None = None,
    ctrl: np.ndarray | None = None,
    apart: Collection[Pair] = (),
) -> Deviation:
    """One physics step of this package's MJX beside `mj_step`, from the same states.

    Of many states those are taken that bring every kind of constraint and contact
    that occurs among them.

    Args:
        mj_model: the model; it is not changed.
        qpos: positions, ``(K, nq)`` [m, rad].
        qvel: velocities, ``(K, nv)`` [m/s, rad/s].
        act: activations, ``(K, na)``; zeros where None.
        ctrl: commands, ``(K, nu)``; zeros where None.
        apart: pairs of geoms that MJX leaves out.

    Returns:
        The comparison; whatever MJX raises is a refusal in it.
    """
    begin = time.monotonic()
    qpos, qvel = np.atleast_2d(qpos), np.atleast_2d(qvel)
    act = np.zeros((len(qpos), mj_model.na)) if act is None else act
    ctrl = np.zeros((len(qpos), mj_model.nu)) if ctrl is None else ctrl
    m = _converged(mj_model)
    states = _telling(m, list(zip(qpos, qvel, act, ctrl, strict=True)))

    def found(
        errors: tuple[float, float], causes: Iterable[str] = (), refusal: str = ""
    ) -> Deviation:
        seconds = time.monotonic() - begin
        return Deviation(*errors, tuple(causes), refusal, len(states), seconds)

    try:
        put, got = _mjx_outputs(m, states, apart)
    except Exception as error:  # MJX refuses in many ways, not all of them in words
        return found(_REFUSED, (), _reason(error))
    ours = [_mjx_step(m, put, g) for g in got]
    theirs = [_c_step(m, s) for s in states]
    errors = _errors(m, states, ours, theirs)
    if max(errors) <= TOLERANCE:
        return found(errors)
    with warnings_to():
        without = _without(m, states, ours, max(errors))
    causes = [without] if without else _causes(m, states, ours, theirs)
    return found(errors, causes)


def random_states(
    mj_model: mujoco.MjModel, seed: int = 0, k: int = 64
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States ``(K, nq)``, ``(K, nv)``, ``(K, na)`` and commands ``(K, nu)`` to compare.

    Joints lie in their ranges or about the reference, speeds are moderate, commands in
    their ranges. All but a quarter are simulated by MuJoCo C for up to 150 steps, so
    that bodies fall and touch; states that are no longer finite are left out.
    """
    rng = np.random.default_rng(seed)
    m = mj_model
    low, high = _ranges(m.actuator_ctrlrange, m.actuator_ctrllimited, 1.0)
    rows: list[tuple[np.ndarray, ...]] = []
    for i in range(4 * k):
        d = mujoco.MjData(m)
        if m.nkey and i % 2:
            mujoco.mj_resetDataKeyframe(m, d, int(rng.integers(m.nkey)))
        mujoco.mj_integratePos(m, d.qpos, _spread(m, rng), 1.0)
        for j in np.flatnonzero(m.jnt_limited & (m.jnt_type >= 2)):
            a, b = m.jnt_range[j]
            over = 0.05 * (b - a)
            d.qpos[m.jnt_qposadr[j]] = rng.uniform(a - over, b + over)
        d.qvel[:] = rng.normal(0.0, 1.0, m.nv)
        d.act[:] = rng.uniform(0.05, 0.95, m.na)
        ctrl = rng.uniform(low, high) if m.nu else np.zeros(0)
        d.ctrl[:] = ctrl
        with warnings_to():
            for _ in range(int(rng.integers(_SIMULATED)) if i % 4 else 0):
                mujoco.mj_step(m, d)
        row = (d.qpos.copy(), d.qvel.copy(), d.act.copy(), ctrl)
        lost = d.warning.number[mujoco.mjtWarning.mjWARN_BADQACC :].sum()
        if all(np.isfinite(x).all() for x in row) and not lost:
            rows.append(row)
        if len(rows) == k:
            break
    if not rows:
        raise UserError(
            "MuJoCo itself cannot simulate this model from any of "
            f"{4 * k} random states: check its masses, stiffnesses and timestep"
        )
    return tuple(np.array(x) for x in zip(*rows, strict=True))  # type: ignore[return-value]


def _ranges(limits: Any, limited: Any, free: float) -> tuple[np.ndarray, np.ndarray]:
    on = np.asarray(limited, bool)
    return np.where(on, limits[:, 0], -free), np.where(on, limits[:, 1], free)


def _spread(m: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """A tangent vector away from the reference, joint by joint."""
    out = rng.uniform(-0.5, 0.5, m.nv)
    for j in np.flatnonzero(m.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE):
        out[m.jnt_dofadr[j]] *= 0.2
    for j in np.flatnonzero(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        start = m.jnt_dofadr[j]
        out[start : start + 3] *= 0.2
    return out


State = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass
class _Rows:
    """Rows of constraints: what each belongs to, and MuJoCo's numbers of it."""

    what: list[str]
    jac: np.ndarray
    stiff: np.ndarray
    aref: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass
class _Step:
    """A step's results and the terms that they follow from."""

    qvel: np.ndarray
    qpos: np.ndarray
    act: np.ndarray
    qacc: np.ndarray
    mass: np.ndarray
    terms: dict[str, np.ndarray]
    actuator: np.ndarray
    rows: _Rows


def _converged(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    m = copy.copy(mj_model)
    m.opt.iterations = max(_ITERATIONS, m.opt.iterations)
    m.opt.ls_iterations = max(_ITERATIONS, m.opt.ls_iterations)
    m.opt.tolerance = 1e-14
    m.opt.ls_tolerance = 1e-6
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return m


def _telling(m: mujoco.MjModel, states: list[State]) -> list[State]:
    """Those that bring what occurs: for each kind of row the first few of its states,
    then others, evenly."""
    if len(states) > _LOOKED_AT:
        every = np.linspace(0, len(states) - 1, _LOOKED_AT).astype(int)
        states = [states[i] for i in every]
    kinds = []
    for state in states:
        d = _data(m, state)
        mujoco.mj_forward(m, d)
        kinds.append(set(_c_rows(m, d).what))
    chosen: list[int] = []
    while len(chosen) < min(_STATES, len(states)):
        seen: set[str] = set().union(*(kinds[i] for i in chosen))
        rest = [i for i in range(len(states)) if i not in chosen]
        best = max(rest, key=lambda i: len(kinds[i] - seen))
        if not kinds[best] - seen:
            left = min(_STATES, len(states)) - len(chosen)
            places = np.linspace(0, len(rest) - 1, left).astype(int)
            chosen += [rest[i] for i in places]
            break
        chosen.append(best)
    return [states[i] for i in chosen]


def _data(m: mujoco.MjModel, state: State) -> mujoco.MjData:
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.act[:], d.ctrl[:] = state
    return d


def _c_step(m: mujoco.MjModel, state: State) -> _Step:
    d = _data(m, state)
    mujoco.mj_step(m, d)
    mass = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, mass)
    forces = (d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator)
    terms = {n: f.copy() for n, f in zip(_TERMS, forces, strict=True)}
    passive = {n: getattr(d, f"qfrc_{n}").copy() for n in _PASSIVE}
    return _Step(
        *(d.qvel.copy(), d.qpos.copy(), d.act.copy(), d.qacc.copy(), mass),
        terms | passive,
        d.actuator_force.copy(),
        _c_rows(m, d),
    )


_PASSIVE = {
    "spring": "springs",
    "damper": "dampers",
    "gravcomp": "gravity compensation",
    "fluid": "fluid forces",
}


def _geoms(m: mujoco.MjModel, pair: Any) -> str:
    if min(pair) < 0:
        return "contacts of a flex"
    names = sorted(_word(mujoco.mjtGeom(m.geom_type[g]).name) for g in pair)
    return f"contacts of {names[0]} and {names[1]}"


def _word(enum_name: str) -> str:
    return enum_name.partition("_")[2].lower()


def _single(kind: int) -> str:
    return {
        mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF: "friction loss of joints",
        mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON: "friction loss of tendons",
        mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT: "joint limits",
        mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON: "tendon limits",
    }[mujoco.mjtConstraint(kind)]


def _equality(m: mujoco.MjModel, i: int) -> str:
    return f"{_word(mujoco.mjtEq(m.eq_type[i]).name)} constraints"


def _box(kinds: Any, loss: np.ndarray, both: np.ndarray) -> tuple[Any, Any]:
    """Bounds of the force of rows: two-sided, dry friction or one-sided."""
    kinds = np.asarray(kinds)
    dry = (kinds == 1) | (kinds == 2)
    low = np.where(dry, -loss, np.where(both, -np.inf, 0.0))
    return low, np.where(dry, loss, np.inf)


def _c_rows(m: mujoco.MjModel, d: mujoco.MjData) -> _Rows:
    kinds, what = d.efc_type, []
    both = kinds == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    for i, (kind, one) in enumerate(zip(kinds, d.efc_id, strict=True)):
        if kind == mujoco.mjtConstraint.mjCNSTR_EQUALITY:
            what.append(_equality(m, one))
        elif kind >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS):
            what.append(_geoms(m, d.contact.geom[one]))
            elliptic = kind == mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC
            both[i] = elliptic and i > d.contact.efc_address[one]
        else:
            what.append(_single(kind))
    jac = np.zeros((d.nefc, m.nv))
    if d.nefc:
        jac = d.efc_J.reshape(d.nefc, m.nv).copy()
    low, high = _box(kinds, d.efc_frictionloss, both)
    return _Rows(what, jac, d.efc_D.copy(), d.efc_aref.copy(), low, high)


_TERMS: tuple[str, ...] = (
    "inertial and Coriolis forces",
    "passive forces",
    "transmissions",
)


def _mjx_outputs(
    m: mujoco.MjModel, states: list[State], apart: Collection[Pair]
) -> tuple[Any, list[Any]]:
    """Data of the model, and what MJX's step of each state returns, as it lays it out.

    One simulation at a time, nothing optimized: most of the time goes into compiling.
    """
    with jax.enable_x64(True):
        device = _device()
        put = jax.device_put(put_model(m, sensors=False, apart=apart).mjx, device)
        blank = jax.device_put(make_data(put), device)

        def step(model: Any, start: Any, qpos: Any, qvel: Any, act: Any, ctrl: Any):
            d = start.replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl)
            d = mjx_step(model, d, m.nv > WRITTEN_OUT)
            i = d._impl
            rows = (i.efc_J, i.efc_D, i.efc_aref, i.efc_frictionloss)
            forces = (d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator)
            results = (d.qvel, d.qpos, d.act, d.qacc, support.full_m(model, d))
            return results, forces, d.actuator_force, rows, i.contact.geom

        on_cpu = device.platform == "cpu"
        level = {"xla_backend_optimization_level": 0} if on_cpu else {}
        run = jax.jit(step, compiler_options=level)
        out = []
        for state in states:
            arrays = [jax.device_put(np.asarray(x, float), device) for x in state]
            out.append(jax.tree.map(np.asarray, run(put, blank, *arrays)))
        return blank, out


def _device() -> Any:
    """A CPU where jax has one: double precision and compiling cost least there."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return own_device()


def _mjx_step(m: mujoco.MjModel, blank: Any, output: Any) -> _Step:
    results, forces, force, (jac, stiff, aref, loss), geoms = output
    kinds = np.asarray(blank._impl.efc_type)[: len(jac)]
    address = np.asarray(blank._impl.contact.efc_address)
    what, both = _mjx_labels(m, kinds, address, geoms[: len(address)])
    low, high = _box(kinds, loss, both)
    terms = dict(zip(_TERMS, forces, strict=True))
    rows = _Rows(what, jac, stiff, aref, low, high)
    return _Step(*results, terms=terms, actuator=force, rows=rows)


def _mjx_labels(
    m: mujoco.MjModel, kinds: np.ndarray, address: np.ndarray, geoms: np.ndarray
) -> tuple[list[str], np.ndarray]:
    what, both = [""] * len(kinds), kinds == 0
    types = mujoco.mjtEq
    sizes = ((types.mjEQ_CONNECT, 3), (types.mjEQ_WELD, 6))
    sizes += ((types.mjEQ_JOINT, 1), (types.mjEQ_TENDON, 1))
    at = 0
    for kind, size in sizes:
        for i in np.flatnonzero(m.eq_type == kind):
            if at < both.sum():
                what[at : at + size] = [_equality(m, int(i))] * size
                at += size
    firsts = sorted(zip(address.tolist(), geoms.tolist(), strict=True))
    ends = [a for a, _ in firsts[1:]] + [len(kinds)] * bool(firsts)
    for (first, pair), end in zip(firsts, ends, strict=True):
        if first < 0:
            continue
        for r in range(first, min(end, len(kinds))):
            what[r] = _geoms(m, pair)
            elliptic = kinds[r] == mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC
            both[r] = elliptic and r > first
    return [w or _single(k) for w, k in zip(what, kinds, strict=True)], both


def _scale(starts: Any, ends: Any) -> np.ndarray:
    """By state, the largest change in the step, ``(S, 1)``; at least the median state's
    (a state in balance hardly changes), so that a crash does not hide what is wrong in
    free motion."""
    change = np.abs(np.array(ends) - np.array(starts)).max(1, keepdims=True)
    change = np.maximum(change, np.median(change))
    return np.where(change > 0, change, 1.0)


def _errors(
    m: mujoco.MjModel, states: list[State], ours: list[_Step], theirs: list[_Step]
) -> tuple[float, float]:
    """`Deviation.error` and `Deviation.force_error`."""
    error = force = 0.0
    for name, at in (("qvel", 1), ("act", 2)):
        mine, other = (np.array([getattr(s, name) for s in x]) for x in (ours, theirs))
        if not mine.size:
            continue
        if not np.isfinite(mine).all():
            return _REFUSED
        scale = _scale([s[at] for s in states], other)
        error = max(error, float((np.abs(mine - other) / scale).max()))
    inertia = max(float(np.diag(s.mass).max(initial=0.0)) for s in theirs)
    floor = _ROUNDING * inertia / m.opt.timestep * _MODERATE
    for name in _TERMS:
        mine, other = (np.array([s.terms[name] for s in x]) for x in (ours, theirs))
        largest = max(float(np.abs(other).max(initial=0.0)), floor)
        if largest:
            force = max(force, float(np.abs(mine - other).max() / largest))
    return error, force


def _without(
    m: mujoco.MjModel, states: list[State], ours: list[_Step], error: float
) -> str:
    """The one thing without which MuJoCo C does what MJX does: what MJX ignores."""
    for name, change in _removals(m):
        other = copy.copy(m)
        change(other)
        try:
            theirs = [_c_step(other, s) for s in states]
        except mujoco.FatalError:  # such a model is not to be stepped
            continue
        if max(_errors(m, states, ours, theirs)) <= min(TOLERANCE, _SHARE * error):
            return f"{name}, which MJX ignores"
    return ""


def _removals(
    m: mujoco.MjModel,
) -> Iterator[tuple[str, Callable[[mujoco.MjModel], None]]]:
    """Everything that is set in a model and can be taken out: numbers, switches."""
    for name in sorted(dir(m)):
        face, _, rest = name.partition("_")
        value = getattr(m, name) if face in _FACES and rest else None
        if not isinstance(value, np.ndarray) or not np.any(value):
            continue
        if value.dtype.kind == "f" or value.dtype == np.bool_ or _is_switch(value):
            word = f"{'joint' if face == 'jnt' else face} {rest.replace('_', ' ')}"
            yield word, lambda o, n=name: getattr(o, n).fill(0)
    for flags, kind in (
        ("disableflags", mujoco.mjtDisableBit),
        ("enableflags", mujoco.mjtEnableBit),
    ):
        for bit in kind.__members__.values():
            if int(bit) & int(getattr(m.opt, flags)):
                word = f"{flags.removesuffix('flags')} flag {_word(bit.name)}"

                def off(o: Any, n: str = flags, b: int = int(bit)) -> None:
                    setattr(o.opt, n, getattr(o.opt, n) & ~b)

                yield word, off
    for name in ("disableactuator", "noslip_iterations", "density", "viscosity"):
        if getattr(m.opt, name):
            yield name, lambda o, n=name: setattr(o.opt, n, 0)


def _is_switch(value: np.ndarray) -> bool:
    return value.dtype == np.uint8


def _causes(
    m: mujoco.MjModel, states: list[State], ours: list[_Step], theirs: list[_Step]
) -> list[str]:
    """Terms of the step that differ, by what they do to the velocity, largest first."""
    size: dict[str, float] = {}

    def note(what: str, value: float) -> None:
        size[what] = max(size.get(what, 0.0), value)

    scales = _scale([s[1] for s in states], [b.qvel for b in theirs])
    h = m.opt.timestep
    for mine, other, (change,) in zip(ours, theirs, scales, strict=True):
        inverse = np.linalg.pinv(other.mass)  # two joints may be as one

        def effect(
            force: np.ndarray, to_change: np.ndarray = h * inverse / change
        ) -> float:
            return float(np.abs(to_change @ force).max(initial=0.0))

        note("inertia", effect((mine.mass - other.mass) @ other.qacc))
        for name in mine.terms:
            off = mine.terms[name] - other.terms[name]
            if name == "passive forces" and effect(off) > TOLERANCE:
                name = _passive(other, effect)
            if name == "transmissions":
                wrong = np.abs(mine.actuator - other.actuator) > 1e-9 * np.abs(
                    other.actuator
                ).max(initial=1.0)
                if wrong.any():
                    name = _actuators(m, wrong)
                elif effect(off) > TOLERANCE:
                    used = sorted({int(t) for t in m.actuator_trntype})
                    words = [_word(mujoco.mjtTrn(t).name) for t in used]
                    name = f"transmission of actuators ({', '.join(words)})"
            note(name, effect(off))
        for what in {*mine.rows.what, *other.rows.what}:
            a, b = (_force(s.rows, what, other.qacc) for s in (mine, other))
            note(what, effect(a - b))
        wrong = np.abs(mine.act - other.act) > 1e-9
        if wrong.any():
            owners = [
                i
                for i in range(m.nu)
                if wrong[m.actuator_actadr[i] :][: max(m.actuator_actnum[i], 0)].any()
                and m.actuator_actadr[i] >= 0
            ]
            mask = np.isin(np.arange(m.nu), owners)
            note(f"activation of {_actuators(m, mask)}", float(np.abs(wrong).max()))
    largest = max(size.values(), default=0.0)
    if largest <= _ROUNDING:
        return [_rest(m, ours, theirs)]
    named = [w for w, v in size.items() if v > _SHARE * largest]
    return sorted(named, key=lambda w: -size[w])


def _force(rows: _Rows, what: str, qacc: np.ndarray) -> np.ndarray:
    """Generalized force of rows of a kind at an acceleration that is the same for both
    engines, so that one wrong row does not make others look wrong."""
    own = np.array([w == what for w in rows.what], bool)
    jac = rows.jac[own]
    pull = -rows.stiff[own] * (jac @ qacc - rows.aref[own])
    return jac.T @ np.clip(pull, rows.low[own], rows.high[own])


def _passive(other: _Step, effect: Callable[[np.ndarray], float]) -> str:
    parts = [w for n, w in _PASSIVE.items() if effect(other.terms[n]) > TOLERANCE]
    return "passive forces" + (f" ({', '.join(parts)})" if parts else "")


def _actuators(m: mujoco.MjModel, mask: np.ndarray) -> str:
    kinds = set()
    for i in np.flatnonzero(mask):
        if m.actuator_plugin[i] >= 0:
            kinds.add("plugin")
            continue
        words = (
            _word(mujoco.mjtDyn(m.actuator_dyntype[i]).name),
            _word(mujoco.mjtGain(m.actuator_gaintype[i]).name),
            _word(mujoco.mjtBias(m.actuator_biastype[i]).name),
        )
        kinds.add("/".join(words))
    return f"actuators of type {', '.join(sorted(kinds))} (dynamics/gain/bias)"


def _rest(m: mujoco.MjModel, ours: list[_Step], theirs: list[_Step]) -> str:
    """What is left where all terms agree: the solver, or the integrator."""
    off = np.abs([a.qacc - b.qacc for a, b in zip(ours, theirs, strict=True)]).max()
    scale = np.abs([b.qacc for b in theirs]).max() or 1.0
    if off / scale > TOLERANCE:
        return "the constraint solver"
    kind = _word(mujoco.mjtIntegrator(m.opt.integrator).name)
    types = _actuators(m, np.ones(m.nu, bool)) if m.nu else ""
    return f"the integrator {kind}" + (f" with {types}" if types else "")


def _reason(error: Exception) -> str:
    told = error.__cause__ or error
    words = " ".join(str(told).split())
    if isinstance(told, (UserError, NotImplementedError)) and words:
        return words
    return f"{type(told).__name__}: {words}" if words else type(told).__name__

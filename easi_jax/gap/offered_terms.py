"""Terms of laws that are offered where no effect closes the gap.

What the catalog has (dry and viscous friction, quadratic drag, springs, constant
torques, ripple) is not among them: it is offered by its own name. A term acts along a
joint, or along the sum or difference of two, as whatever depends on that alone does.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.model.effect_catalog import Scales
from easi_jax.model.joint_space import driven_joint, is_hinge, scalar_dofs
from easi_jax.model.law_terms import Term, name_of

_WIDTH = 0.005  # of the speeds, over which a sign turns
_BENDS = 0.003, 0.01, 0.03, 0.1  # of the range, that bristles bend by
_LAGS = 0.05, 0.2, 1.0  # s
_WARMS = 3.0, 10.0, 30.0  # s
_PAIRED = 6  # joints, of which all pairs are tried; of more those next to each other
# How many more parts than a number times one power: what says as much with fewer comes
# first.
_PLAIN, _TWO, _THREE = 1, 2, 3


@dataclass(frozen=True)
class Offered:
    """A term, and what it would push.

    Attributes:
        acts: joints with the share of each.
        term: of which the force is a multiple.
        parts: how much it takes to say it.
    """

    acts: tuple[tuple[str, float], ...]
    term: Term
    parts: int


def offered(m: mujoco.MjModel, scales: Scales) -> list[Offered]:
    """All of them, each once."""
    joints = {m.joint(j).name: j for j in scalar_dofs(m) if m.joint(j).name}
    found = [t for name in joints for t in _along(m, scales, name)]
    for a in range(m.nu):
        found += _of_drive(m, scales, a)
    kind = {name: is_hinge(m, j) for name, j in joints.items()}
    driven = [(_driven(m, a), a) for a in range(m.nu)]
    for pair in itertools.combinations(joints, 2):
        one, other = (kind[name] for name in pair)
        near = _adjoin(m, *(joints[name] for name in pair))
        alike = one == other and (near or [*kind.values()].count(one) <= _PAIRED)
        for share in (1.0, -1.0) if alike else ():
            found += _along_both(m, scales, pair, share)
        if not (near or len(joints) <= _PAIRED):
            continue
        for at, other in (pair, pair[::-1]):
            found += _of_other(m, scales, at, other)
            for a in (a for name, a in driven if name == other):
                found += _of_others_drive(m, scales, at, a)
    return found


def _adjoin(m: mujoco.MjModel, one: int, other: int) -> bool:
    """Whether one of two joints moves the other, with none between them; or both move
    one body."""

    def moved_by(body: int) -> int:
        """The next body from it on towards the world that a joint moves."""
        while body and not m.body_jntnum[body]:
            body = int(m.body_parentid[body])
        return body

    a, b = (int(m.jnt_bodyid[j]) for j in (one, other))
    above = [moved_by(int(m.body_parentid[body])) for body in (a, b)]
    return a == b or above[0] == b or above[1] == a


def _driven(m: mujoco.MjModel, a: int) -> str:
    """The joint that an actuator moves; nothing where one of the two has no name, or it
    moves something else."""
    j = driven_joint(m, a)
    if j is None or j not in scalar_dofs(m) or not m.actuator(a).name:
        return ""
    return m.joint(j).name


def _dof(m: mujoco.MjModel, name: str) -> int:
    return int(m.jnt_dofadr[m.joint(name).id])


def _along(m: mujoco.MjModel, s: Scales, name: str) -> Iterator[Offered]:
    d = _dof(m, name)
    q, v = name_of("qpos", name), name_of("qvel", name)
    sign = f"sign({v}, {_WIDTH * s.speed[d]:.3g})"
    acts = ((name, 1.0),)

    def term(text: str, parts: int) -> Offered:
        return Offered(acts, Term(text), parts)

    yield term(f"abs({v})", _PLAIN)
    yield term(f"{v}**3", _TWO)
    yield term(f"{v}**2", _TWO)
    for k in (2, 3):
        yield term(f"{q}**{k}", _PLAIN)
    yield term(f"abs({q})", _PLAIN)
    yield term(f"{q}*abs({q})", _TWO)
    for friction in (sign, v):
        for text in (q, f"{q}**2", f"abs({q})"):
            yield term(f"{friction}*{text}", _TWO)
        if is_hinge(m, m.joint(name).id):
            for k in ("", "2*"):
                yield term(f"{friction}*sin({k}{q})", _TWO)
                yield term(f"{friction}*cos({k}{q})", _TWO)
        yield term(f"{friction}*time", _TWO)
        for seconds in _WARMS:
            yield term(f"{friction}*lag(abs({v}), {seconds:g})", _THREE)
    yield term("time", _PLAIN)
    for share in _BENDS:
        yield term(f"dahl({v}, {share * max(s.span[d], 1e-6):.3g})", _TWO)
    for seconds in _LAGS:
        yield term(f"lag({v}, {seconds:g})", _TWO)
        yield term(f"lag({q}, {seconds:g})", _TWO)


def _of_drive(m: mujoco.MjModel, s: Scales, a: int) -> Iterator[Offered]:
    """Of a command, at the joint that it moves."""
    name = _driven(m, a)
    if not name:
        return
    u = name_of("ctrl", m.actuator(a).name)
    q, v = name_of("qpos", name), name_of("qvel", name)
    for text, parts in (
        *((f"{u}*abs({u})", _PLAIN), (f"{u}**2", _PLAIN), (f"{u}**3", _PLAIN)),
        *((f"abs({u})", _PLAIN), (f"sign({u}, {_WIDTH * s.command[a]:.3g})", _PLAIN)),
        *((f"{u}*{q}", _TWO), (f"{u}*{v}", _TWO), (f"{u}*abs({v})", _TWO)),
        (f"{u}*time", _TWO),
        *((f"{u}*lag(abs({u}), {seconds:g})", _THREE) for seconds in _WARMS),
    ):
        yield Offered(((name, 1.0),), Term(text), parts)


def _along_both(
    m: mujoco.MjModel, s: Scales, pair: tuple[str, str], share: float
) -> Iterator[Offered]:
    """Along the sum or the difference of two joints."""
    a, b = pair
    op = "+" if share > 0 else "-"
    q, v = (
        f"({name_of(kind, a)} {op} {name_of(kind, b)})" for kind in ("qpos", "qvel")
    )
    speed = float(np.hypot(s.speed[_dof(m, a)], s.speed[_dof(m, b)]))
    span = float(max(s.span[_dof(m, a)], s.span[_dof(m, b)], 1e-6))
    for text, parts in (
        *((q, _PLAIN), (v, _PLAIN), (f"sign({v}, {_WIDTH * speed:.3g})", _PLAIN)),
        *((f"{v}*abs({v})", _TWO), (f"{q}**2", _TWO), (f"{q}**3", _TWO)),
        *((f"dahl({v}, {share * span:.3g})", _THREE) for share in _BENDS),
    ):
        yield Offered(((a, 1.0), (b, share)), Term(text), parts)


def _of_other(m: mujoco.MjModel, s: Scales, at: str, other: str) -> Iterator[Offered]:
    """At one joint, of what another does."""
    q, v = name_of("qpos", other), name_of("qvel", other)
    mine = name_of("qpos", at)
    sign = f"sign({v}, {_WIDTH * s.speed[_dof(m, other)]:.3g})"
    own = f"sign({name_of('qvel', at)}, {_WIDTH * s.speed[_dof(m, at)]:.3g})"
    for text, parts in (
        *((q, _PLAIN), (v, _PLAIN), (sign, _PLAIN), (f"{v}*abs({v})", _TWO)),
        *((f"{q}**2", _PLAIN), (f"{q}*{mine}", _TWO), (f"{own}*{q}", _TWO)),
        *((f"{own}*abs({q})", _TWO), (f"{name_of('qvel', at)}*{v}", _TWO)),
    ):
        yield Offered(((at, 1.0),), Term(text), parts)


def _of_others_drive(
    m: mujoco.MjModel, s: Scales, at: str, a: int
) -> Iterator[Offered]:
    """At one joint, of the command of another."""
    u = name_of("ctrl", m.actuator(a).name)
    for text, parts in (
        *((u, _PLAIN), (f"{u}*abs({u})", _TWO), (f"abs({u})", _TWO)),
        (f"sign({u}, {_WIDTH * s.command[a]:.3g})", _TWO),
    ):
        yield Offered(((at, 1.0),), Term(text), parts)

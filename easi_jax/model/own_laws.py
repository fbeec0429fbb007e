"""What an owner's effects do to a simulation: their functions, at all their places.

An owner (`easi_jax.model.own_effects`) writes pure functions of the state, the commands
and the time. Here they become torques, commands and readings of a physics step. Their
numbers are a field of `easi_jax.model.effects.Effects`: a row for each number, a column
for each joint or actuator.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import mujoco

from easi_jax.model.joint_space import is_scalar
from easi_jax.model.law_terms import Known, Memory

D = TypeVar("D")


class Now(NamedTuple):
    """What a law may depend on.

    Attributes:
        position: of each hinge [rad] and slide [m], by the joint's name.
        speed: of each [rad/s, m/s].
        command: that reaches each actuator, by its name.
        time: since the start of the recording or of the episode [s].
        here: the joint or actuator that the effect sits at; "" for the whole model.
        memory: states of what the law remembers.
    """

    position: Mapping[str, Any]
    speed: Mapping[str, Any]
    command: Mapping[str, Any]
    time: Any
    here: str
    memory: tuple[Any, ...] = ()


# Of now and of the effect's numbers (by name, as attributes): a number for ``here``, or
# numbers by the names of joints (forces, readings) or actuators (commands).
Function = Callable[[Now, Any], Any]


@dataclass(frozen=True)
class Law:
    """The functions of one effect in one model; static and hashable.

    Attributes:
        name: of the effect.
        numbers: names of its numbers.
        row: of the first of them.
        sites: where it may be: the name, and the column of its numbers.
        joints: name, place in ``qpos`` and degree of freedom of each hinge and slide.
        actuators: names.
        force, command, reading: what it does; None: nothing to it.
        memories: what it remembers; one state for each.
        state: the first of those among the states of all laws.
    """

    name: str
    numbers: tuple[str, ...]
    row: int
    sites: tuple[tuple[str, int], ...]
    joints: tuple[tuple[str, int, int], ...]
    actuators: tuple[str, ...]
    force: Function | None = None
    command: Function | None = None
    reading: Function | None = None
    memories: tuple[Memory, ...] = ()
    state: int = 0

    def known(self, q: Any, v: Any, u: Any, time: Any) -> Known:
        """What its terms are evaluated on."""
        return Known(
            {name: q[at] for name, at, _ in self.joints},
            {name: v[dof] for name, _, dof in self.joints},
            dict(zip(self.actuators, u, strict=True)),
            time,
        )

    def outputs(
        self,
        function: Function,
        known: Any,
        q: Any,
        v: Any,
        u: Any,
        time: Any,
        memory: Any = (),
    ) -> list[dict[str, Any]]:
        """What a function gives at each place, by the names of joints or actuators.

        Args:
            known: numbers of all effects, ``(K, P)``.
            q, v, u: positions ``(nq,)``, velocities ``(nv,)``, commands ``(nu,)``.
            memory: states of all laws, ``(S,)``.

        Raises:
            TypeError: neither a number nor a mapping.
        """
        at = self.known(q, v, u, time)
        states = tuple(memory[self.state + k] for k in range(len(self.memories)))
        out = []
        for here, column in self.sites:
            values = {
                n: known[self.row + k, column] for k, n in enumerate(self.numbers)
            }
            now = Now(at.qpos, at.qvel, at.ctrl, time, here, states)
            got = function(now, SimpleNamespace(**values))
            if isinstance(got, Mapping):
                out.append(dict(got))
            elif here:
                out.append({here: got})
            else:
                raise TypeError(
                    "an effect of the whole model returns numbers by names, such as "
                    '{"elbow": 0.1}'
                )
        return out

    @property
    def dofs(self) -> dict[str, int]:
        """Degrees of freedom of joints, by name."""
        return {name: dof for name, _, dof in self.joints}


def joints_of(m: mujoco.MjModel) -> tuple[tuple[str, int, int], ...]:
    """`Law.joints` of a model: hinges and slides that have a name."""
    return tuple(
        (m.joint(j).name, int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j]))
        for j in range(m.njnt)
        if is_scalar(m, j) and m.joint(j).name
    )


def actuators_of(m: mujoco.MjModel) -> tuple[str, ...]:
    """Names of actuators; a number where there is none."""
    return tuple(m.actuator(a).name or f"actuator{a}" for a in range(m.nu))


def names_alone(m: mujoco.MjModel) -> Law:
    """A law of no effect, which knows the names of a model."""
    return Law("", (), 0, (), joints_of(m), actuators_of(m))


def first_states(laws: tuple[Law, ...], q: Any, v: Any, u: Any, time: Any) -> Any:
    """What laws remember where nothing is known of what came before, ``(S,)``: lags
    have settled, bristles are straight."""
    out = [
        memory.follows(law.known(q, v, u, time))[0] if memory.kind == "lag" else 0.0
        for law in laws
        for memory in law.memories
    ]
    return jnp.array(out, v.dtype)


def next_states(
    laws: tuple[Law, ...], states: Any, q: Any, v: Any, u: Any, time: Any, h: Any
) -> Any:
    """What laws remember a time ``h`` [s] later, while everything else is as now."""
    out = []
    for law in laws:
        known = law.known(q, v, u, time)
        for k, memory in enumerate(law.memories, law.state):
            target, rate = memory.follows(known)
            out.append(target + (states[k] - target) * jnp.exp(-rate * h))
    return jnp.stack(out) if out else states


def acting(d: D, known: Any, laws: tuple[Law, ...], states: Any = ()) -> D:
    """Data of a physics step (`mjx.Data`, before `forward`) with what laws do to its
    commands and to the torques at its joints; ``states``: what they remember."""
    data: Any = d
    q, v, time = data.qpos, data.qvel, data.time
    for law in laws:
        if law.command is None:
            continue
        u = data.ctrl
        where = {name: a for a, name in enumerate(law.actuators)}
        for got in law.outputs(law.command, known, q, v, u, time):
            for name, x in got.items():
                u = u.at[where[name]].add(x - data.ctrl[where[name]])
        data = data.replace(ctrl=u)
    torque = data.qfrc_applied
    for law in laws:
        if law.force is None:
            continue
        for got in law.outputs(law.force, known, q, v, data.ctrl, time, states):
            for name, x in got.items():
                torque = torque.at[law.dofs[name]].add(x)
    return data.replace(qfrc_applied=torque)


def reading_offsets(
    known: Any, laws: tuple[Law, ...], q: Any, v: Any, u: Any, time: Any
) -> Any:
    """Readings of positions less the positions ``q (nq,)``, ``(nv,)``."""
    offset = jnp.zeros_like(v)
    for law in laws:
        if law.reading is None:
            continue
        position = {name: q[at] for name, at, _ in law.joints}
        for got in law.outputs(law.reading, known, q, v, u, time):
            for name, x in got.items():
                offset = offset.at[law.dofs[name]].add(x - position[name])
    return offset


def widest(m: mujoco.MjModel) -> int:
    """Columns of the numbers of laws."""
    return max(m.nv, m.nu, 1)

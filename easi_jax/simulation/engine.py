"""Which program simulates: MJX, compiled, or native MuJoCo on all cores.

A command chooses once, by `using`; simulators that are made inside, without an engine
of their own, take that choice. ``auto`` decides from the model and the devices, never
by timing, so that a run that is resumed decides alike.
"""

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

from easi_jax.devices.runtime import on_cpu
from easi_jax.errors import UserError, engine_calls, nearest
from easi_jax.model.contact_pairs import Pair
from easi_jax.simulation.compile_time import expected_of, size_of
from easi_jax.simulation.guard import Deviation, compare, random_states
from easi_jax.simulation.logged import Logged

Engine = Literal["mjx", "mujoco"]
CHOICES = ("auto", "mjx", "mujoco")

# Seconds of one core that MJX may take to compile on a CPU, as told beforehand. What is
# told to compile in less runs 3.8 to 107 times as fast on MJX, what in more 0.08 to 1.1
# times (benchmarks/results/compile_times.json), for code gets too long to be written
# out. benchmarks/engines.py, 300 models on 2 cores: Cartpole is 149 times as fast on
# MJX; Ant has its first result after 45 s on MJX and 0.6 s, and 0.8 times the steps a
# second on MJX; Ballbalance 56 and 0.6 s, 0.5 times; Go2 59 and 0.6 s, 0.6 times. Only
# with a policy is Ant quicker on MJX, 1.3 times once it is compiled.
LONGEST = 11.0


@dataclass
class _Choice:
    """What simulators take that are made without an engine.

    Attributes:
        name: one of `CHOICES`.
        tell: called with why ``auto`` took what it took.
        taken: engines that ``auto`` took, with the reasons.
        write: see `recorded`.
    """

    name: str = "mjx"
    tell: Callable[[str], None] | None = None
    taken: dict[str, str] = field(default_factory=dict)
    write: Callable[[str, str], None] | None = None

    def told(self) -> None:
        """Writes what there is to write."""
        if self.write is None:
            return
        if self.name != "auto":
            self.write(self.name, f"--engine {self.name}")
        elif len(self.taken) == 1:
            self.write(*next(iter(self.taken.items())))
        elif self.taken:
            both = "; ".join(f"{name}: {why}" for name, why in self.taken.items())
            self.write("auto", both)


_stack = [_Choice()]


@contextlib.contextmanager
def using(name: str, tell: Callable[[str], None] | None = None) -> Iterator[None]:
    """Simulators made inside are of an engine.

    Args:
        name: one of `CHOICES`.
        tell: called once with each choice of ``auto`` other than MJX, and why.

    Raises:
        UserError: not one of `CHOICES`.
        EngineError: a call of native MuJoCo inside raised something.
    """
    if name not in CHOICES:
        raise UserError(
            f'engine "{name}": give one of {", ".join(CHOICES)}{nearest(name, CHOICES)}'
        )
    _stack.append(_Choice(name, tell))
    engine_calls.watched = True
    try:
        yield
    except Exception:  # may well come from the numbers that are missing
        engine_calls.check()
        raise
    else:
        engine_calls.check()
    finally:
        _stack.pop()
        if len(_stack) == 1:
            engine_calls.failures.clear()
            engine_calls.watched = False


@contextlib.contextmanager
def chosen(name: str, tell: Callable[[str], None] | None = None) -> Iterator[list[str]]:
    """`using` for a function that anybody may call: ``auto`` is the engine in use where
    there is one.

    Yields:
        What ``tell`` is told, as it comes.
    """
    said: list[str] = []

    def hear(line: str) -> None:
        said.append(line)
        if tell is not None:
            tell(line)

    if name == "auto" and len(_stack) > 1:
        yield said
        return
    with using(name, hear):
        yield said


def recorded(write: Callable[[str, str], None]) -> None:
    """Inside `using`, ``write(engine, why)`` is called with what is given or ``auto``
    takes, now or as soon as it does; with ``auto`` where it takes both."""
    if len(_stack) > 1:
        _stack[-1].write = write
        _stack[-1].told()


def of_built_in(m: mujoco.MjModel) -> Engine:
    """The engine for a model of the package, which tests compare with MuJoCo C."""
    name = _stack[-1].name
    return _noted(*by_size(m)) if name == "auto" else name  # type: ignore[return-value]


def resolved(
    engine: str | None,
    m: mujoco.MjModel,
    logged: Logged | None = None,
    apart: Callable[[], frozenset[Pair]] = frozenset,
) -> Engine:
    """The engine for a model: the given one, else the one in use.

    Args:
        engine: ``mjx``, ``mujoco`` or ``auto``; None: the one in use.
        m: the model.
        logged: states near which it is simulated; None: it may get anywhere.
        apart: pairs of geoms that MJX would leave out.

    Raises:
        UserError: MJX was asked for, and deviates from MuJoCo C.
    """
    choice = _stack[-1]
    name = engine or choice.name
    if name == "mjx" and choice is not _stack[0] and engine is None:
        wrong = checked(m, logged, apart)
        if wrong.deviates:
            raise UserError(f"{wrong}: use --engine mujoco or --engine auto")
    if name == "mjx" or name == "mujoco":
        return name
    return _noted(*automatic(m, logged, apart))


def _noted(found: Engine, why: str) -> Engine:
    choice = _stack[-1]
    if choice.tell is not None and found == "mujoco" and found not in choice.taken:
        choice.tell(f"engine: mujoco, native on all cores ({why})")
    if found not in choice.taken:
        choice.taken[found] = why
        choice.told()
    return found


def automatic(
    m: mujoco.MjModel,
    logged: Logged | None = None,
    apart: Callable[[], frozenset[Pair]] = frozenset,
) -> tuple[Engine, str]:
    """The engine that ``auto`` takes for a model, and why; see `resolved`."""
    name, why = by_size(m)
    if name == "mujoco":
        return name, why
    found = checked(m, logged, apart)
    return ("mujoco", str(found)) if found.deviates else (name, why)


def by_size(m: mujoco.MjModel) -> tuple[Engine, str]:
    """The engine that is the quicker one, whether MJX is right or not."""
    if not on_cpu():
        return "mjx", "there is an accelerator"
    size = size_of(m)
    seconds = expected_of(size)
    if seconds <= LONGEST:
        return "mjx", "a small robot"
    contacts = size.on_planes + size.others
    return "mujoco", (
        f"{size.joints} degrees of freedom and {contacts} contacts on a CPU, which MJX "
        f"compiles for about {seconds:.0f} s"
    )


_checks: dict[bytes, Deviation] = {}  # by what is compared


def checked(
    m: mujoco.MjModel,
    logged: Logged | None = None,
    apart: Callable[[], frozenset[Pair]] = frozenset,
) -> Deviation:
    """MJX beside MuJoCo C at states of a log, or at random ones; once a process."""
    content = np.empty(mujoco.mj_sizeModel(m), np.uint8)
    mujoco.mj_saveModel(m, None, content)
    left_out = apart() if logged else frozenset()
    digest = hashlib.sha256(content.tobytes())
    digest.update(repr(sorted(left_out)).encode())
    states = logged.states(m) if logged else None
    for x in states or ():
        digest.update(np.ascontiguousarray(x).tobytes())
    key = digest.digest()
    if key not in _checks:
        _checks[key] = compare(m, *(states or random_states(m)), apart=left_out)
    return _checks[key]

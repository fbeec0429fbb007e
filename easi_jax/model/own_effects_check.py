"""Whether an owner's effects can be believed, in one model, before anything uses them.

Each function is called twice at a state of the model, and as a compiled program, with
equal results: what draws random numbers, or remembers, is no pure function. At the
neutral numbers it changes nothing; at others it gives finite numbers for joints or
actuators that the model has; and it does not take longer than what it is added to.
"""

import contextvars
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.errors import UserError, nearest, source_of, told_by_line
from easi_jax.model import effects
from easi_jax.model.effect_numbers import NUMBERS
from easi_jax.model.effects import Effects
from easi_jax.model.found_laws import law_of
from easi_jax.model.own_laws import Law

_MOST_SECONDS = 1.0  # of one call as Python, or of all calls compiled
_PATIENCE = 60.0  # s, with a first call, which compiles
_STATES = 256  # in the compiled call
_NEAR = 1e-4  # of the largest: rounding of single precision, compiled or not
_SIZES = 0.3, 0.7  # of the range of each number, where a law is tried


def check_own_effects(m: mujoco.MjModel, names: Sequence[str] | None = None) -> None:
    """Refuses effects of the owner's that are registered, or those of some ``names``.

    Laws that were found in data may be of another machine; `check_law` checks them.

    Raises:
        UserError: what is wrong with one of them, where in its file, what to do.
    """
    e = effects.none(m)
    for law in e.laws:
        if law_of(law.name) is None if names is None else law.name in names:
            _check(m, e, law)


def _check(m: mujoco.MjModel, e: Effects, law: Law) -> None:
    if not law.sites:
        raise UserError(
            f"effect {law.name!r}: the model has no joint or actuator that its at= "
            "names"
        )
    for what in ("force", "command", "reading"):
        function = getattr(law, what)
        if function is not None:
            _Checked(m, e, law, what, function).check()


class _Checked:
    """One function of an effect."""

    def __init__(
        self, m: mujoco.MjModel, e: Effects, law: Law, what: str, function: Any
    ) -> None:
        self.law, self.what, self.function = law, what, function
        self.neutral = np.asarray(e.own)
        rng = np.random.default_rng(0)
        d = mujoco.MjData(m)
        q = np.tile(d.qpos, (_STATES, 1)) + 0.3 * rng.normal(size=(_STATES, m.nq))
        v = rng.normal(size=(_STATES, m.nv))
        low, high = m.actuator_ctrlrange.T
        span = np.where(m.actuator_ctrllimited, high - low, 2.0)
        middle = np.where(m.actuator_ctrllimited, (high + low) / 2, 0.0)
        u = middle + span * rng.uniform(-0.5, 0.5, (_STATES, m.nu))
        seconds = rng.uniform(0, 10, _STATES)
        self.states = tuple(np.asarray(x, np.float32) for x in (q, v, u, seconds))
        self.known = law.actuators if what == "command" else tuple(law.dofs)
        self.unchanged = {
            "force": lambda known, name: 0.0,
            "command": lambda known, name: known.ctrl[name],
            "reading": lambda known, name: known.qpos[name],
        }[what]

    def _refuse(self, why: str) -> NoReturn:
        at = getattr(self.function, "__code__", None)
        line = f", line {at.co_firstlineno}" if at else ""
        name = f"{self.law.name!r}"
        raise UserError(
            f"{source_of(self.function)}{line}: effect {name}, {self.what}: {why}"
        )

    def check(self) -> None:
        """Raises `UserError` where it cannot be believed."""
        for share in _SIZES:
            self._check_at(self._numbers(share))
        self._check_neutral()

    def _numbers(self, share: float) -> np.ndarray:
        known = self.neutral.copy()
        for k, name in enumerate(self.law.numbers):
            row = NUMBERS[f"{self.law.name}.{name}"]
            low = row.lower(None, 0)
            known[self.law.row + k] = low + share * (row.high - low)
        return known

    def _call(self, known: Any, q: Any, v: Any, u: Any, seconds: Any) -> jax.Array:
        """All outputs less what is without the effect, ``(n,)``."""
        law = self.law
        outputs = law.outputs(self.function, known, q, v, u, seconds)
        at = law.known(q, v, u, seconds)
        numbers = []
        for got in outputs:
            for name, x in got.items():
                if name not in self.known:
                    kind = "actuator" if self.what == "command" else "joint"
                    self._refuse(
                        f'"{name}" is no {kind} of the model{nearest(name, self.known)}'
                    )
                shape = None if x is None or isinstance(x, str) else jnp.shape(x)
                real = shape is not None and not jnp.iscomplexobj(x)
                if not real:
                    self._refuse(f'"{name}" gets {x!r:.40}, which is no real number')
                if shape:
                    self._refuse(f'"{name}" gets shape {shape}, not a single number')
                numbers.append(jnp.asarray(x, jnp.float32) - self.unchanged(at, name))
        if not numbers:
            self._refuse("it returns nothing")
        return jnp.stack(numbers)

    def _ended(self, *args: Any) -> jax.Array:
        """`_call`, of which nobody knows yet whether it ends."""
        ended: Future[jax.Array] = Future()

        def called() -> None:
            try:
                ended.set_result(self._call(*args))
            except BaseException as error:
                ended.set_exception(error)

        context = contextvars.copy_context()
        threading.Thread(target=context.run, args=(called,), daemon=True).start()
        try:
            return ended.result(_PATIENCE)
        except TimeoutError:
            if ended.done():
                raise
            self._refuse(
                f"it has not returned after {_PATIENCE:g} s, and a fit calls it "
                "millions of times; is there a loop without end?"
            )

    def _tried(self, function: Any, *args: Any) -> Any:
        try:
            return jax.block_until_ready(function(*args))
        except UserError:
            raise
        except Exception as error:
            cure = ""
            if isinstance(error, jax.errors.ConcretizationTypeError):
                cure = (
                    "; it has to be compiled: use jax.numpy, and jnp.where in place "
                    "of if"
                )
            place = told_by_line(source_of(self.function), error)
            raise UserError(f"effect {self.law.name!r}: {place}{cure}") from error

    def _check_at(self, known: np.ndarray) -> None:
        # As jax's, which divide by zero without a word, as in a program.
        one = tuple(jnp.asarray(x[0]) for x in self.states)
        given = jnp.asarray(known)
        first = np.asarray(self._tried(self._ended, given, *one))
        # At the first call jax makes the operations ready.
        begin = time.perf_counter()
        second = np.asarray(self._tried(self._call, given, *one))
        self._in_time(time.perf_counter() - begin, "once more")
        program = jax.jit(jax.vmap(self._call, (None, 0, 0, 0, 0)))
        each = np.asarray(self._tried(program, known, *self.states))
        begin = time.perf_counter()
        again = np.asarray(self._tried(program, known, *self.states))
        self._in_time(time.perf_counter() - begin, f"at {_STATES} states, compiled,")
        if not np.isfinite(each).all():
            self._refuse("it gives numbers that are not finite")
        near = _NEAR * np.abs(each).max()
        alike = np.abs(first - second).max() <= near and np.array_equal(each, again)
        if not alike or np.abs(each[0] - first).max() > near:
            self._refuse(
                "it gives two answers to one question; make it a pure function of its "
                "arguments, without random numbers and without what it keeps"
            )

    def _in_time(self, seconds: float, how: str) -> None:
        if seconds > _MOST_SECONDS:
            self._refuse(
                f"called {how} it took {seconds:.1f} s, and a fit calls it millions of "
                "times; make it quicker (no loops over time, no files)"
            )

    def _check_neutral(self) -> None:
        program = jax.jit(jax.vmap(self._call, (None, 0, 0, 0, 0)))
        size = np.abs(self._tried(program, self._numbers(_SIZES[1]), *self.states))
        off = np.abs(self._tried(program, self.neutral, *self.states)).max()
        if not off <= _NEAR * max(float(size.max()), 1e-30):
            self._refuse(
                f"with its neutral numbers it still changes something (by {off:.3g}); "
                "give neutral= such that it does not"
            )

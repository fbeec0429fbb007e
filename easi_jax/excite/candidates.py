"""The tests that are tried: their recipes, and each fitted into the limits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.errors import UserError
from easi_jax.excite import drives, play, signals
from easi_jax.model.joint_space import Configuration, scalar_dofs
from easi_jax.model.quantities import is_position_servo

LEAD = 1.0  # s of rest at either end
_FASTEST = 0.2  # of the control rate that a band may reach
_STILL = 1e-3  # of its amplitude below which a command counts as none
_NUDGE = 0.005  # of a joint's range, to see whether it falls
_HOLDS = 0.5  # of the limits that holding still may take, or open loop is given up


@dataclass(frozen=True)
class Recipe:
    """One test before it is fitted into the limits.

    Attributes:
        kind: of `signals.KINDS`.
        low, high: band [Hz]; of ``pulses`` and ``steps`` the inverse of their pace.
        level: share of the largest amplitude that is safe.
    """

    kind: str
    low: float
    high: float
    level: float

    def text(self) -> str:
        """Such as ``0.2-5 Hz multisine, 40 % of the amplitude``."""
        if self.kind in ("pulses", "steps"):
            what = f"{self.kind} of about {1 / self.high:.2g} s"
        elif self.kind == "mixed":
            what = f"steps, multisine and pulses up to {self.high:.2g} Hz"
        else:
            what = f"{self.low:.2g}-{self.high:.2g} Hz {self.kind}"
        return (
            what if self.level == 1 else f"{what} at {self.level:.0%} of the safe size"
        )


@dataclass(frozen=True)
class Test:
    """A test inside the limits, and what the model does under it.

    Attributes:
        recipe: what it is.
        seed: of its random parts.
        signal: added to the hold, ``(T, nu)``.
        amplitude: largest size of each column, ``(nu,)``.
        motions: of the model as given and of the wrong ones.
        run: the motion of the model as given, as a recording.
    """

    recipe: Recipe
    seed: int
    signal: np.ndarray
    amplitude: np.ndarray
    motions: Sequence[play.Motion]
    run: Run

    __test__ = False  # not one of pytest's


def recipes(rate: float, seconds: float) -> list[Recipe]:
    """What is tried at a control rate [Hz]; bands end well below it."""
    top, slow = _FASTEST * rate, 3.0 / max(seconds - 2 * LEAD, 1.0)
    bands = [(0.1, 1.0), (0.2, 3.0), (0.5, 8.0)]
    bands = [(max(a, slow), min(b, top)) for a, b in bands]
    bands = [(a, b) for a, b in dict.fromkeys(bands) if b > 1.5 * a] or [(slow, top)]
    out = []
    for level in (1.0, 0.35):
        out += [Recipe("multisine", a, b, level) for a, b in bands]
        out += [Recipe("chirp", a, b, level) for a, b in bands[1:] or bands]
        out += [
            Recipe(k, slow, min(f, top), level)
            for k in ("pulses", "steps")
            for f in (0.8, 2.5)
        ]
        out.append(Recipe("mixed", *bands[len(bands) // 2], level))
    return list(dict.fromkeys(out))


def raw_signal(
    recipe: Recipe, seed: int, time: np.ndarray, servo: np.ndarray, motor: np.ndarray
) -> np.ndarray:
    """The signal of a recipe at size one, zero during lead and tail, ``(T, nu)``.

    Args:
        servo: which actuators are position servos, ``(nu,)`` bool.
        motor: which are motors.
    """
    rng = np.random.default_rng([seed, *recipe.kind.encode(), round(100 * recipe.high)])
    inside = (time >= LEAD) & (time <= time[-1] - LEAD)
    t, n = time[inside], len(servo)
    out = np.zeros((len(time), n))
    if recipe.kind == "mixed":
        third = len(t) // 3
        parts = []
        for kind, a in (("steps", 0), ("multisine", third), ("pulses", 2 * third)):
            end = len(t) if kind == "pulses" else a + third
            parts.append(_one(recipe, kind, rng, t[a:end], servo))
        shape = np.concatenate([signals.normalized(p) for p in parts])
    else:
        shape = _one(recipe, recipe.kind, rng, t, servo)
    if motor.any():
        shape = np.where(motor, signals.balanced(t, shape), shape)
    out[inside] = signals.normalized(shape)
    return out


def _one(
    recipe: Recipe,
    kind: str,
    rng: np.random.Generator,
    t: np.ndarray,
    servo: np.ndarray,
) -> np.ndarray:
    n, pace = len(servo), 1.0 / recipe.high
    if kind == "chirp":
        return signals.chirp(rng, t, n, recipe.low, recipe.high)
    if kind in ("pulses", "steps"):
        pace = max(pace, 0.4)
        made = signals.pulses if kind == "pulses" else signals.steps
        return made(rng, t, n, pace)
    # A position servo's force grows with frequency squared.
    flat = signals.multisine(rng, t, n, recipe.low, recipe.high, 0.0)
    steep = signals.multisine(rng, t, n, recipe.low, recipe.high, 1.0)
    return np.where(servo, steep, flat)


def holds(bench: play.Bench, rows: int) -> bool:
    """Whether the machine stays put without a controller, wrong models and a start
    that is a little off included."""
    m, limits, start = bench.models[0], bench.limits, bench.start.copy()
    for q, d in scalar_dofs(m).values():
        span = limits.high[d] - limits.low[d]
        start[q] += _NUDGE * span if np.isfinite(span) else 0.0
    for model in bench.models:
        motion = play.play(
            model, start, np.tile(bench.hold, (rows, 1)), bench.dt, far=bench.far
        )
        used = play.usage(model, motion, bench.start, bench.hold, limits, rows)
        if not used.whole or used.joint.max(initial=0) > _HOLDS:
            return False
    return True


def make_bench(
    m: mujoco.MjModel,
    limits: drives.Limits,
    dt: float,
    rows: int,
    way: str = "auto",
) -> tuple[play.Bench, list[str]]:
    """A machine ready for tests, and notes.

    Args:
        way: ``open-loop``, ``feed-forward``, or ``auto``: open loop where the machine
            stays put by itself.

    Raises:
        UserError: feed-forward asked for where no motor sits at a joint.
    """
    start, notes = drives.start_pose(m, limits)
    hold = drives.hold_command(m, start, limits)
    bench = play.Bench(play.variations(m), start, hold, limits, dt)
    if way == "open-loop":
        return bench, notes
    if way == "auto" and holds(bench, rows):
        return bench, notes
    feedback = drives.feedback_of(m, start)
    if feedback is None:
        if way == "feed-forward":
            raise UserError(
                "--play feed-forward is for motors at joints, and the model has none: "
                "its drives hold a position or speed themselves"
            )
        return bench, notes
    return play.Bench(bench.models, start, hold, limits, dt, feedback), notes


def make_tests(
    bench: play.Bench,
    chosen: Sequence[Recipe],
    most: np.ndarray,
    seconds: float,
    seed: int,
    done: Callable[[Recipe, Test | None], None] = lambda r, t: None,
) -> list[Test]:
    """Every recipe that can be kept inside the limits.

    Args:
        most: largest change of each command, ``(nu,)``.
        done: called after each recipe.
    """
    m = bench.models[0]
    time = np.arange(round(seconds / bench.dt) + 1) * bench.dt
    size = drives.amplitudes(m, bench.start, bench.hold, bench.limits, most)
    servo = np.array([is_position_servo(m, a) for a in range(m.nu)], bool)
    motor = np.array([drives.is_motor(m, a) for a in range(m.nu)], bool)
    out = []
    safe: dict[Recipe, np.ndarray] = {}
    for recipe in sorted(chosen, key=lambda r: -r.level):
        raw = size * raw_signal(recipe, seed, time, servo, motor)
        whole = replace(recipe, level=1.0)
        got = bench.fitted(raw, recipe.level * safe.get(whole, np.ones(m.nu)))
        if got is not None and recipe.level == 1:
            safe[recipe] = got[0]
        test = None
        if got is not None and (got[0] * np.abs(raw).max(0)).max() > _STILL * (
            size.max()
        ):
            scale, motions = got
            signal = scale * raw
            test = Test(
                recipe,
                seed,
                signal,
                np.abs(signal).max(0),
                motions,
                run_of(m, motions[0], bench.dt, recipe.text()),
            )
            out.append(test)
        done(recipe, test)
    return out


def run_of(m: mujoco.MjModel, motion: play.Motion, dt: float, name: str) -> Run:
    """A motion as a recording without noise."""
    return Run(
        name=name,
        source="simulated",
        dt=dt,
        time=np.arange(len(motion.qpos)) * dt,
        qpos=motion.qpos,
        qvel=motion.qvel,
        qvel_measured=False,
        ctrl=motion.ctrl,
        configuration=Configuration.of(m),
    )

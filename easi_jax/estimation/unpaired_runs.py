"""Logs of a robot under its controller, made ready for `easi_jax.search.unpaired`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data.cleaning import rows_of
from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.proprioception import Proprioception, proprioception
from easi_jax.data.recording import Run
from easi_jax.errors import UserError, nearest
from easi_jax.rl.networks import act
from easi_jax.search.config import SearchConfig
from easi_jax.search.unpaired import (
    MEMORY,
    Delays,
    Pieces,
    Simulations,
    UnpairedData,
    UnpairedSearch,
    centered,
    compared_steps,
    pieces_of,
    reading_delays,
)

_SAME_STEP = 0.02  # of a control step, that a log's may differ by
_FEWEST = 100  # pieces that say something of a gait
_BESIDE = 0.1  # of what simulations send, that a log's commands may lie outside of it
_FITS = 0.5  # of a log's commands, at least, that a policy that sent them would send


@dataclass(frozen=True, eq=False)
class UnpairedProblem:
    """A robot under its controller, and what it read.

    Attributes:
        name: of the robot.
        env: it; its effects and parameters are searched.
        act: ``act(policy, obs, key) -> action``; ``policy`` its parameters.
        of: channels; ``noise (C,)`` of theirs, and ``delays`` of readings.
        fit, held: runs at the control step, cut into stretches that are as long as what
            is compared of a simulation; ``held_name`` which data are held out.
        notes: what the user should know.
    """

    name: str
    env: Any
    act: Callable[..., jax.Array]
    policy: Any
    of: Proprioception
    noise: np.ndarray
    delays: Delays
    fit: list[Run]
    held: list[Run]
    held_name: str
    notes: list[str]

    def search(self, config: SearchConfig) -> UnpairedSearch:
        """The search."""
        return UnpairedSearch(self.env, self.act, self.of, self.delays, config)

    def data(self) -> UnpairedData:
        """Pieces to fit."""
        noise = jnp.asarray(self.noise, jnp.float32)
        return UnpairedData(self.pieces(self.fit), noise, self.policy)

    def pieces(self, runs: Sequence[Run]) -> Pieces:
        """Pieces of some runs, readings of sensors about their mean in each."""
        parts = []
        for run in (r for r in runs if len(r) > MEMORY + 1):
            rows, weight = self.of.of_run(run), jnp.ones(len(run))
            rows = centered(jnp.asarray(rows, jnp.float32), weight, self.of)
            ctrl = jnp.asarray(run.ctrl, jnp.float32)
            parts.append(pieces_of(rows, ctrl, weight))
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def unpaired_problem(
    env: Any,
    policy: Any,
    runs: MeasuredRuns,
    steps: int,
    observed: Mapping[str, float] | None = None,
    sampled: bool = False,
    noise: Sequence[float] = (),
) -> UnpairedProblem:
    """The problem of finding the parameters of ``env`` under which it reads what
    ``runs`` hold.

    Args:
        env: the robot.
        policy: parameters of its controller; None where its actions are its own
            (`easi_jax.simulation.sent_commands`).
        runs: of a log.
        steps: control steps of a simulation.
        observed: entries of the observation that were held, by name: what the robot was
            asked to do.
        sampled: whether actions were drawn, in place of the policy's mode.
        noise: of the channels, standard deviations; empty: those of the runs, which
            motion makes too large where it is rough from row to row.

    Raises:
        UserError: runs at another control step, too short ones, or with nothing to
            compare; an entry that the observation lacks; noise of another size.
    """
    length = compared_steps(steps, env.dt)
    fit, held = (
        stretches(at_control_step(r, env.dt), length) for r in (runs.fit, runs.held)
    )
    m = env.mj_model
    of, notes = proprioception(m, [*fit, *held], env.simulator.engine)
    sizes = _noise_of(of, runs, noise)
    problem = UnpairedProblem(
        *(env.name, env, acting(env, policy, observed or {}, sampled), policy),
        *(of, sizes, reading_delays(of, env.dt)),
        *(fit, held, runs.held_name, [*runs.notes, *notes]),
    )
    for some, what in ((fit, "to fit"), (held, "held out")):
        count = sum(max(0, len(run) - MEMORY - 1) for run in some)
        if count < _FEWEST:
            raise UserError(
                f"the runs {what} make {count} pieces of {MEMORY + 2} rows: record "
                f"{_FEWEST * env.dt:.3g} s at least"
            )
    return problem


def _noise_of(
    of: Proprioception, runs: MeasuredRuns, given: Sequence[float]
) -> np.ndarray:
    """Noise of channels, ``(C,)``: as given, else that of the runs."""
    if not len(given):
        return of.noise(runs.noise, runs.recorded)
    noise = np.asarray(given, float)
    if noise.shape != (len(of),) or not (np.isfinite(noise) & (noise >= 0)).all():
        raise UserError(
            f"--noise is {list(given)}: with --policy it needs {len(of)} numbers, 0 or "
            f"more, for {', '.join(of.names)}"
        )
    return noise


def stretches(runs: Sequence[Run], length: int) -> list[Run]:
    """Runs cut into stretches of ``length`` rows; a rest of half of that counts."""
    out = []
    for run in runs:
        for first in range(0, len(run), length):
            part = rows_of(run, first, first + length)
            if len(part) >= min(len(run), max(length // 2, MEMORY + 2)):
                out.append(part)
    return out


def acting(
    env: Any, policy: Any, observed: Mapping[str, float], sampled: bool
) -> Callable[..., jax.Array]:
    """``act(policy, obs, key)`` of a controller that sees ``observed`` entries."""
    names = tuple(getattr(env, "obs_names", ()))
    for name in observed:
        if name not in names:
            known = ", ".join(names) or "it names none"
            raise UserError(
                f"--observed {name}: the observation of {env.name} has no such entry "
                f"(known: {known}){nearest(name, names)}"
            )
    if policy is None:
        return lambda policy, obs, key: jnp.zeros(env.action_size)
    at = np.array([names.index(name) for name in observed], int)
    values = jnp.asarray(list(observed.values()), jnp.float32)

    def chosen(policy: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
        if len(at):
            obs = obs.at[..., at].set(values)
        return act(policy, obs, key, not sampled)

    return chosen


def command_step(run: Run) -> float:
    """The time between two commands of a run [s]: its rows may be denser."""
    gaps = np.diff(_changes(run))
    return run.dt * max(1, round(float(np.median(gaps))) if len(gaps) else 1)


def at_control_step(runs: Sequence[Run], dt: float) -> list[Run]:
    """Runs with a row for each control step ``dt`` [s]; of rows that are denser those
    are kept in which commands change.

    Raises:
        UserError: a run whose rows are sparser, or do not divide a control step.
    """
    out = []
    for run in runs:
        every = dt / run.dt
        count = max(1, round(every))
        if abs(every / count - 1) > _SAME_STEP:
            raise UserError(
                f"{run.name} has a row every {run.dt:.4g} s, and the controller acts "
                f"every {dt:.4g} s: log a whole number of rows for each command, or "
                "one"
            )
        out.append(run if count == 1 else _thinned(run, count))
    return out


def _last(readings: np.ndarray, count: int) -> np.ndarray:
    """The last reading of each row ``(T, dim)``, if it is one of ``count`` rows: a
    sensor that is slower than the rows may be as fast as the controller."""
    rows = np.arange(len(readings))
    there = np.isfinite(readings).all(1)
    at = np.maximum.accumulate(np.where(there, rows, -1))
    near = (at >= 0) & (rows - at < count)
    return np.where(near[:, None], readings[np.maximum(at, 0)], np.nan)


def _changes(run: Run) -> np.ndarray:
    """Rows in which a new command is sent."""
    return 1 + np.flatnonzero((np.diff(run.ctrl, axis=0) != 0).any(1))


def _thinned(run: Run, count: int) -> Run:
    """A row for each command: where it changes, or else ``count`` after the last, so
    that clocks may drift."""
    changes, rows = _changes(run), []
    at = int(changes[0]) if len(changes) else 0
    while at < len(run):
        rows.append(at)
        due = at + count
        near = changes[np.abs(changes - due) <= count // 2]
        at = int(near[np.argmin(np.abs(near - due))]) if len(near) else due
    rest = rows_of(run, rows[0], len(run))
    kept = np.array(rows) - rows[0]
    return replace(
        rest,
        dt=run.dt * count,
        before=rest.before[::-count][::-1],
        time=rest.time[kept],
        qpos=rest.qpos[kept],
        qvel=rest.qvel[kept],
        ctrl=rest.ctrl[kept],
        sent=None,
        sensors={k: _last(v, count)[rows] for k, v in run.sensors.items()},
    )


def check_commands(
    problem: UnpairedProblem, search: UnpairedSearch, simulated: Simulations, key: Any
) -> None:
    """Checks that the controller sends, in simulations of the initial range, commands
    like those of the log.

    Raises:
        UserError: it does not, or hardly any simulation stays on its feet.
    """
    unit = jax.random.uniform(key, (simulated.size, search.space.size))
    pieces, sound = simulated(np.asarray(unit), key)
    if sound.sum() < 2:
        what = (
            "when it is only sent the log's commands: give its policy"
            if problem.policy is None
            else "under this controller: give the policy that was logged"
        )
        raise UserError(
            "hardly any simulation of the initial range stays finite and on its feet "
            f"{what}, or start from a model that is nearer (--start, --parameters)"
        )
    if problem.policy is None:
        return
    nu = problem.env.mj_model.nu
    sent = pieces.before[sound][..., -nu:][pieces.weight[sound] > 0]
    logged = np.concatenate([run.ctrl for run in problem.fit])
    low, high = sent.min(0), sent.max(0)
    slack = _BESIDE * (high - low) + 1e-6
    inside = ((logged > low - slack) & (logged < high + slack)).mean(0)
    a = int(np.argmin(inside))
    if inside[a] < _FITS:
        first, last = np.percentile(logged[:, a], [5, 95])
        name = problem.env.mj_model.actuator(a).name
        raise UserError(
            f"the policy does not fit the log's commands: {name} was sent {first:.3g} "
            f"to {last:.3g}, and in simulation this policy sends it {low[a]:.3g} to "
            f"{high[a]:.3g}. Give the policy that was logged, and with --observed what "
            "it was asked to do"
        )

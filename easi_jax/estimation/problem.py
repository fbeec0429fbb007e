"""What an estimate from measured logs is asked: simulator, runs, noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from easi_jax.data.cleaning import true_readings, trusted_velocities
from easi_jax.data.measured import MeasuredRuns
from easi_jax.data.recording import Run
from easi_jax.data.segments import to_device
from easi_jax.data.sensor_channels import (
    NO_SENSORS,
    Sensors,
    moving_sensors,
    read_at_end,
)
from easi_jax.data.unmeasured import hidden_in_any
from easi_jax.data.velocity_lag import of_model, set_right
from easi_jax.data.windows import lead_rows
from easi_jax.devices.runtime import quick_compile
from easi_jax.errors import UserError
from easi_jax.estimation.pieces import segments_from_runs, visible_steps
from easi_jax.estimation.starts import known_noise
from easi_jax.estimation.weights import readings
from easi_jax.model.found_effects import FoundEffects, joined
from easi_jax.model.joint_space import tangent_names
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import open_loop
from easi_jax.simulation.logged import Logged
from easi_jax.simulation.simulator import Simulator

HORIZON = 0.2  # s, of the error that is reported; pieces are no longer
_COMMANDED, _READ = 64, 8  # pieces, and steps at least, that say when sensors were read
_ABOVE_NOISE = 30.0  # RMS motion over a piece in units of its noise


@dataclass(frozen=True, eq=False)
class Problem:
    """A machine and its measured motion.

    Attributes:
        name: of the model.
        simulator: with the parameters, at the logs' control step.
        fit, held: runs.
        held_name: which data are held out.
        noise: standard deviations of positions and velocities, ``(2 nv,)``; infinite
            where hidden.
        measured: velocities that were measured and can be trusted, ``(nv,)`` bool.
        piece: control steps of a piece in the search.
        steps: control steps of the open-loop error that is reported.
        horizon: the same in seconds.
        notes: what the user should know of the data.
        sensors: whose readings the finish fits, too.
        noise_given: whether the user said what the noise is.
    """

    name: str
    simulator: Simulator
    fit: list[Run]
    held: list[Run]
    held_name: str
    noise: np.ndarray
    measured: np.ndarray
    piece: int
    steps: int
    horizon: float
    notes: list[str]
    sensors: Sensors = NO_SENSORS
    noise_given: bool = False

    @cached_property
    def fitted_sensors(self) -> Sensors:
        """The sensors, with those known that were read before the command of their row
        was sent, by what the model as given predicts."""
        sensors, runs = self.sensors, self.fit
        steps = min(max(self.steps, _READ), max(len(r) for r in runs) - 1)
        if steps < _READ or not any(n.of_forces for n in sensors):
            return sensors
        simulator = self.simulator.sensing(sensors)
        pieces = segments_from_runs(simulator, runs, steps, steps, sensors=sensors)
        pieces = to_device(pieces.spread(min(pieces.count, _COMMANDED)))

        def sensed(theta: jax.Array) -> jax.Array:
            model = simulator.model(theta)
            return open_loop.predict_sensed(simulator, model, pieces)[2]

        nominal = jnp.asarray(self.simulator.space.nominal, jnp.result_type(float))
        each = jax.jit(sensed, compiler_options=quick_compile())(nominal)
        read = pieces.sensed[:, 1:]
        span = np.ptp(np.asarray(read), axis=(0, 1))
        size = known_noise(sensors.noise(runs)[0], span)
        there = np.asarray(readings(pieces, len(sensors)))[:, 1:] > 0
        begins, ends = (
            np.where(there, np.asarray(sensors.reading.alike(x, read) - read), np.nan)
            / np.maximum(size, 1e-30)
            for x in (each[:, 1:, 0], each[:, :-1, 1])
        )
        of_forces = {n.sensor for n in sensors if n.of_forces}
        names = read_at_end(sensors, begins, ends)
        return sensors.ending([name for name in names if name in of_forces])

    @cached_property
    def sensing(self) -> Simulator:
        """The simulator, which reads the sensors where there are any."""
        sensors = self.fitted_sensors
        return self.simulator.sensing(sensors) if sensors else self.simulator


def checked_horizon(horizon: float | None) -> float:
    """Seconds of a prediction; `HORIZON` where None.

    Raises:
        UserError: not a number above 0.
    """
    horizon = HORIZON if horizon is None else horizon
    if not (math.isfinite(horizon) and horizon > 0):
        raise UserError(f"--horizon is {horizon:g}: give seconds above 0")
    return horizon


def problem_of(
    name: str,
    mj_model: mujoco.MjModel,
    space: ParameterSpace,
    runs: MeasuredRuns,
    *,
    found: FoundEffects | None = None,
    start: tuple[float, float] | None = None,
    noise: Sequence[float] = (),
    horizon: float | None = None,
) -> Problem:
    """The problem of fitting ``space`` to ``runs``.

    Args:
        name: of the model.
        mj_model: the model as given.
        space: what may vary in it.
        runs: of `easi_jax.data.measured.measured_runs`.
        found: effects that the model gets; their parameters join ``space``.
        start: where the search starts, as factors on the nominal values.
        noise: standard deviations of positions, then velocities, ``(2 nv,)``; empty:
            those of ``runs``. Numbers of joints that nobody measured are not used.
        horizon: of predictions [s]; None: `HORIZON`, and pieces of the search as short
            as the noise lets them be.

    Raises:
        UserError: what MJX cannot simulate, noise of another size, runs too short.
    """
    found = found or FoundEffects()
    space, fixed = joined(mj_model, space, found)
    if start is not None:
        space = space.scaled(*start)
    seconds = checked_horizon(horizon)
    fit, held = (
        true_readings(mj_model, r, found.entries) for r in (runs.fit, runs.held)
    )
    hidden = hidden_in_any([*fit, *held])
    late = of_model(mj_model, fit[0].dt)
    right = set_right([*fit, *held], tangent_names(mj_model), late)
    fit, held = right.runs[: len(fit)], right.runs[len(fit) :]
    scatter = np.where(np.tile(hidden, 2), np.inf, _noise_of(name, runs, noise))
    if not len(noise):
        scatter = scatter * np.append(np.ones(mj_model.nv), right.noisier)
    logged = Logged.of([*fit, *held])
    simulator = Simulator(mj_model, space, fit[0].dt, fixed=fixed, logged=logged)
    measured, doubted = _measured(simulator, fit, hidden)
    sensors, sensed = moving_sensors(mj_model, fit, simulator.engine)
    steps = max(1, round(seconds / simulator.dt))
    _check_lengths(fit, held, steps, simulator.dt)
    short = horizon is None
    return Problem(
        name,
        simulator,
        fit,
        held,
        runs.held_name,
        scatter,
        measured,
        visible_steps(fit, scatter, steps, _ABOVE_NOISE) if short else steps,
        steps,
        steps * simulator.dt,
        [
            *runs.notes,
            *(
                f"{e.effect}@{e.at}: taken out of the logs' readings"
                for e in found.entries
                if e.of_readings
            ),
            *simulator.notes,
            *right.notes,
            *doubted,
            *sensed,
        ],
        sensors,
        len(noise) > 0,
    )


def _noise_of(name: str, runs: MeasuredRuns, noise: Sequence[float]) -> np.ndarray:
    """Standard deviations, ``(2 nv,)``: as given, else those of the runs."""
    size = len(runs.noise)
    scatter = np.asarray(noise, float) if len(noise) else runs.noise
    given = np.where(np.isfinite(runs.noise) | (len(noise) > 0), scatter, 0.0)
    if scatter.shape != (size,) or not np.all(np.isfinite(given) & (given >= 0)):
        raise UserError(
            f"--noise is {list(noise)}: {name} needs {size} numbers, 0 or "
            "more: positions, then velocities"
        )
    return scatter


def _measured(
    simulator: Simulator, fit: Sequence[Run], hidden: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Velocities that were measured and can be trusted, ``(nv,)`` bool; and a note on
    others that were measured."""
    measured = trusted_velocities(fit) & ~hidden
    fine = measured | hidden
    if not any(run.qvel_measured for run in fit) or fine.all():
        return measured, []
    names = simulator.state_names[len(fine) :]
    doubted = ", ".join(n for n, m in zip(names, fine, strict=True) if not m)
    return measured, [
        f"{doubted}: not the derivative of the positions (filtered or late?), so "
        "velocities are taken from the positions"
    ]


def _check_lengths(
    fit: Sequence[Run], held: Sequence[Run], steps: int, dt: float
) -> None:
    lead = lead_rows(dt)
    for runs, what in ((fit, "to fit"), (held, "held out")):
        longest = max(runs, key=len)
        if len(longest) <= steps + lead:
            raise UserError(
                f"the longest run {what} ({longest.name}) has {len(longest)} rows, too "
                f"few for a horizon of {steps} steps ({steps * dt:g} s) and the {lead} "
                "before it: record more, or shorten --horizon"
            )

"""Open-loop errors of predicted positions on held-out logs, by the measure of the log
format: starts are fitted with the model's own dynamics, and the floor goes through the
same fit (`easi_jax.estimation.starts`)."""

import math
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.data import unmeasured
from easi_jax.data.noise import resolutions
from easi_jax.data.recording import Run
from easi_jax.data.segments import to_device
from easi_jax.data.velocity_lag import noise_in_starts
from easi_jax.data.windows import lead_rows, start_rows
from easi_jax.devices.mesh import placed
from easi_jax.devices.runtime import quick_compile
from easi_jax.estimation.from_runs import spread_of_starts
from easi_jax.estimation.pieces import segments_from_runs
from easi_jax.estimation.prediction_error import rms_of_steps
from easi_jax.estimation.problem import Problem
from easi_jax.estimation.starts import (
    DRAWS,
    SimulateRows,
    Starts,
    floor,
    known_noise,
    starts_about,
)
from easi_jax.model.joint_space import tangent_units
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import HeldOutErrors
from easi_jax.model.separate_trees import start_parts
from easi_jax.simulation import open_loop
from easi_jax.simulation.slopes import shift_start

_HELD, _FIT = 200, 96  # windows that errors are measured on, at most


class WindowErrors:
    """RMS errors of predicted positions, ``(nv,)``, over windows of some runs.

    A window whose prediction is not finite counts as an error of the largest motion.

    Args:
        problem: the measured runs.
        space: the parameters of a prediction.
        runs: some of them.
        most: windows at most.
    """

    def __init__(
        self, problem: Problem, space: ParameterSpace, runs: Sequence[Run], most: int
    ) -> None:
        simulator, nv = problem.simulator, problem.simulator.mj_model.nv
        self.lead = lead_rows(simulator.dt)
        every = max(1, problem.steps // 2)
        given = simulator, runs, self.lead + problem.steps, every
        none = np.zeros(nv, bool)
        seen = problem.measured if all(run.qvel_measured for run in runs) else none
        cuts = [segments_from_runs(*given, none)] * 2
        if seen.any():
            cuts[0] = segments_from_runs(*given, seen)
        read, fitted = (c.spread(most) if c.count > most else c for c in cuts)
        # Starts are by the positions alone, before velocities help to find them.
        windows = to_device(replace(read, qvel=fitted.qvel))
        faster = jnp.asarray(fitted.qvel - read.qvel)
        length = self.lead + problem.steps + 1
        begun = np.arange(length) < start_rows(simulator.dt)
        largest = jnp.abs(open_loop.motion(simulator, windows)[..., :nv])
        self.largest = jnp.asarray(np.asarray(largest).max((0, 1)))

        def errors(theta: jax.Array, moved: jax.Array, steps: jax.Array) -> jax.Array:
            first = shift_start(simulator, windows, moved)
            model = simulator.model(theta)
            found = open_loop.errors_from(simulator, model, first, windows, steps)
            begin = moved[:, : 2 * nv].at[:, nv:].add(faster)
            off = jnp.concatenate([begin[:, None], -found[..., : 2 * nv]], 1)
            off = off.at[..., nv:].multiply(begun[:, None])
            return off if seen.any() else off[..., :nv]

        still = np.zeros((windows.count, 2 * nv + simulator.mj_model.na), np.float32)
        like = placed((jnp.zeros(space.size), jnp.asarray(still), jnp.asarray(0)))
        compiled = jax.jit(errors).lower(*like).compile(quick_compile())

        def simulate(x: np.ndarray, moved: np.ndarray, rows: int) -> np.ndarray:
            found = []
            for asked in zip(x, moved, [rows - 1] * len(x), strict=True):
                given = map(jnp.asarray, asked, (a.dtype for a in like))
                found.append(jax.device_get(compiled(*placed(tuple(given)))))
            return np.stack(found)[:, :, :rows]

        self.still, self.count = still, windows.count
        self.starts = _starts_of(problem, simulate, length, runs, seen)
        if seen.any():
            read = np.ones((windows.count, len(begun), 2 * nv))
            read[..., nv:] = begun[:, None]
            self.starts.read = read
        self.rows = self.starts.noise
        step = resolutions([*problem.fit, *problem.held])
        self.resolution = np.pad(step, (0, self.starts.alone))

    def of(self, theta: jax.Array) -> tuple[np.ndarray, int]:
        """At SI parameters ``(n,)``; and how many windows are not finite."""
        return self._rms(self._solved(np.asarray(theta))[1])

    def with_floor(self, theta: jax.Array) -> tuple[np.ndarray, int, np.ndarray]:
        """`of`, and what a perfect model would leave."""
        x = np.asarray(theta)
        moved, found = self._solved(x)
        rng = np.random.default_rng(0)
        least = floor(self.starts, x, moved, DRAWS, self.resolution, rng)
        return *self._rms(found), np.sqrt(self.starts.mean_square(least, self.lead + 1))

    def _solved(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        starts = self.starts
        starts.noise = self.rows
        moved, found = starts.solve(x, self.still)
        starts.believe(found, self.rows, self.resolution / math.sqrt(12.0))
        return moved, found

    def _rms(self, found: np.ndarray) -> tuple[np.ndarray, int]:
        after = self.starts.counted(found, self.lead + 1)
        lost = len(after) - np.isfinite(after).all((1, 2)).sum()
        return np.asarray(rms_of_steps(jnp.asarray(after), self.largest)), int(lost)


def _starts_of(
    problem: Problem,
    simulate: SimulateRows,
    length: int,
    used: Sequence[Run],
    seen: np.ndarray,
) -> Starts:
    """Of windows of the runs ``used`` that begin `lead_rows` before they are measured
    from; velocities that are ``seen (nv,)`` help to find them."""
    m, runs = problem.simulator.mj_model, [*problem.fit, *problem.held]
    moved = [r.configuration.difference(r.qpos[:1], r.qpos) for r in runs]
    size = np.maximum(np.concatenate(moved).std(0), 1e-9)
    given = jnp.asarray(problem.noise), np.zeros(m.nv, bool)
    wide = np.asarray(spread_of_starts(m, runs, *given))
    noise, motion = problem.noise[: m.nv], size
    if seen.any():
        fast = noise_in_starts(m, used, problem.noise)
        noise = np.append(noise, np.where(seen, fast, np.inf))
        speed = np.concatenate([run.qvel for run in used]).std(0)
        motion = np.append(motion, np.maximum(speed, 1e-9))
    return starts_about(
        simulate,
        length,
        known_noise(noise, motion),
        size,
        np.maximum(wide[m.nv : 2 * m.nv], 1e-9),
        unmeasured.start_spread(m, runs, np.isinf(problem.noise[: m.nv])),
        np.maximum(wide[2 * m.nv :], 1e-9),
        runs[0].dt,
        start_parts(m),
        speeds=bool(seen.any()),
    )


def ready_errors(
    problem: Problem, space: ParameterSpace, several: bool = False
) -> tuple[WindowErrors, WindowErrors | None]:
    """Compiled: errors on held-out data and, with ``several`` results to choose from,
    on fitted data."""
    fit = WindowErrors(problem, space, problem.fit, _FIT) if several else None
    return WindowErrors(problem, space, problem.held, _HELD), fit


def held_out_errors(
    problem: Problem,
    space: ParameterSpace,
    means: Sequence[jax.Array],
    ready: tuple[WindowErrors, WindowErrors | None],
) -> HeldOutErrors:
    """Open-loop errors of the model as given and at each of ``means (n,)``, unit
    coordinates, of the joints that were measured; ``ready`` is of `ready_errors`."""
    nominal = jnp.asarray(space.nominal, jnp.result_type(float))
    held, own = ready
    before, lost = held.of(nominal)
    each = [held.with_floor(space.to_si(unit)) for unit in means]
    simulator = problem.simulator
    nv = simulator.mj_model.nv
    seen = np.flatnonzero(np.isfinite(problem.noise[:nv]))
    fit: list[float] = []
    if own is not None:
        scale = np.maximum(own.of(nominal)[0], 1e-12)[seen]
        for unit in means:
            off = own.of(space.to_si(unit))[0][seen] / scale
            fit.append(float(np.mean(off**2)))
    names, units = simulator.state_names[:nv], tangent_units(simulator.mj_model)
    return HeldOutErrors(
        what=problem.held_name,
        horizon=problem.horizon,
        channels=[names[i].removeprefix("qpos.") for i in seen],
        units=[units[i] for i in seen],
        before=before[seen].tolist(),
        after=[after[seen].tolist() for after, _, _ in each],
        floor=[least[seen].tolist() for _, _, least in each],
        fit=fit,
        windows=held.count,
        not_finite=[lost, *(n for _, n, _ in each)],
    )

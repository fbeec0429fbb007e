"""From runs and a model to named effects: the whole workflow, without files.

    windows → refit of the model's own parameters → selection → rivals → figures

Held-out windows take part in none but the last.
"""

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from easi_jax.data.noise import pooled, resolutions
from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.scales import scales_of
from easi_jax.data.sensor_channels import Sensors, measured_sensors, read_at_end
from easi_jax.data.windows import lead_rows
from easi_jax.errors import UserError
from easi_jax.estimation.least_squares import AT_BOUND
from easi_jax.estimation.starts import DRAWS, better_noise, floor, known_noise
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.batched_least_squares import Bounds, bounds_of, window_weights
from easi_jax.gap.candidates import places, ripples
from easi_jax.gap.discretization_error import error_of_steps, within_a_step
from easi_jax.gap.effect_set import Candidate, Model
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.forward_selection import Selector, shortlist
from easi_jax.gap.held_out import HeldOut
from easi_jax.gap.model_comparison import (
    HELPS,
    better,
    explained,
    probability,
    rank,
    simplest,
)
from easi_jax.gap.predictor import BLOCK, Predictor
from easi_jax.gap.result import Figures, Found, Numbers, Outcome, Part
from easi_jax.gap.table import Place, covered, does
from easi_jax.gap.verdict import openness, surely_better, verdict_of
from easi_jax.gap.whitening import make_residuals
from easi_jax.gap.window_set import WindowSet, join, reach, spread, window_set
from easi_jax.gap.window_starts import window_starts
from easi_jax.io.runs.step_cache import key_of
from easi_jax.model.joint_space import is_hinge, scalar_dofs
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Progress, Wait, at_once, silent
from easi_jax.simulation.logged import Logged

_FITTED = (32, 96)  # windows that fits see
_STEPS = 9_600  # physics steps in them
_BLOCKS = 10
_MOST = 5  # effects
_STAGES = 8  # of adding one and taking out what has become needless
_RIPPLES = [0.75 * k for k in range(3, 27)]  # cycles over the range of a joint
_CLOSED = 1.05  # times the floor: nothing left to explain, where not surely more
_RIVALS = 8
_UNLIKELY = 0.3  # probability of an effect beside which a rival replaces it
_ROUNDING = 0.005  # of the gap
_BEAM = 3  # sets of effects that are followed
_LIKELY = 60  # of a larger robot's names, that are tried beside all but the first
_NOTHING = 1e-3  # of the largest error: a change that shows nowhere
_STEPS_SEEN = 0.75  # of the floor: less is lost in noise
_WHOLE = 1.15  # of the error of steps; a finer simulation leaves some of it
_TOLD = 0.8  # of the gap without the own steps' error: worth a note
_BENT = 0.1  # second beside first differences of errors with a start: not linear
_LET_PASS = 0.05  # of what the model errs by, that no fit hangs on

Tell = Callable[[str], None]


class Analysis:
    """One model and its data, ready to be asked.

    Raises:
        UserError: data too short, too still, or that the model does not cover.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        space: ParameterSpace,
        fit: Sequence[Run],
        held: Sequence[Run],
        noise: np.ndarray,
        horizon: float,
        tell: Tell = lambda _: None,
        fixed: Mapping[str, float] | None = None,
        progress: Progress = silent,
        wait: Wait = at_once,
    ) -> None:
        self.m, self.space, self.tell = mj_model, space, tell
        self.fixed = dict(fixed or {})
        self.runs = [*fit, *held]
        dt = fit[0].dt
        self.lead = lead_rows(dt)
        self.scales = scales_of(mj_model, fit)
        sensors, ignored = measured_sensors(mj_model, self.runs)
        self.everywhere = places(mj_model, self.scales)
        self.places = [p for p in self.everywhere if not covered(p, space, mj_model)]
        self.ripples = [
            p
            for j in scalar_dofs(mj_model)
            for p in ripples(mj_model, j, self.scales, self._cycles(j))
        ]
        layout = Layout(mj_model, [*self.everywhere, *self.ripples])
        self.bounds = bounds_of(space, layout)
        self.fit_windows, filled, kept = self._windows(fit, held, horizon, sensors)
        self.predictor = Predictor(
            mj_model,
            space,
            layout,
            join([filled, kept]),
            dt,
            fixed,
            Logged.of(self.runs),
            wait,
            sensors,
        )
        self.sensors = self.predictor.sensors
        self._of_all_channels(fit, np.asarray(noise)[: mj_model.nv])
        own = len(filled) // BLOCK
        self.fit_blocks = np.arange(own)
        self.held_blocks = np.arange(own, self.predictor.blocks)
        simulator = self.predictor.simulator
        self.channels = self._channels(fit, horizon, ignored)
        self.step = dt / simulator.substeps
        self.sticks = False  # whether errors bend with starts: see `whiten`
        self.dropped: set[str] = set()  # found, and then found to say nothing
        count = len(self.fit_windows)
        self.group = np.arange(count) * min(_BLOCKS, count) // count
        self.selector = Selector(
            self.predictor,
            self.fit_blocks,
            count,
            self.bounds,
            self.group,
            range(space.size),
            progress,
        )
        given = mj_model, self.predictor, fit, self.scales, self.noise
        self.fit_starts = window_starts(*given, self.fit_blocks, count)
        self.held_out = HeldOut(
            mj_model,
            self.runs,
            self.predictor,
            kept,
            self.channels,
            window_starts(*given, self.held_blocks, len(kept)),
            self.lead,
            self.resolution,
        )

    def _of_all_channels(self, fit: Sequence[Run], noise: np.ndarray) -> None:
        """Motion, noise and resolution of positions ``noise (nv,)`` and sensors."""
        sensors = self.predictor.sensors
        read = np.concatenate([sensors.readings(run) for run in fit]).std(0)
        self.motion = np.concatenate([self.scales.position, np.maximum(read, 1e-9)])
        told, is_bound = sensors.noise(fit)
        self.noise = known_noise(np.concatenate([noise, told]), self.motion)
        positions = pooled(fit).is_bound[: self.m.nv]
        self.noise_is_bound = np.concatenate([positions, is_bound])
        steps = np.max([resolutions(run) for run in self.runs], axis=0)
        self.resolution = np.concatenate([steps, sensors.resolution(self.runs)])

    def _channels(
        self, fit: Sequence[Run], horizon: float, ignored: Mapping[str, str]
    ) -> measure.Channels:
        """What is compared; ``ignored`` says what can not be.

        Raises:
            UserError: nothing moves.
        """
        names = self.predictor.simulator.state_names[: self.m.nv]
        found = measure.channels(
            self.m,
            [n.removeprefix("qpos.") for n in names],
            fit,
            self.noise,
            self.predictor.steps - self.lead,
            self.sensors,
        )
        found.ignored.update({**ignored, **self.predictor.unpredicted})
        if not np.isfinite(found.scale).any():
            raise UserError(
                "nothing moves by more than five times its noise over a horizon of "
                f"{horizon:g} s: record larger or faster motion, or lengthen --horizon"
            )
        return found

    def _windows(
        self,
        fit: Sequence[Run],
        held: Sequence[Run],
        horizon: float,
        sensors: Sensors,
    ) -> tuple[WindowSet, WindowSet, WindowSet]:
        """Windows that fits see, the same filled to whole blocks, and those held out.

        Raises:
            UserError: runs too short.
        """
        m, longest = self.m, self.scales.longest
        fitted = window_set(m, fit, horizon, longest, 0, sensors)
        kept = window_set(m, held, horizon, longest, len(fit), sensors)
        if fitted is None or kept is None:
            what = "to fit" if fitted is None else "held out"
            raise UserError(
                f"no run {what} is longer than a horizon of {horizon:g} s and the "
                f"{self.lead * fit[0].dt:.3g} s before it: record more, or shorten "
                "--horizon"
            )
        physics = fitted.ctrl.shape[1] * physics_steps(fit[0].dt, m.opt.timestep)
        most = min(max(_STEPS // physics, _FITTED[0]), _FITTED[1])
        chosen = spread(fitted, most, reach(m, fit, fitted))
        pad = np.full(-len(chosen) % BLOCK, chosen[-1])
        return fitted.take(chosen), fitted.take(np.r_[chosen, pad]), kept

    def _plain(self, x: np.ndarray) -> np.ndarray:
        """Vectors without the share of the own steps' error."""
        return x[..., : len(self.predictor.neutral)]

    def _cycles(self, j: int) -> list[float]:
        """Cycles per revolution that a ripple is looked for at."""
        span = float(self.scales.span[int(self.m.jnt_dofadr[j])])
        slow = 1 if is_hinge(self.m, j) else 2
        return [slow * k * 2 * math.pi / span for k in _RIPPLES]

    @property
    def key(self) -> str:
        """A digest of all that the results depend on, for a `Journal`."""
        logs = [
            (run.qpos, run.ctrl, run.time, self.sensors.readings(run))
            for run in self.runs
        ]
        windows = self.fit_windows, self.held_out.windows
        model = np.zeros(mujoco.mj_sizeModel(self.m), np.uint8)
        mujoco.mj_saveModel(self.m, None, model)
        return key_of(
            model,
            self.fixed,
            *(repr(p) for p in self.space.parameters),
            *itertools.chain(*logs),
            *(at for some in windows for at in (some.run, some.row)),
            self.noise,
            self.predictor.simulator.dt,
            self.predictor.steps,
            self.predictor.devices,
        )

    # -- pieces ----------------------------------------------------------------

    def whiten(self, x: np.ndarray) -> None:
        """Renews the noise model of the fit at a vector.

        Starts are integrated out about those that are fitted at the vector. Where feet
        stick and slip, errors are not linear in the start over more than its noise, and
        what is fitted for one model is no start for another: there starts are as rows
        tell.
        """
        chosen, starts = self.selector, self.fit_starts
        still = np.zeros_like(chosen.moved)
        chosen.moved, _ = starts.solve(x, still if self.sticks else chosen.moved)
        errors = chosen.errors(x[None])[0]
        if not np.isfinite(errors).all():
            raise UserError(
                "most predictions of the fitting data are not finite: the model blows "
                "up from the measured states; check its timestep, masses and contacts, "
                "or shorten --horizon"
            )
        least = known_noise(self.resolution / math.sqrt(12), self.motion)
        starts.noise = better_noise(starts, errors, self.noise, least)
        self.held_out.starts.noise = starts.noise
        self.sticks |= starts.bent > _BENT
        if self.sticks:
            chosen.moved = still
            starts.linearize(x, still)
            starts, errors = starts.as_read, chosen.errors(x[None])[0]
        rms = np.sqrt(np.mean(errors.astype(float) ** 2, (0, 1)))
        chosen.residuals = make_residuals(
            starts, self.lead, _LET_PASS * rms, self.channels.scale
        )
        r = chosen.residuals
        self.fit_gap = r.gap(r.whitened(r.grouped(errors[None]))[0])
        self.fit_floor = chosen.floor = float(np.sqrt(r.floor.mean()))

    def _closed(self, x: np.ndarray) -> bool:
        """Whether nothing is left to explain in the fitting data, whitened at ``x``."""
        starts, moved = self.fit_starts, self.selector.moved
        errors = self.selector.errors(x[None])[0]
        rng, after = np.random.default_rng(1), self.lead + 1
        noise = floor(starts, x, moved, DRAWS, self.resolution, rng)
        square, due = measure.squares(errors[:, after:]), noise[:, after:].mean((0, 1))
        low = openness(square, due, self.channels.scale).low
        return bool(np.nanmax(low) <= _CLOSED)

    def _read_early(self) -> list[str]:
        """Tells which sensors were read before the command of their row was sent, by
        what the model as given predicts; a note on them."""
        p, starts, nv = self.predictor, self.fit_starts, self.m.nv
        if not p.sensors:
            return []
        found = []
        for early in (False, True):
            p.early[:] = early
            _, errors = starts.solve(p.neutral, self.selector.moved)
            found.append(errors[:, self.lead + 1 :, nv:] / self.noise[nv:])
        names = read_at_end(p.sensors, *found)
        p.early[:] = [n.sensor in names for n in p.sensors]
        if not names:
            return []
        return [
            f"sensors read before the command of their row was sent: "
            f"{', '.join(names)}; compared as such"
        ]

    def _moves_in_the_model(self) -> bool:
        """Takes channels in that stand still in the log, but not in the model, and
        sensors whose noise turns out to be small enough for what they read."""
        noise = self.noise.copy()
        noise[self.m.nv :] = self.fit_starts.noise[self.m.nv :]
        errors = self.selector.errors(self.predictor.neutral[None])[0].astype(float)
        moved = errors[:, -1] - errors[:, self.lead]
        changed = measure.with_moving(self.channels, moved, noise)
        more = changed is not self.channels
        self.channels = self.held_out.channels = changed
        return more

    def watch_steps(self) -> None:
        """Lets fits see what the model's own steps do, where that can be seen.

        Data of a machine have no such error and those of a simulation of the same step
        have all of it, so its share is fitted like the model's own parameters. Where
        feet stick and slip, the error is another from each start, and no share helps.
        """
        if self.sticks:
            return
        windows, count = self.predictor.windows, len(self.fit_windows)
        error = error_of_steps(self.m, windows, self.predictor.simulator.dt)
        # What sensors read of it is not told apart.
        error = np.pad(error, [(0, 0), (0, 0), (0, len(self.sensors))])
        mine = self.fit_starts.left(error[:count])[:, self.lead + 1 :]
        mine = measure.squares(mine).mean(0)
        size = float(measure.gap(mine, self.channels.scale))
        if size < _STEPS_SEEN * self.fit_floor:
            return
        first = len(self.fit_blocks) * BLOCK
        self.selector.steps, self.held_out.steps = error[:count], error[first:]
        b = self.bounds
        self.selector.bounds = Bounds(
            np.r_[b.low, 0.0], np.r_[b.high, _WHOLE], np.r_[b.size, 0.1]
        )
        self.tell(
            f"the model's physics step of {1000 * self.step:.3g} ms makes an error of "
            f"{size / self.fit_floor:.2g} times the noise, which is not held against it"
        )

    def refit(self, own: Sequence[int]) -> Model:
        """The model as given, whitened there, with some of its own parameters
        refitted."""
        self.selector.own = tuple(own)
        model = self.selector.fit([], self.selector.neutral)
        if own:
            self.whiten(model.fit.x)
            self.selector.weight = window_weights(model.fit.residual)
            model = self.selector.fit([], model.fit.x)
        return model

    def candidates(self, taken: Sequence[Place]) -> list[Candidate]:
        """Every place that is not in the model yet, with its starts."""
        keys = {p.key for p in taken}
        return [
            Candidate(p, s)
            for p in (*self.places, *self.ripples)
            if p.key not in keys and p.key not in self.dropped
            for s in p.starts[: 1 if p.row.is_sine else None]
        ]

    def disagreeing(
        self, x: np.ndarray, kept: Figures, floor: float
    ) -> dict[str, float]:
        """Recordings whose windows are predicted far worse than the others', by how
        much.

        ``kept``: the held-out figures at ``x``; ``floor``: the gap of a perfect model.
        """
        moved = self.selector.moved
        fitted = self.fit_starts.fit(x[None], moved[None])[1][0, :, self.lead + 1 :]
        fitted, _ = measure.finite(fitted, self.predictor.largest)
        square = np.concatenate([measure.squares(fitted), kept.square])
        names = list(dict.fromkeys(run.recording for run in self.runs))
        of = np.array([names.index(run.recording) for run in self.runs])
        run = of[np.concatenate([self.fit_windows.run, self.held_out.windows.run])]
        scale = self.channels.scale
        if len(np.unique(run)) == 2:
            odd = measure.odd_of_two(square, scale, run, floor)
        else:
            odd = measure.odd_runs(square, scale, run)
        return {names[r]: ratio for r, ratio in odd.items()}

    # -- the whole -------------------------------------------------------------

    def run(self) -> Outcome:
        """Finds, names and measures."""
        began = time.perf_counter()
        own = list(range(self.space.size))
        self.tell("compiling the predictions ...")
        notes = self._read_early()
        self.whiten(self.predictor.neutral)
        if self._moves_in_the_model():
            self.whiten(self.predictor.neutral)
        self.watch_steps()
        self.tell(
            f"gap {self.fit_gap:.3g} on the fitting data, noise floor "
            f"{self.fit_floor:.2g}"
        )
        base = self.refit(own)
        stuck = self._stuck(base)
        if stuck:
            base = self._undone(base, stuck)
        model = self.select(base)
        for _ in own:
            stuck = self._stuck(model)
            if not stuck:
                break
            base = self._undone(base, stuck)
            x = model.fit.x.copy()
            x[stuck] = self.selector.neutral[stuck]
            model = self.select(self.selector.fit(model.places, x))
        model, rivals = self.exchanged(model)
        for _ in range(_MOST):
            needless = self._needless(model)
            if not needless:
                break
            for place, why in needless:
                self.tell(f"- {place.key}: {why}")
            brief = [p for p, _ in needless if self._brief(model, p)]
            notes += [self._of_a_step(p) for p in brief]
            self.dropped |= {p.key for p in brief}
            model = self._rid_of(model, [p for p, _ in needless])
            model, rivals = self.exchanged(model)
        model, rivals = self._apart(model, rivals)
        return self.measured(base, model, rivals, began, notes)

    def _singles(self, place: Place) -> list[Place]:
        """Of each actuator what a shared effect is of all."""
        return [
            p
            for p in self.everywhere
            if (p.effect, p.kind) == (place.effect, "actuator")
        ]

    def _apart(
        self, model: Model, rivals: dict[str, list[Model]]
    ) -> tuple[Model, dict[str, list[Model]]]:
        """The model with what each actuator has in place of what all have, where one of
        them differs."""
        named = {p.key for p in model.places}
        for place in [p for p in model.places if p.shared]:
            singles = self._singles(place)
            new = [p for p in singles if p.key not in named]
            if len(new) == len(singles):
                continue
            x = self._each(model.fit.x, place, singles)
            order = [q for p in model.places for q in (new if p is place else [p])]
            model = self.selector.fit(order, x)
            rivals = rivals | {p.key: rivals[place.key] for p in new}
        return model, rivals

    def _each(
        self, x: np.ndarray, place: Place, singles: Sequence[Place]
    ) -> np.ndarray:
        """A vector in which these actuators have by themselves what all had."""
        out, columns = x.copy(), self.selector.columns
        shared = columns(place)
        out[shared] = self.selector.neutral[shared]
        for single in singles:
            out[columns(single)] += x[shared] - out[shared]
        return out

    def _parts(self, x: np.ndarray, place: Place, whole: Figures) -> tuple[Part, ...]:
        """The actuators that a shared effect is seen at: without it at one of them the
        held-out data are predicted worse. What moves them most comes first.

        Args:
            x: vector with the effect.
            whole: its figures.
        """
        singles = self._singles(place)
        without = [[p for p in singles if p is not one] for one in singles]
        squares = self._squares([self._each(x, place, kept) for kept in without])
        (mine,) = self._squares([x])
        scale = self.channels.scale
        order = np.argsort(-np.asarray(measure.gap(squares.mean(1), scale)))
        seen = [singles[i] for i in order if not self._as_good(mine, squares[i])]
        seen = seen or [singles[i] for i in order]
        some = [self._each(x, place, seen[:k]) for k in range(1, len(seen))]
        gaps = [float(measure.gap(s.mean(0), scale)) for s in self._squares(some)]
        return tuple(map(Part, seen, [*gaps, whole.gap]))

    def _squares(self, vectors: Sequence[np.ndarray]) -> np.ndarray:
        """Mean squares of each held-out window, ``(B, W, c)``."""
        return self.held_out.squares(np.array([self._plain(x) for x in vectors]))

    def _needless(self, model: Model) -> list[tuple[Place, str]]:
        """Effects that were found and say nothing of the machine, with the reason."""
        out = []
        for place in model.places:
            if self._idle(model, place):
                out.append((place, "fitted to nothing"))
            elif self._brief(model, place):
                out.append((place, "less than a physics step"))
        return out

    def _brief(self, model: Model, place: Place) -> bool:
        return within_a_step(
            place,
            float(model.fit.x[self.selector.columns(place, fitted=False)[0]]),
            self.step,
        )

    def _of_a_step(self, place: Place) -> str:
        return (
            f"{place.key}: what looked like it is shorter than the model's physics "
            f"step of {1000 * self.step:.3g} ms, which shifts commands by half of "
            "itself; not named. With a smaller timestep in the model the data could "
            "tell."
        )

    def _idle(self, model: Model, place: Place) -> bool:
        """Whether an effect was fitted to nothing: predictions are as without it."""
        kept = [p for p in model.places if p is not place]
        x = self.selector.without(model.fit.x, place, kept)
        both = self.selector.errors(np.stack([model.fit.x, x]))
        mine, other = both.astype(float)
        return float(np.abs(mine - other).max()) < _NOTHING * np.abs(mine).max()

    def _rid_of(self, model: Model, idle: Sequence[Place]) -> Model:
        kept = [p for p in model.places if p not in idle]
        x = model.fit.x
        for place in idle:
            x = self.selector.without(x, place, kept)
        self.whiten(x)
        return self.selector.fit(kept, x)

    def _stuck(self, model: Model) -> list[int]:
        """The model's own parameters that a refit moved to a bound."""
        codes = model.fit.codes(self.selector.bounds)
        stuck = model.fit.active[codes == AT_BOUND]
        return [i for i in model.own if i in stuck]

    def _undone(self, base: Model, stuck: Sequence[int]) -> Model:
        """A refit without some parameters, which are offered as effects instead."""
        names = ", ".join(self.space.names[i] for i in stuck)
        self.tell(f"{names}: refitted to a bound, so undone")
        for i in stuck:
            self._offer(self.space.parameters[i].addresses)
        self.whiten(self.selector.neutral)
        return self.refit([i for i in base.own if i not in stuck])

    def _offer(self, addresses: Sequence[str]) -> None:
        for address in addresses:
            self.places += [p for p in self.everywhere if does(p, address, self.m)]

    def select(self, start: Model) -> Model:
        """Adds effects while they help.

        The few best sets of effects go on side by side: two effects together may be
        what one alone, and wrong, does nearly as well.
        """
        chosen, model, beam = self.selector, start, [start]
        for _ in range(_STAGES):
            if len(model.places) >= _MOST:
                break
            self.whiten(model.fit.x)
            chosen.weight = window_weights(
                chosen.fit(model.places, model.fit.x).fit.residual
            )
            model = chosen.fit(model.places, model.fit.x)
            if self._closed(model.fit.x):
                break
            found: dict[frozenset[str], Model] = {}
            # What was taken out of the best may still be in the others.
            beam = [b for b in beam if len(b.places) <= len(model.places)]
            most = _LIKELY if self.predictor.simulator.wide else None
            likely: set[str] = set()  # to be tried beside all sets but the first
            for parent in beam:
                if parent is not beam[0]:
                    parent = chosen.fit(parent.places, parent.fit.x)
                more = [
                    c
                    for c in self.candidates(parent.places)
                    if not likely or c.place.key in likely
                ]
                models, names = chosen.expanded(parent, more)
                likely = likely or {*names[:most], *(p.key for p in model.places)}
                for m in models:
                    key = _keys(m)
                    if key not in found or m.loss.mean() < found[key].loss.mean():
                        found[key] = m
            tried = sorted(found.values(), key=rank)
            for m in tried[:4]:
                self.tell(f"  {_named(m)} (without {_figures(model)})")
            good = [m for m in tried if better(m, model, chosen.floor)]
            if not good:
                break
            best = simplest(good, model)
            self.tell(f"+ {' + '.join(p.key for p in best.places)}")
            beam = [best, *[m for m in good if m is not best][: _BEAM - 1]]
            model = best
            if len(model.places) > 1:
                self.whiten(model.fit.x)
                model = chosen.needed(chosen.fit(model.places, model.fit.x))
                beam[0] = model
        if model.places:
            self.whiten(model.fit.x)
            model = chosen.fit(model.places, model.fit.x)
            model = chosen.richer(model, self.candidates(model.places))
        return model

    def rivals(self, model: Model, place: Place) -> list[Model]:
        """Other names refitted in the place of one effect, best first."""
        chosen = self.selector
        kept = [p for p in model.places if p is not place]
        x = chosen.without(model.fit.x, place, kept)
        without = chosen.fit(kept, x)
        others = [c for c in self.candidates(model.places) if c.place.key != place.key]
        short = shortlist(chosen.screened(without, others))
        out = chosen.fitted(kept, without.fit.x, short)
        return sorted(out, key=lambda m: m.loss.mean())

    def exchanged(self, model: Model) -> tuple[Model, dict[str, list[Model]]]:
        """The model with effects replaced by what does better in their place, and the
        rivals of each effect, best first.

        What was the best alone may not be the best beside what came later.
        """
        seen = {_keys(model)}
        while True:
            rivals = {p.key: self.rivals(model, p) for p in model.places}
            swaps = []
            for place in model.places:
                mine = _last(model, place)
                for rival in rivals[place.key][:_RIVALS]:
                    p = probability(mine, rival)
                    most = 1 + HELPS
                    if _body_for_joint(place, rival.places[-1]):
                        # Its three numbers do what one does, where there is one joint.
                        most = 1 / most
                    close = rank(rival) <= most * rank(mine)
                    if p < _UNLIKELY and close and _keys(rival) not in seen:
                        swaps.append((p, place, rival))
            if not swaps:
                return model, rivals
            _, place, rival = min(swaps, key=lambda swap: swap[0])
            new = rival.places[-1]
            order = [new if p is place else p for p in model.places]
            self.tell(f"{place.key} -> {new.key}: {_figures(rival)}")
            self.whiten(rival.fit.x)
            model = self.selector.fit(order, rival.fit.x)
            seen.add(_keys(model))

    def measured(
        self,
        base: Model,
        model: Model,
        rivals: Mapping[str, Sequence[Model]],
        began: float,
        notes: Sequence[str] = (),
    ) -> Outcome:
        """What the held-out data say of the refit, and of the effects that joined."""
        notes, scale = list(notes), self.channels.scale
        before = self.held_out.look(self.predictor.neutral)
        refit = after = self.held_out.look(self._plain(base.fit.x))
        noise = self.held_out.floor(self._plain(base.fit.x))
        open_refit = open_after = openness(refit.square, noise, scale)
        found: list[Found] = []
        undone = surely_better(before.square, refit.square, scale)
        given = openness(before.square, noise, scale)
        # What only makes up for a refit that went wrong is nothing that is missing.
        fine = undone and not given.is_open.any()
        if model.places:
            after = self.held_out.look(self._plain(model.fit.x))
            noise = self.held_out.floor(self._plain(model.fit.x))
            # With one noise that all tell: the refit beside the better floor.
            open_refit = openness(refit.square, noise, scale)
            open_after = openness(after.square, noise, scale)
            least = before if undone else refit
            if not fine and surely_better(after.square, least.square, scale):
                found = self._found(base, model, rivals, after, noise)
            else:
                notes.append(_not_named(model, fine))
        if undone and not found:
            notes.append(
                "refitted to the fitting data, the model's own parameters predict the "
                "held-out data worse than as given, so they are left as given"
            )
            base = self.refit([])
        if not found and (undone or model.places):
            # Also of the noise nothing is kept that they made of it.
            self.whiten(base.fit.x)
            refit = after = self.held_out.look(self._plain(base.fit.x))
            noise = self.held_out.floor(self._plain(base.fit.x))
            open_refit = open_after = openness(refit.square, noise, scale)
        last = model if found else base
        share = self._share(last.fit.x)
        fair = self.held_out.figures(self._plain(last.fit.x), share).gap
        if fair < _TOLD * after.gap:
            notes.append(
                f"the model's physics step of {1000 * self.step:.3g} ms makes much of "
                f"the gap itself: {after.gap:.3g} would be {fair:.3g} without "
                "its error; a smaller timestep in the model takes it away"
            )
        x, floor_gap = self._plain(last.fit.x), float(measure.gap(noise, scale))
        return Outcome(
            verdict=verdict_of(bool(found), open_refit, open_after),
            found=found,
            refitted=Numbers(self.selector, last).refitted(self.space),
            before=before,
            refit=refit,
            after=after,
            floor=floor_gap,
            floor_si=np.sqrt(noise),
            floor_is_bound=self.noise_is_bound & (self.fit_starts.noise >= self.noise),
            open_refit=open_refit,
            open_after=open_after,
            channels=self.channels,
            held=self.held_out.windows,
            x=x,
            active=[i for i in model.fit.active.tolist() if i < len(x)],
            notes=notes,
            disagreeing=self.disagreeing(x, after, floor_gap),
            seconds=time.perf_counter() - began,
            horizon=(self.predictor.steps - self.lead) * self.runs[0].dt,
            start=self.lead * self.runs[0].dt,
        )

    def _share(self, x: np.ndarray) -> float:
        """Of the own steps' error, as a fit has it."""
        return float(sum(x[len(self.predictor.neutral) :]))

    def _found(
        self,
        base: Model,
        model: Model,
        rivals: Mapping[str, Sequence[Model]],
        after: Figures,
        noise: np.ndarray,
    ) -> list[Found]:
        """What is told of each effect, judged without the error of own steps."""
        scale, x = self.channels.scale, model.fit.x
        floor_gap = float(measure.gap(noise, scale))
        numbers = Numbers(self.selector, model)
        whole = self.held_out.figures(self._plain(x), self._share(x))
        gap = self.held_out.figures(
            self._plain(base.fit.x), self._share(base.fit.x)
        ).gap  # that the effects before it leave
        found = []
        for k, place in enumerate(model.places):
            part = model.places[: k + 1]
            if k + 1 == len(model.places):
                x, figures, left = model.fit.x, after, whole
            else:
                x = model.fit.x
                for other in model.places[k + 1 :]:
                    x = self.selector.without(x, other, part)
                x = self.selector.fit(part, x).fit.x
                figures = self.held_out.figures(self._plain(x))
                left = self.held_out.figures(self._plain(x), self._share(x))
            odds, same = self._odds(_last(model, place), rivals[place.key], whole)
            parts = self._parts(x, place, figures) if place.shared else ()
            mine = {place.key, *(p.place.key for p in parts)}
            found.append(
                Found(
                    place,
                    numbers.values(place),
                    explained(gap, whole.gap, floor_gap) / (1.0 + odds),
                    [k for k in dict.fromkeys(p.key for p in same) if k not in mine],
                    figures.gap,
                    numbers.fitted(place),
                    numbers.deviations(place),
                    parts,
                )
            )
            gap = left.gap
        return found

    def _odds(
        self, mine: Model, rivals: Sequence[Model], whole: Figures
    ) -> tuple[float, list[Place]]:
        """Odds of an effect's rivals, and those that predict held-out data as well."""
        odds, same = 0.0, []
        for rival in rivals[:_RIVALS]:
            p = probability(mine, rival)
            odds += (1 - p) / max(p, 1e-6)
            x = rival.fit.x
            theirs = self.held_out.figures(self._plain(x), self._share(x))
            if self._as_good(whole.square, theirs.square):
                other = rival.places[-1]
                same += self._singles(other) if other.shared else [other]
        return odds, same

    def _as_good(self, mine: np.ndarray, theirs: np.ndarray) -> bool:
        """Whether the difference of two held-out gaps may be none, or is in favor;
        from mean squares of each window, ``(W, c)``."""
        scale = self.channels.scale
        weights = measure.resampled(len(mine), 1)
        d = measure.gap(weights @ theirs, scale) - measure.gap(weights @ mine, scale)
        # Twins differ by rounding alone.
        gap = measure.gap(mine.mean(0), scale)
        return bool(np.quantile(d, 0.025) <= _ROUNDING * gap)


def _body_for_joint(old: Place, new: Place) -> bool:
    """Whether one effect would move from a joint to a body."""
    return old.effect == new.effect and (old.kind, new.kind) == ("joint", "body")


def _keys(model: Model) -> frozenset[str]:
    return frozenset(p.key for p in model.places)


def _last(model: Model, place: Place) -> Model:
    """The model with one of its effects as the last."""
    return replace(model, places=[*[p for p in model.places if p is not place], place])


def _not_named(model: Model, fine: bool) -> str:
    """A note on effects of which the held-out data show nothing; ``fine``: nor that
    anything is missing."""
    names = ", ".join(p.key for p in model.places)
    why = (
        "the model as given predicts the held-out data as well as a perfect one"
        if fine
        else "the held-out data are predicted no better with it"
    )
    return (
        f"{names}: seen in the fitting data, but {why}, so it is not named; the "
        "recordings differ, or are too few"
    )


def _figures(model: Model) -> str:
    return f"loss {model.loss.mean():.4g}, gap {model.gap.mean() ** 0.5:.3g}"


def _named(model: Model) -> str:
    return f"{' + '.join(p.key for p in model.places)}: {_figures(model)}"

"""From runs and a model to named effects: the whole workflow, without files.

    windows → refit of the model's own parameters → selection → rivals → figures

Held-out windows take part in none but the last, and the horizon that figures are
reported at in nothing else.
"""

import copy
import itertools
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run, physics_steps
from easi_jax.data.scales import scales_of
from easi_jax.data.sensor_channels import (
    NO_SENSORS,
    Sensors,
    measured_sensors,
    read_at_end,
)
from easi_jax.data.windows import lead_rows, window_rows, window_steps
from easi_jax.errors import UserError
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.batched_least_squares import bounds_of
from easi_jax.gap.discretization_error import FINER
from easi_jax.gap.effect_search import RIVALS, EffectSearch, Places
from easi_jax.gap.effect_set import Model
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.fitting import STEPS_SEEN, Fitting, steps_error
from easi_jax.gap.held_out import HeldOut
from easi_jax.gap.law_search import LawSearch, Proposed
from easi_jax.gap.predictor import BLOCK, Predictor
from easi_jax.gap.recorded import recorded, with_speeds
from easi_jax.gap.result import Outcome, last_figures
from easi_jax.gap.statements import stated
from easi_jax.gap.window_set import WindowSet, join, reach, spread, window_set
from easi_jax.gap.window_starts import window_starts
from easi_jax.io.runs.step_cache import Journal, key_of
from easi_jax.model.found_laws import add_law
from easi_jax.model.parameters import ParameterSpace
from easi_jax.progress import Progress, Tell, Wait, at_once, silent
from easi_jax.simulation.engine import Engine
from easi_jax.simulation.logged import Logged

# Windows that fits see [s]: the first part of the second alone, the second, and longer.
_SHORT, _MIDDLE, _LONG = 0.05, 0.2, 1.0
_FITTED = (32, 96)  # windows of one length that fits see
_LONGEST = 10  # windows at least, of the longest
_STEPS = 9_600  # physics steps in them

_NO_LAWS = (
    "no law beyond the table was looked for: feet stick and slip, where errors are not "
    "linear in a force"
)


@dataclass(frozen=True)
class Chosen:
    """Effects that fitting data show.

    Attributes:
        base: the model without them.
        model: with them.
        rivals: of each, best first.
        notes: on what was left out.
    """

    base: Model
    model: Model
    rivals: Mapping[str, Sequence[Model]]
    notes: list[str]

    @property
    def names(self) -> set[str]:
        """Keys of the effects and of their rivals that are followed up."""
        others = (m for each in self.rivals.values() for m in each[:RIVALS])
        return {p.key for p in self.model.places} | {m.places[-1].key for m in others}


class Analysis:
    """One model and its data, ready to be asked.

    Attributes:
        final: after `run`, the analysis that its outcome is of: this one, or one that
            knows the laws that were found.

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
        only: Collection[str] | None = None,
    ) -> None:
        """``only``: keys of the effects that are offered; None: all of the catalog."""
        self.m, self.space, self.tell = mj_model, space, tell
        self._given = mj_model, space, fit, held, noise, horizon, tell
        self._more = {"fixed": fixed, "progress": progress, "wait": wait}
        self.final = self
        self.fixed, self._progress = dict(fixed or {}), progress
        given = mj_model, fit, held, np.asarray(noise)
        fit, held, noise, self._notes = with_speeds(*given)
        dt, runs = fit[0].dt, [*fit, *held]
        scales = scales_of(mj_model, fit)
        sensors, self._ignored = measured_sensors(mj_model, runs, fit)
        self.places = Places(mj_model, space, scales, only)
        shown = [*self.places.everywhere, *self.places.ripples]
        layout = Layout(mj_model, shown)
        self.bounds = bounds_of(space, layout)
        self._windows = cut = WindowsOf(mj_model, scales.longest, sensors)
        reported, kept = cut.some(fit, horizon), cut.all(held, horizon, len(fit))
        if reported is None or kept is None:
            what = "to fit" if reported is None else "held out"
            raise UserError(
                f"no run {what} is longer than a horizon of {horizon:g} s and the "
                f"{lead_rows(dt) * dt:.3g} s before it: record more, or shorten "
                "--horizon"
            )
        seen, every = filled(reported), self._cut(cut, fit)
        self.predictor = Predictor(
            mj_model,
            space,
            layout,
            join([seen, kept]),
            dt,
            fixed,
            Logged.of(runs),
            wait,
            sensors,
            speeds=len(noise) > mj_model.nv,
            length=max(every, default=0),
        )
        self.data = recorded(
            mj_model,
            fit,
            held,
            scales,
            self.bounds,
            self.predictor.sensors,
            noise,
            lead_rows(dt),
        )
        self.step = dt / self.predictor.simulator.substeps
        steps = self.predictor.steps
        self.reported = self._fitting(self.predictor, reported, steps)
        lengths = self._lengths(every)
        middle = window_steps(dt, _MIDDLE) + self.data.lead
        settles = max(
            (k for k, f in enumerate(lengths) if f.steps <= middle), default=0
        )
        self.search = EffectSearch(lengths, settles, self.places, tell)
        channels = self.reported.channels
        first = len(seen) // BLOCK
        self.held_out = self._held_out(kept, self.predictor, first, channels)

    def _fitting(self, predictor: Predictor, windows: WindowSet, steps: int) -> Fitting:
        given = self.data, predictor, windows, steps
        return Fitting(*given, self._ignored, self._progress)

    def _cut(self, cut: "WindowsOf", fit: Sequence[Run]) -> dict[int, WindowSet]:
        """Windows that fits see, by their length; of the lengths that no run has
        windows of, none."""
        found = {}
        for seconds, few in ((_MIDDLE, _FITTED[0]), (_LONG, _LONGEST)):
            windows = cut.some(fit, seconds, few)
            if windows is not None:
                found[windows.ctrl.shape[1]] = windows
        return found

    def _lengths(self, cut: Mapping[int, WindowSet]) -> list[Fitting]:
        """Fits of all lengths, the shortest first."""
        data, reported, found = self.data, self.reported.steps, {}
        for steps, windows in cut.items():
            if steps == reported:
                found[steps] = self.reported
            elif self._moves(steps):
                predictor = self.predictor.on(filled(windows))
                found[steps] = self._fitting(predictor, windows, steps)
        if not found:
            return [self.reported]
        first = found[min(found)]
        least = window_steps(data.dt, _SHORT) + data.lead
        if least < first.steps and self._moves(least):
            given = first.predictor, first.windows, least
            found[least] = self._fitting(*given)
        return [found[steps] for steps in sorted(found)]

    def _moves(self, steps: int) -> bool:
        """Whether some channel moves by more than its noise in windows of so many
        steps."""
        data, compared = self.data, self.reported.starts.compared
        given = data.m, data.fit, data.noise[:compared], steps - data.lead, data.sensors
        return bool(np.isfinite(measure.channels(*given).scale).any())

    def _held_out(
        self, kept: WindowSet, p: Predictor, first: int, channels: measure.Channels
    ) -> HeldOut:
        """Held-out windows, from one block of a predictor's on."""
        data = self.data
        blocks = np.arange(first, p.blocks)
        given = self.m, p, data.fit, data.scales, data.noise, blocks, len(kept)
        return HeldOut(
            *(self.m, data.runs, p, kept, channels),
            *(window_starts(*given), data.lead, data.resolution),
        )

    @property
    def _fitted(self) -> list[Fitting]:
        """Windows of all lengths, each once."""
        return list(dict.fromkeys([self.reported, *self.search.lengths]))

    @property
    def journal(self) -> Journal:
        """What keeps results of long steps."""
        return self.reported.selector.journal

    @journal.setter
    def journal(self, journal: Journal) -> None:
        for f in self._fitted:
            f.selector.journal = journal

    @property
    def key(self) -> str:
        """A digest of all that the results depend on, for a `Journal`."""
        sensors = self.data.sensors
        logs = [
            (run.qpos, run.qvel, run.ctrl, run.time, sensors.read(run))
            for run in self.data.runs
        ]
        windows = [f.windows for f in self._fitted]
        model = np.zeros(mujoco.mj_sizeModel(self.m), np.uint8)
        mujoco.mj_saveModel(self.m, None, model)
        return key_of(
            model,
            self.fixed,
            *(repr(p) for p in self.space.parameters),
            *itertools.chain(*logs),
            *(at for w in (*windows, self.held_out.windows) for at in (w.run, w.row)),
            self.data.noise,
            self.predictor.simulator.dt,
            *(f.steps for f in self._fitted),
            self.predictor.devices,
        )

    def _read_early(self) -> list[str]:
        """Tells which sensors were read before the command of their row was sent, by
        what the model as given predicts; a note on them."""
        p, at, nv = self.predictor, self.reported, self.m.nv
        if not p.sensors:
            return []
        sensed = slice(nv, nv + len(p.sensors))
        found = []
        for early in (False, True):
            p.early[:] = early
            _, errors = at.starts.solve(p.neutral, at.moved)
            after = errors[:, at.data.lead + 1 :, sensed] / at.data.noise[sensed]
            if at.starts.read is not None:
                there = at.starts.read[:, at.data.lead + 1 :, sensed]
                after = np.where(there > 0, after, np.nan)
            found.append(after)
        names = read_at_end(p.sensors, *found)
        p.early[:] = [n.sensor in names for n in p.sensors]
        if not names:
            return []
        return [
            f"sensors read before the command of their row was sent: "
            f"{', '.join(names)}; compared as such"
        ]

    def disagreeing(self, outcome: Outcome) -> dict[str, float]:
        """Recordings whose windows are predicted far worse than the others', by how
        much."""
        at, runs, kept = self.reported, self.data.runs, last_figures(outcome)
        fitted = at.starts.solve(outcome.x, at.moved)[1]
        fitted = at.starts.counted(fitted, self.data.lead + 1)
        fitted, _ = measure.finite(fitted, self.predictor.largest)
        square = np.concatenate([measure.squares(fitted), kept.square])
        names = list(dict.fromkeys(run.recording for run in runs))
        of = np.array([names.index(run.recording) for run in runs])
        run = of[np.concatenate([at.windows.run, self.held_out.windows.run])]
        scale = self.held_out.channels.scale
        odd = measure.odd_runs(square, scale, run, outcome.floor)
        return {names[r]: ratio for r, ratio in odd.items()}

    # -- the whole -------------------------------------------------------------

    def run(self) -> Outcome:
        """Finds, names and measures; `final` is then the analysis that did."""
        began = time.perf_counter()
        self.tell("compiling the predictions ...")
        notes = [*self._notes, *self._read_early()]
        chosen = self._chosen()
        listed = time.perf_counter()
        proposed = proposed_laws(self, chosen.model)
        poorer: Chosen | None = None
        laws: list[str] = []
        if proposed:
            laws = [f"{add_law(p.law, p.sizes)}@{p.law.at}" for p in proposed]
            for p in proposed:
                unit = p.law.unit_of_force(self.m)
                self.tell(f"a law is proposed: {p.law.shown(p.sizes, unit)}")
            # A rival may be right beside a law.
            only = chosen.names | {*laws}
            other = Analysis(*self._given, **self._more, only=only)
            other.journal = self.journal
            other.predictor.early[:] = self.predictor.early
            richer = other._chosen()
            if any(p.key in laws for p in richer.model.places):
                self.final, poorer, chosen = other, chosen, richer
        beyond = time.perf_counter() - listed
        outcome = self.final._stated(chosen)
        if self.search.at.sticks and outcome.verdict == "unexplained":
            notes.append(_NO_LAWS)
        if poorer is not None and any(f.place.key in laws for f in outcome.found):
            x = self.search.at.plain(poorer.model.fit.x)
            gap = self.held_out.look(x).gap
            outcome = replace(outcome, known_effects=gap)
        return replace(
            outcome,
            notes=[*notes, *chosen.notes, *outcome.notes],
            disagreeing=self.final.disagreeing(outcome),
            seconds=time.perf_counter() - began,
            law_seconds=beyond,
        )

    def _chosen(self) -> Chosen:
        """The effects that fitting data show."""
        search = self.search
        at = search.at
        for f in dict.fromkeys([self.reported, at]):
            f.begin(f.neutral)
        self.held_out.channels = self.reported.channels
        if at.own_steps:
            self.tell(
                f"the model's physics step of {1000 * self.step:.3g} ms makes an error "
                f"of {at.own_steps:.2g} times the noise, which is not held against it"
            )
        self.tell(f"gap {at.gap:.3g} on the fitting data, noise floor {at.floor:.2g}")
        own = list(range(self.space.size))
        base = at.refit(own)
        stuck = at.stuck(base)
        if stuck:
            base = self._undone(base, stuck)
        model = search.select(base)
        if search.at.stuck(model):
            # A wrong name moves a parameter to its bound, and a right one back.
            model, _ = search.exchanged(search.at.again(model))
        for _ in own:
            stuck = search.at.stuck(model)
            if not stuck:
                break
            base = self._undone(base, stuck)
            model = search.select(search.beside(base, model))
        if model.places:
            base, model = search.at.again(base), search.at.again(model)
        model, rivals, notes = search.needful(model, self.step)
        return Chosen(base, model, rivals, notes)

    def _stated(self, c: Chosen) -> Outcome:
        """What held-out data say of them."""
        search = self.search
        at = search.at
        if at.own_steps:
            error = steps_error(self.predictor, self.data)
            self.held_out.steps = error[-len(self.held_out.windows) :]
        noises = 0.0
        if at.sticks or len(c.model.fit.active):
            noises = at.doubt_steps(c.model.fit.x, self._finer(at))
        found = c.base, c.model, c.rivals
        windows = self.held_out, self.judges(at)
        outcome = stated(search, *windows, self.space, *found, self.step)
        if not at.sticks or noises < STEPS_SEEN:
            return outcome
        note = (
            f"the model's physics step of {1000 * self.step:.3g} ms makes an error of "
            f"{noises:.2g} times the noise where feet stick and slip, which cannot be "
            "told from what the model lacks: a smaller timestep takes it away"
        )
        return replace(outcome, notes=[*outcome.notes, note])

    def judges(self, at: Fitting) -> HeldOut:
        """Held-out windows as long as those of ``at``; those of the horizon where they
        are, or where no run is that long."""
        data = self.data
        if at.steps == self.predictor.steps:
            return self.held_out
        seconds = (at.steps - data.lead) * data.dt
        held = data.runs[len(data.fit) :]
        windows = self._windows.all(held, seconds, len(data.fit))
        if windows is None:
            return self.held_out
        predictor = at.predictor.on(filled(windows))
        found = self._held_out(windows, predictor, 0, at.channels)
        if at.own_steps:
            found.steps = steps_error(predictor, data)[: len(windows)]
        return found

    def _finer(self, at: Fitting) -> Predictor:
        """Predictions in the windows of ``at``, but of sensors, by native MuJoCo with
        smaller steps."""
        m, windows = copy.copy(self.m), at.predictor.windows
        m.opt.timestep = self.step / FINER
        own = self.predictor.simulator
        engine = own.engine if own.moves_centers else "mujoco"
        return self._predictor(m, windows, engine)

    def native_predictor(self, at: Fitting) -> Predictor:
        """Predictions of the windows of ``at`` by native MuJoCo, without sensors."""
        own = at.predictor
        if own.simulator.engine == "mujoco" and not own.sensors:
            return own
        return self._predictor(self.m, filled(at.windows), "mujoco")

    def of_joints(self, at: Fitting, model: Model) -> tuple[Fitting, Model]:
        """The windows of ``at`` by native MuJoCo without sensors, and a model of them
        fitted there."""
        data, nv = self.data, self.m.nv
        places = np.arange(len(data.noise))
        some = (places < nv) | (places >= nv + len(data.sensors))
        given = {k: getattr(data, k)[some] for k in ("motion", "noise", "resolution")}
        bound = data.noise_is_bound[:nv]
        data = replace(data, **given, noise_is_bound=bound, sensors=NO_SENSORS)
        given = data, self.native_predictor(at), unsensed(at.windows), at.steps
        out = Fitting(*given, {}, self._progress)
        out.selector.weight = at.selector.weight
        return out, out.again(model)

    def _predictor(
        self, m: mujoco.MjModel, windows: WindowSet, engine: Engine
    ) -> Predictor:
        """Predictions by a model like the one that was recorded, without sensors."""
        p, windows = self.predictor, unsensed(windows)
        given = m, self.space, p.layout, windows, self.data.dt, self.fixed
        logged, wait = p.simulator.logged, self._more["wait"]
        return Predictor(*given, logged, wait, engine=engine, speeds=p.speeds)

    def _undone(self, base: Model, stuck: Sequence[int]) -> Model:
        """A refit without some parameters, which are offered as effects instead."""
        names = ", ".join(self.space.names[i] for i in stuck)
        self.tell(f"{names}: refitted to a bound, so undone")
        for i in stuck:
            self.search.offer(self.space.parameters[i].addresses)
        at = self.search.lengths[self.search.settles]
        at.whiten(at.neutral)
        return at.refit([i for i in base.own if i not in stuck])


def proposed_laws(analysis: Analysis, model: Model) -> list[Proposed]:
    """Laws for what a model leaves open in the fitting data.

    By joints alone where sensors are compared, whose readings are not linearized; none
    where feet stick and slip.
    """
    at = analysis.search.at
    if at.sticks or at.closed_by(model):
        return []
    if at.predictor.sensors:
        if not np.isfinite(at.channels.scale[: analysis.m.nv]).any():
            return []  # no joint moves
        at, model = analysis.of_joints(at, model)
    else:
        model = at.selector.fit(model.places, model.fit.x)
    return LawSearch(at, model, analysis.native_predictor(at)).proposed()


def filled(windows: WindowSet) -> WindowSet:
    """With the last one repeated until they are whole blocks."""
    last = len(windows) - 1
    return windows.take(np.r_[: last + 1, np.full(-(last + 1) % BLOCK, last)])


def unsensed(windows: WindowSet) -> WindowSet:
    """Without readings of sensors."""
    none = {k: getattr(windows, k)[..., :0] for k in ("sensed", "known")}
    return replace(windows, **none)


@dataclass(frozen=True)
class WindowsOf:
    """Cuts the runs of a model into windows.

    Attributes:
        m: that was recorded.
        longest: delay of commands and readings that predictions allow for [s].
        sensors: whose readings all runs have.
    """

    m: mujoco.MjModel
    longest: float
    sensors: Sensors

    def all(
        self, runs: Sequence[Run], seconds: float, first: int = 0
    ) -> WindowSet | None:
        """All windows of a length; None where no run is that long."""
        return window_set(self.m, runs, seconds, self.longest, first, self.sensors)

    def some(
        self, runs: Sequence[Run], seconds: float, least: int = _FITTED[0]
    ) -> WindowSet | None:
        """As many windows of a length as fits see; None where no run is that long."""
        lead = lead_rows(runs[0].dt)
        every = [window_rows(run, seconds, lead=lead) for run in runs]
        begin = np.concatenate(every)
        of = np.repeat(np.arange(len(runs)), [len(rows) for rows in every])
        if not len(begin):
            return None
        rows = window_steps(runs[0].dt, seconds) + lead
        steps = rows * physics_steps(runs[0].dt, self.m.opt.timestep)
        most = min(max(_STEPS // steps, least), _FITTED[1])
        few = spread(most, reach(self.m, runs, every, rows))
        chosen = [begin[few[of[few] == i]] for i in range(len(runs))]
        given = self.m, runs, seconds, self.longest, 0, self.sensors
        return window_set(*given, chosen)

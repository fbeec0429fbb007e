"""Windows of one length, to which sets of effects are fitted."""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from easi_jax.errors import UserError
from easi_jax.estimation.least_squares import AT_BOUND
from easi_jax.estimation.starts import floor, known_noise
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.batched_least_squares import Bounds, difference, window_weights
from easi_jax.gap.decisions import BLOCKS, DECIDE
from easi_jax.gap.discretization_error import error_of_steps
from easi_jax.gap.effect_set import Model
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.recorded import Recorded
from easi_jax.gap.table import Place
from easi_jax.gap.verdict import Openness, openness
from easi_jax.gap.whitening import make_residuals
from easi_jax.gap.window_set import WindowSet
from easi_jax.gap.window_starts import window_starts
from easi_jax.progress import Progress, silent

_DRAWS = 5  # of the noise of each window: its mean over all of them is wanted
_PAIRS = 5  # of draws, likewise, whose slopes are taken
STEPS_SEEN = 0.75  # of the floor: less is lost in noise
_WHOLE = 1.15  # of the error of steps; a finer simulation leaves some of it
_BENT = 0.1  # second beside first differences of errors with a start: not linear
_LET_PASS = 0.05  # of what the model errs by, that no fit hangs on


class Fitting:
    """Windows of one length, to which sets of effects are fitted.

    Args:
        data: the model and its recordings.
        predictor: of the windows, in its first blocks.
        windows: without fillers.
        steps: control steps of a window that are compared, those before its start
            counted; the predictor's may be more.
        ignored: channels that nothing can be compared of, with the reason.
        progress: told how far long stages are.

    Attributes:
        selector: fits sets of effects.
        starts: of the windows.
        channels: that are compared.
        gap, floor: of the windows where they were last whitened.
        own_steps: error of the model's own steps, in floors; 0 where it does not show.
        unseen_steps: of predictions ``(W, T, c)``, that does not show but may move what
            is fitted; None where there is none.

    Raises:
        UserError: nothing moves.
    """

    def __init__(
        self,
        data: Recorded,
        predictor: Predictor,
        windows: WindowSet,
        steps: int,
        ignored: Mapping[str, str],
        progress: Progress = silent,
    ) -> None:
        self.data, self.predictor, self.windows = data, predictor, windows
        self.steps, count = steps, len(windows)
        group = np.arange(count) * min(BLOCKS, count) // count
        chosen = Selector(predictor, data.bounds, group, progress, steps + 1)
        self.selector = chosen
        given = data.m, predictor, data.fit, data.scales, data.noise
        self.starts = window_starts(*given, chosen.blocks, count, steps + 1)
        self.channels = self._channels(ignored)
        self._begun = False
        self.gap = self.floor = self.own_steps = 0.0
        self.unseen_steps: np.ndarray | None = None

    def _channels(self, ignored: Mapping[str, str]) -> Channels:
        data, after = self.data, self.steps - self.data.lead
        found = measure.channels(
            data.m,
            data.fit,
            data.noise[: self.starts.compared],
            after,
            data.sensors,
        )
        found.ignored.update({**ignored, **self.predictor.unpredicted})
        if not np.isfinite(found.scale).any():
            raise UserError(
                f"none of {', '.join(found.names)} moves by more than five times its "
                f"noise within {after * data.dt:g} s: record larger or faster motion, "
                "or lengthen --horizon"
            )
        return found

    @property
    def sticks(self) -> bool:
        """Whether errors bend with starts: see `whiten`."""
        return self.selector.sticks

    @property
    def neutral(self) -> np.ndarray:
        """The vector of the model as given."""
        return self.selector.neutral

    def plain(self, x: np.ndarray) -> np.ndarray:
        """Vectors without the share of the own steps' error."""
        return x[..., : len(self.predictor.neutral)]

    def share(self, x: np.ndarray) -> float:
        """Of the own steps' error, as a fit has it."""
        return float(sum(x[len(self.predictor.neutral) :]))

    def vector(self, x: np.ndarray) -> np.ndarray:
        """A vector of windows of another length, as one of these."""
        out = self.neutral.copy()
        out[: len(self.predictor.neutral)] = self.plain(x)
        return out

    def whiten(self, x: np.ndarray) -> None:
        """Renews the noise model of the fit at a vector.

        Starts are integrated out about those that are fitted at the vector. Where feet
        stick and slip, errors are not linear in the start over more than its noise, and
        what is fitted for one model is no start for another: there starts are as rows
        tell.

        Raises:
            UserError: most predictions are not finite.
        """
        chosen, starts, data = self.selector, self.starts, self.data
        still = np.zeros_like(chosen.moved)
        chosen.moved, _ = starts.solve(x, still if self.sticks else chosen.moved)
        errors = chosen.errors(x[None])[0]
        if not np.isfinite(errors).all():
            raise UserError(
                "most predictions of the fitting data are not finite: the model blows "
                "up from the measured states; check its timestep, masses and contacts, "
                "or shorten --horizon"
            )
        least = known_noise(data.resolution / math.sqrt(12), data.motion)
        starts.believe(errors, data.noise, least)
        chosen.sticks |= starts.bent > _BENT
        if self.sticks:
            chosen.moved = still
            starts.linearize(x, still)
            starts, errors = starts.as_read(data.m.nv), chosen.errors(x[None])[0]
        rms = np.sqrt(np.mean(errors.astype(float) ** 2, (0, 1)))
        chosen.residuals = make_residuals(
            starts, data.lead, _LET_PASS * rms, self.channels.scale
        )
        r = chosen.residuals
        self.gap = r.gap(r.of(errors[None])[0])
        self.floor = chosen.floor = float(np.sqrt(r.floor.mean()))

    @property
    def noise_as_told(self) -> np.ndarray:
        """Channels whose errors show no less noise than rows alone tell, ``(c,)``
        bool."""
        told = self.starts.noise >= self.data.noise
        return told[: self.starts.compared]

    def closed(self, x: np.ndarray) -> bool:
        """Whether nothing is left to explain, whitened at ``x``."""
        found = self._beside_floor(x, x)
        return float(found.low[found.judged].max()) <= DECIDE.closed

    def misses(self, x: np.ndarray, less: np.ndarray) -> bool:
        """Whether anything is open beside the floor at ``x``, whitened there, under a
        vector ``less`` with starts of its own."""
        return bool(self._beside_floor(x, less).is_open.any())

    def _beside_floor(self, x: np.ndarray, other: np.ndarray) -> Openness:
        """Errors under a vector, with starts of its own, beside the floor at ``x``,
        whitened there."""
        (moved,), _ = self.starts.fit(other[None], self.moved[None])
        errors = self.selector.errors(other[None], None, moved)[0]
        rng, after, moved = np.random.default_rng(1), self.data.lead + 1, self.moved
        noise = floor(self.starts, x, moved, _DRAWS, self.data.resolution, rng)
        square = measure.squares(self.starts.counted(errors, after))
        due = self.starts.mean_square(noise, after)
        return openness(square, due, self.channels.scale)

    def closed_by(self, model: Model) -> bool:
        """Whether a model of these windows leaves nothing to explain."""
        self.whiten(model.fit.x)
        return self.closed(model.fit.x)

    @property
    def moved(self) -> np.ndarray:
        """Offsets of the starts, ``(W, s)``."""
        return self.selector.moved

    def moves_in_the_model(self) -> bool:
        """Takes channels in that stand still in the log, but not in the model, and
        sensors whose noise turns out to be small enough for what they read."""
        nv, channels = self.data.m.nv, self.starts.compared
        noise = self.data.noise[:channels].copy()
        noise[nv:] = self.starts.noise[nv:channels]
        errors = self.selector.errors(self.neutral[None])[0].astype(float)
        errors = errors[..., :channels]
        moved = errors[:, -1] - errors[:, self.data.lead]
        if self.starts.read is not None:
            both = self.starts.read[:, [self.data.lead, -1], :channels].all(1)
            moved = np.where(both, moved, np.nan)
        changed = measure.with_moving(self.channels, moved, noise)
        more = changed is not self.channels
        self.channels = changed
        return more

    def begin(self, x: np.ndarray) -> None:
        """Whitens at a vector without a share, with what is to be compared there."""
        self._begun = True
        self.whiten(x)
        if self.moves_in_the_model():
            self.whiten(x)
        self._watch_steps()

    def _watch_steps(self) -> None:
        """Lets fits see what the model's own steps do, where that can be seen.

        Data of a machine have no such error and those of a simulation of the same step
        have all of it, so its share is fitted like the model's own parameters. Where
        feet stick and slip, the error is another from each start, and no share helps.
        """
        if self.sticks:
            return
        error = steps_error(self.predictor, self.data)
        error = error[: len(self.windows), : self.steps + 1]
        self.unseen_steps = error
        noises = self._noises(error)
        if noises < STEPS_SEEN:
            return
        self.selector.steps, self.unseen_steps = error, None
        b = self.selector.bounds
        self.selector.bounds = Bounds(
            np.r_[b.low, 0.0], np.r_[b.high, _WHOLE], np.r_[b.size, 0.1]
        )
        self.own_steps = noises

    def doubt_steps(self, x: np.ndarray, finer: Predictor) -> float:
        """Lets values of a fit at ``x`` be in doubt by what the model's own steps do
        there, beyond the share of what they do in the model as given; how large that
        is, in units of the floor.

        Args:
            finer: predictions of the same windows with smaller steps, but of sensors.
        """
        chosen, p = self.selector, self.predictor
        given = self.plain(x)[None], chosen.blocks, chosen.moved[None], self.steps + 1
        own, right = (
            each.motion(each.errors(*given)[0, : chosen.count]) for each in (p, finer)
        )
        error, fast = (a.astype(float) - b for a, b in zip(own, right, strict=True))
        turns = 2 * np.pi * np.round(error / (2 * np.pi))
        error = p.whole(error - np.where(p.wrapped, turns, 0.0), fast)
        finite = np.isfinite(error).all((1, 2), keepdims=True)
        error = np.where(finite, error, 0.0)
        if chosen.steps is not None:
            error = self.share(x) * (error - chosen.steps)
        self.unseen_steps = error
        return self._noises(error)

    def pull_of_starts(self, model: Model) -> np.ndarray:
        """What the score of a fit is, typically, where its starts are as read and the
        model is right, by size of a difference of each active entry, ``(a,)``.

        Where feet stick and slip, slopes go with the noise of a start, and what goes
        with the noise of an error does not average out. Drawn in pairs of opposite
        noise, in which all that is linear cancels; the median pair, since slopes are
        steep where something begins to slip.
        """
        chosen, starts, rng = self.selector, self.starts, np.random.default_rng(2)
        f, bounds = model.fit, chosen.bounds
        if not self.sticks or not len(f.active):
            return np.zeros(len(f.active))
        weight = chosen.weight * chosen.rows_once()
        ways, step = difference(f.x, f.active, bounds)
        vectors = np.concatenate([f.x[None], ways])
        true = chosen.errors(f.x[None])[0].astype(float)
        pulls, nv = np.zeros((_PAIRS, len(f.active))), self.data.m.nv
        for pull in pulls:
            off = starts.scatter * rng.normal(size=chosen.moved.shape)
            noise = starts.noises * rng.normal(size=true.shape)
            noise[:, 0, :nv] = off[:, :nv]  # a start is where its row says
            for sign in (1.0, -1.0):
                errors = chosen.errors(vectors, None, chosen.moved + sign * off)
                left = errors - true - sign * noise
                r = chosen.residuals.of(left)
                slope = (r[1:] - r[0]) / step[:, None, None]
                each = np.einsum("w,awm,wm->a", weight, slope, r[0], optimize=True)
                pull += 0.5 * np.nan_to_num(each) * bounds.size[f.active]
        return np.median(pulls, 0)

    def _noises(self, error: np.ndarray) -> float:
        """An error of predictions ``(W, T, c)`` once starts are fitted, in units of the
        floor."""
        mine = self.starts.counted(self.starts.left(error), self.data.lead + 1)
        size = measure.gap(measure.squares(mine).mean(0), self.channels.scale)
        return float(size) / self.floor

    def refit(self, own: Sequence[int]) -> Model:
        """The model as given, whitened there, with some of its own parameters
        refitted."""
        self.selector.own = tuple(own)
        model = self.selector.fit([], self.neutral)
        return self.weighed(model) if own else model

    def weighed(self, model: Model) -> Model:
        """A model of these windows fitted once more, whitened and weighed where it
        is."""
        self.whiten(model.fit.x)
        self.selector.weight = window_weights(
            self.selector.fit(model.places, model.fit.x).fit.residual
        )
        return self.selector.fit(model.places, model.fit.x)

    def again(self, model: Model) -> Model:
        """A model of windows of another length, fitted to these, whitened where it
        was."""
        self.selector.own = model.own
        if self._begun:
            self.whiten(self.vector(model.fit.x))
        else:
            self.begin(self.plain(model.fit.x))
        return self.selector.fit(model.places, self.vector(model.fit.x))

    @contextlib.contextmanager
    def as_before(self) -> Iterator[None]:
        """Afterwards the starts, and whether something sticks, are what they were."""
        chosen = self.selector
        kept = chosen.sticks, chosen.moved
        try:
            yield
        finally:
            chosen.sticks, chosen.moved = kept

    def without(
        self, model: Model, gone: Sequence[Place], possible: bool = True
    ) -> Model:
        """A model of these windows fitted without some of its effects; ``possible`` as
        of `Selector.model`."""
        kept = [p for p in model.places if p not in gone]
        x = model.fit.x
        for place in gone:
            x = self.selector.without(x, place, kept)
        return self.selector.fit(kept, x, possible)

    def stuck(self, model: Model) -> list[int]:
        """The model's own parameters that a refit moved to a bound."""
        codes = model.fit.codes(self.selector.bounds)
        stuck = model.fit.active[codes == AT_BOUND]
        return [i for i in model.own if i in stuck]


def steps_error(predictor: Predictor, data: Recorded) -> np.ndarray:
    """`easi_jax.gap.discretization_error.error_of_steps` of all its windows,
    ``(W, H + 1, c)``; what sensors read of it is not told apart."""
    error = error_of_steps(data.m, predictor.windows, predictor.simulator.dt)
    return predictor.whole(*error)

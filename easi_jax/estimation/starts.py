"""Start states of windows, fitted with the dynamics of the model that predicts.

Nobody measures a start: positions are read with noise, velocities and activations
hardly ever. A window begins some rows before the start that it is measured from, and
its first state is what brings the simulation nearest to the readings within as many
rows on either side of that start, in units of their noise (the log format's "Start of a
window"). So the same estimator serves every model that is compared, and noise pushed
through it says what a perfect model would leave (`floor`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from easi_jax.data.windows import slope_noise, start_rows
from easi_jax.estimation.prediction_error import believed
from easi_jax.model.separate_trees import turns

# Takes vectors (B, n) and offsets of starts (B, W, s); returns errors (B, W, T, c).
Simulate = Callable[[np.ndarray, np.ndarray], np.ndarray]
# The same of so many first rows, T of them.
SimulateRows = Callable[[np.ndarray, np.ndarray, int], np.ndarray]

DRAWS = 20  # of the noise of each window, for a floor, as the log format asks
# A start may be off by so much from what the log says of it: so wide that the rows of
# its window decide. A position, times its noise and its motion; speeds by their motion.
_NOISES, _MOTION = 30.0, 0.03
_DIFFERENCE = 3e-3, 0.03  # of positions and speeds, in units of their motion
_CURVED = 3.0  # times the noise of a local polynomial's speed: with its own error
_FINEST = 1e-6  # of the motion: noise of a log that has none
_ROUNDS = 6  # looks at each start
_SHORTER = 0.3  # times the step of a start that was not improved
_SETTLED = 0.02  # of half the weighted squared error: no step is worth less
_LINEARIZED = 4  # times, at most, that slopes are taken
_WORTH = 0.05  # of half the weighted squared error of a row: worth new slopes
_FAR = 2.0  # times what noise makes of a row: far off
_NEAREST, _NEAR = 4, 3  # rows at least, and what part of them, that are met first
_TOGETHER = 4  # draws of the noise that are simulated at once
_FEW = 0.6  # of a window, at most, that is worth to be simulated alone


@dataclass
class Starts:
    """Starts of W windows whose errors ``simulate`` returns.

    Attributes:
        simulate: errors of vectors and offsets of starts.
        noise: of each channel of the errors, standard deviations ``(c,)``; infinite
            where nothing was measured.
        spread: how far starts may be from offsets of zero, ``(s,)``, so wide that the
            rows of the window decide.
        known: how far they are by the noise of the rows, and what a local polynomial
            errs by, ``(s,)``.
        scatter: how far by that noise alone, ``(s,)``.
        rows: so many first rows of a window decide on its start.
        step: sizes of differences, ``(s,)``.
        read: which readings there are, 1 or 0, ``(W, T, c)``; ``simulate`` returns zero
            for the others. All where None.
        parts: of the machine that each number of a start belongs to, ``(s,)``, the
            first of them those of the channels; all one where None.
        alone: so many channels, the last ones, speak of starts only.
        begins: errors of the first ``rows`` alone, where these are quicker to simulate.
        slope: of errors with the start, ``(s, W, T, c)``, of the last `linearize`.
        bent: how far errors are from linear there, in the median window: the second
            differences beside the first.
    """

    simulate: Simulate
    noise: np.ndarray
    spread: np.ndarray
    rows: int
    step: np.ndarray
    known: np.ndarray
    scatter: np.ndarray
    parts: np.ndarray | None = None
    read: np.ndarray | None = None
    alone: int = 0
    begins: Simulate | None = None
    slope: np.ndarray = field(init=False)
    bent: float = field(init=False, default=0.0)

    def part(self, some: slice) -> "Starts":
        """Of some of the windows, whose errors can no longer be asked for."""
        out = replace(self, read=None if self.read is None else self.read[some])
        out.slope = self.slope[:, some]
        return out

    def as_read(self, positions: int) -> "Starts":
        """These starts, as far off as the noise of their rows says, and no farther.

        So many channels, the first, are positions: a window begins where its first row
        says, which then has no error of its own.
        """
        out = self.part(slice(None))
        out.spread, out.slope = self.known, self.slope.copy()
        out.slope[:, :, 0, :positions] = 0.0
        shape = self.slope.shape[1:]
        out.read = np.ones(shape) if self.read is None else self.read.copy()
        out.read[:, 0, :positions] = 0.0
        return out

    def linearize(self, x: np.ndarray, begin: np.ndarray) -> np.ndarray:
        """Takes slopes at a vector ``(n,)`` and offsets ``(W, s)``; errors there,
        ``(W, T, c)``."""
        (more, less), here = self._moved(self.simulate, x, begin, (1.0, -1.0))
        self._take(0.5 * (more - less))
        first, second = (
            np.sqrt(((np.nan_to_num(d) / self.noise) ** 2).sum((0, 2, 3)))
            for d in (0.5 * (more - less), 0.5 * (more + less))
        )
        self.bent = float(np.median(second / np.maximum(first, 1e-300)))
        return here

    def _slopes_of_rows(self, x: np.ndarray, begin: np.ndarray) -> np.ndarray:
        """`linearize` for the rows that decide on starts: of those alone, and to one
        side, where they are simulated alone."""
        if self.begins is None:
            return self.linearize(x, begin)
        (more,), here = self._moved(self.begins, x, begin, (1.0,))
        self._take(more)
        return here

    def _moved(
        self,
        simulate: Simulate,
        x: np.ndarray,
        begin: np.ndarray,
        signs: Sequence[float],
    ) -> tuple[np.ndarray, np.ndarray]:
        """What errors change by where starts are moved by a step of each sign, what is
        separate at once, ``(k, turns, W, T, c)``; and errors there."""
        turn = turns(self._parts)
        most = int(turn.max(initial=-1)) + 1
        moved = np.broadcast_to(begin, (len(signs) * most + 1, *begin.shape)).copy()
        for k, sign in enumerate(signs):
            at = k * most + turn, slice(None), np.arange(len(turn))
            moved[at] += sign * self.step[:, None]
        got = simulate(np.repeat(x[None], len(moved), 0), moved).astype(np.float64)
        with np.errstate(invalid="ignore"):  # `_take` leaves out what is not finite
            change = got[:-1] - got[-1]
        return change.reshape(len(signs), most, *got.shape[1:]), got[-1]

    def _take(self, change: np.ndarray) -> None:
        """Takes slopes from what errors change by over a step, ``(turns, W, T, c)``."""
        slope = change[turns(self._parts)] / self.step[:, None, None, None]
        # One prediction in thousands is not finite; it must not spoil all windows.
        self.slope = np.where(np.isfinite(slope), slope, 0.0)
        if self.parts is not None:
            own = self.parts[:, None] == self.parts[: self.slope.shape[-1]]
            self.slope *= own[:, None, None, :]

    @property
    def _parts(self) -> np.ndarray:
        return np.zeros(len(self.step), int) if self.parts is None else self.parts

    @property
    def _weight(self) -> np.ndarray:
        return 1.0 / self.noise**2

    @property
    def noises(self) -> np.ndarray:
        """Noise of each reading, 0 where there is none, to be broadcast to ``(W, T,
        c)``."""
        noise = np.where(np.isfinite(self.noise), self.noise, 0.0)
        return noise if self.read is None else noise * self.read

    def counted(self, errors: np.ndarray, first: int) -> np.ndarray:
        """Errors ``(..., W, T, c)`` from a row on, of channels that speak of more than
        starts. Rows without a reading have none, and the others are as much larger:
        mean squares are those of readings."""
        out = errors[..., first:, : self.compared]
        if self.read is None:
            return out
        return out / np.sqrt(self.share(first)).astype(errors.dtype)

    def mean_square(self, square: np.ndarray, first: int) -> np.ndarray:
        """Means of squared errors ``(W, T, c)`` from a row on, of readings that there
        are, of channels that speak of more than starts."""
        mean = square[:, first:, : self.compared].mean((0, 1))
        return mean / self.share(first)

    def believe(self, errors: np.ndarray, told: np.ndarray, least: np.ndarray) -> None:
        """Takes noise as the errors at fitted starts show it (`believed`).

        That of channels which speak of starts alone is as told: errors that they share
        in all rows of a start do not show in what a fit leaves.

        Args:
            errors: of `fit`, ``(W, T, c)``.
            told: noise by rows alone, ``(c,)``.
            least: what resolution makes, ``(c,)``.
        """
        seen = believed(self.measured_noise(errors), told, least)
        self.noise = np.where(np.arange(len(told)) < self.compared, seen, told)

    @property
    def compared(self) -> int:
        """Channels that speak of more than starts; they are the first."""
        return len(self.noise) - self.alone

    def share(self, first: int) -> np.ndarray:
        """Of readings that there are from a row of all windows on, above 0, of channels
        that speak of more than starts; all of those that nobody measured."""
        if self.read is None:
            return np.ones(self.compared)
        read = self.read[:, first:, : self.compared]
        return np.maximum(read.mean((0, 1)), 1.0 / read[..., 0].size)

    def gain(self) -> tuple[np.ndarray, np.ndarray]:
        """What turns errors of the first rows, and offsets, into a Gauss-Newton step:
        ``(W, s, rows, c)``, ``(W, s, s)``."""
        near = self.slope[:, :, : self.rows]
        weighed = near * self._weight
        normal = np.einsum("swtc,uwtc->wsu", near, weighed, optimize=True)
        prior = np.diag(1.0 / self.spread**2)
        size = np.outer(self.spread, self.spread)
        inverse = np.linalg.inv((normal + prior) * size) * size
        return (
            np.einsum("wsu,uwtc->wstc", inverse, weighed, optimize=True),
            inverse @ prior,
        )

    def solve(self, x: np.ndarray, begin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fitted starts of one vector ``(n,)``, slopes taken there; leaves them taken.

        A start far off, as a fast joint's at a slow rate is, first meets the nearest
        rows alone, over which errors are nearly linear.

        Args:
            begin: offsets to start from, ``(W, s)``, but where none fit better: what
                was fitted to another model may be in another minimum.

        Returns:
            Offsets ``(W, s)`` and errors ``(W, T, c)``.
        """
        whole, moved = self.rows, self._nearer(x, begin)
        before, errors = np.zeros(0), np.zeros(0)
        known = np.isfinite(self.noise).sum()
        for k in range(_LINEARIZED):
            start = self._slopes_of_rows(x, moved)
            if k == 0:
                before = self._cost(start[None], moved[None])[0]
                if np.median(before) > _FAR * whole * known:
                    self.rows = max(_NEAREST, whole // _NEAR)
                    (moved,), _, _ = self._fitted(x[None], moved[None])
                    self.rows = whole
                    self._slopes_of_rows(x, moved)
            (moved,), (errors,), (after,) = self._fitted(x[None], moved[None])
            fell = np.minimum(before, 1e300) - after
            before = after
            if np.nanmax(np.where(np.isfinite(after), fell, 0.0)) < _WORTH * whole:
                break
        if self.begins is None:
            return moved, errors
        errors = self.linearize(x, moved)
        lost = np.asarray(~np.isfinite(errors).all((1, 2)))
        if lost.any():  # after the rows that were simulated
            moved = np.where(lost[:, None], begin, moved)
            errors = self.linearize(x, moved)
        return moved, errors

    def _nearer(self, x: np.ndarray, begin: np.ndarray) -> np.ndarray:
        """Offsets ``(W, s)``, or none where these fit better."""
        if not begin.any():
            return begin
        simulate = self.simulate if self.begins is None else self.begins
        both = np.stack([begin, np.zeros_like(begin)])
        given, none = self._cost(simulate(np.repeat(x[None], 2, 0), both), both)
        return np.where((none < given)[:, None], 0.0, begin)

    def _cost(self, errors: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Half the weighted squared error of each start, ``(B, W)``."""
        square = (errors[:, :, : self.rows].astype(float) ** 2) @ self._weight
        total = 0.5 * (square.sum(-1) + ((moved / self.spread) ** 2).sum(-1))
        return np.where(np.isfinite(errors).all((2, 3)), total, np.inf)

    def fit(
        self,
        x: np.ndarray,
        begin: np.ndarray,
        readings: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Fitted starts of vectors ``(B, n)``, by the slopes of `linearize`.

        Args:
            begin: offsets to start from, ``(B, W, s)``.
            readings: by how much readings differ from those that ``simulate`` compares
                with, ``(B, W, T, c)``.

        Returns:
            Offsets ``(B, W, s)`` and errors ``(B, W, T, c)``.
        """
        moved, errors, _ = self._fitted(x, begin, readings)
        if self.begins is None:
            return moved, errors
        more = 0.0 if readings is None else readings
        errors = self.simulate(x, moved) - more
        lost = np.asarray(~np.isfinite(errors).all((2, 3)))
        if lost.any():  # after the rows that were simulated
            moved = np.where(lost[..., None], begin, moved)
            errors = self.simulate(x, moved) - more
        return moved, errors

    def _fitted(
        self, x: np.ndarray, begin: np.ndarray, readings: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`fit`, errors those of the rows that are simulated for it; and the cost of
        each start, ``(B, W)``."""
        simulate = self.simulate if self.begins is None else self.begins
        gain, back = self.gain()
        moved = np.array(begin, float)
        errors = simulate(x, moved)
        more = 0.0 if readings is None else readings[:, :, : errors.shape[2]]
        errors = errors - more
        cost = self._cost(errors, moved)
        length = np.ones(cost.shape)
        for _ in range(_ROUNDS):
            near = np.nan_to_num(errors[:, :, : self.rows].astype(float))
            step = np.einsum("wstc,bwtc->bws", gain, near, optimize=True)
            step += np.einsum("wsu,bwu->bws", back, moved, optimize=True)
            ahead = moved - length[..., None] * step
            got = simulate(x, ahead) - more
            new = self._cost(got, ahead)
            better = new < cost
            gained = np.where(better, np.minimum(cost, 1e300) - new, 0.0)
            moved = np.where(better[..., None], ahead, moved)
            errors = np.where(better[..., None, None], got, errors)
            cost = np.where(better, new, cost)
            length = np.where(better, 1.0, _SHORTER * length)
            if (gained <= _SETTLED).all():
                break
        return moved, errors, cost

    def left(self, errors: np.ndarray) -> np.ndarray:
        """What small errors ``(..., W, T, c)`` become where starts are fitted anew."""
        gain, _ = self.gain()
        near = errors[..., : self.rows, :]
        moved = np.einsum("wstc,...wtc->...ws", gain, near, optimize=True)
        return errors - np.einsum("...ws,swtc->...wtc", moved, self.slope)

    def expected(self) -> np.ndarray:
        """Mean squares of the errors that noise alone leaves, ``(W, T, c)``."""
        gain, _ = self.gain()
        known = np.isfinite(self.noise)
        noise = np.where(known, self.noise, 0.0)
        # Of start offsets, and of their product with each reading's own noise.
        cov = np.einsum("wstc,wutc,c->wsu", gain, gain, noise**2, optimize=True)
        out = np.einsum("swtc,wsu,uwtc->wtc", self.slope, cov, self.slope)
        out += self.noises**2
        near = self.slope[:, :, : self.rows]
        own = np.einsum("wstc,swtc->wtc", gain, near, optimize=True)
        out[:, : self.rows] -= 2 * noise**2 * own
        return out

    def measured_noise(self, errors: np.ndarray) -> np.ndarray:
        """Noise as the errors at fitted starts show it, ``(c,)``.

        An upper bound where the model errs within the first rows; half of the windows
        may do so without harm.

        Args:
            errors: of `fit`, ``(W, T, c)``.
        """
        got = np.nanmean(errors[:, : self.rows].astype(float) ** 2, 1)
        due = self.expected()[:, : self.rows].mean(1)
        # Of rows less what the starts take up; a chi-square's median (Wilson and
        # Hilferty, PNAS 17, 1931).
        with np.errstate(divide="ignore", invalid="ignore"):
            free = np.maximum(self.rows * due / self.noise**2, 1.0)
            ratio = got / due / (1 - 2 / (9 * free)) ** 3
        out = np.full(len(self.noise), np.inf)
        for c in np.flatnonzero(np.isfinite(self.noise)).tolist():
            known = ratio[np.isfinite(ratio[:, c]), c]
            if len(known):
                out[c] = self.noise[c] * np.sqrt(np.median(known))
        return out


def known_noise(noise: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Noise of positions ``(nv,)``, or of all channels, above zero; ``position`` is
    their motion."""
    return np.maximum(noise[: len(position)], _FINEST * position)


def starts_about(
    simulate: SimulateRows,
    length: int,
    noise: np.ndarray,
    position: np.ndarray,
    speed: np.ndarray,
    free: np.ndarray,
    act: np.ndarray,
    dt: float,
    parts: np.ndarray | None = None,
    read: np.ndarray | None = None,
    speeds: bool = False,
) -> Starts:
    """Starts of windows that begin where a log says, `lead_rows` early.

    Args:
        simulate: errors of vectors, offsets of starts and so many first rows.
        length: rows of a window.
        noise: of channels, `known_noise`, positions first, and with ``speeds``
            velocities last; infinite where nobody measured.
        position, speed: motion of each degree of freedom, ``(nv,)``.
        free: how far what nobody measured may be off, ``(2 nv,)``; infinite elsewhere.
        act: how far activations may be off, ``(na,)``.
        dt: control step [s].
        parts, read: as for `Starts`; ``parts`` not where there are channels beside
            positions and ``speeds``.
        speeds: whether velocities help to find starts.
    """
    nv, rows = len(position), start_rows(dt)
    known = np.where(np.isfinite(noise), noise, 0.0)[:nv]
    small, part = _DIFFERENCE
    wide = np.maximum(_NOISES * known, _MOTION * position)
    # Nothing but the model speaks of what nobody measured.
    spread = np.where(np.isfinite(free), free, np.concatenate([wide, speed]))
    near = np.maximum(small * position, 3.0 * known)
    near = np.concatenate([near, part * speed])
    step = np.where(np.isfinite(free), part * spread, near)
    by_rows = np.concatenate([known, slope_noise(dt) * known])
    curved = np.repeat([1.0, _CURVED], nv)
    by_noise, wider = (
        np.concatenate([np.where(np.isfinite(free), free, x), act])
        for x in (by_rows, curved * by_rows)
    )
    return Starts(
        lambda x, moved: simulate(x, moved, length),
        noise,
        np.concatenate([spread, act]),
        rows,
        np.concatenate([step, part * act]),
        wider,
        by_noise,
        parts if len(noise) == nv * (1 + speeds) else None,
        read,
        nv * speeds,
        (lambda x, moved: simulate(x, moved, rows)) if rows <= _FEW * length else None,
    )


def floor(
    starts: Starts,
    x: np.ndarray,
    begin: np.ndarray,
    draws: int,
    step: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Mean squares of each row that a perfect model would leave, ``(W, T, c)``.

    Readings of the model's own motion, from fitted starts ``begin (W, s)`` on, are
    drawn with noise and resolution, and go through the same fit of starts, which begins
    as far off as readings put it.

    Args:
        x: the model's vector, ``(n,)``.
        draws: of each window.
        step: between two readings of each channel; 0 where they are fine, ``(c,)``.
    """
    exact = starts.simulate(x[None], begin[None])[0].astype(float)
    least = step / np.sqrt(12.0)
    known = np.isfinite(starts.noise)
    noise = np.where(known, starts.noise, 0.0)
    coarse = np.logical_and(step > 0, least > 0.5 * noise)
    white = np.sqrt(np.maximum(noise**2 - (coarse * least) ** 2, 0.0))
    there = 1.0 if starts.read is None else starts.read
    total, count = np.zeros(exact.shape), np.zeros(len(exact))
    # What nobody measured begins where it was found.
    off = np.where(starts.scatter < starts.spread, starts.scatter, 0.0)
    for first in range(0, draws, _TOGETHER):
        many = min(_TOGETHER, draws - first)
        read = exact + white * rng.normal(size=(many, *exact.shape))
        size = np.where(coarse, step, 1.0)
        # Of the same grid the fitted motion would give the readings it was fitted to.
        phase = size * rng.uniform(size=(many, len(exact), 1, len(size)))
        rounded = np.round((read + phase) / size) * size - phase
        read = there * np.where(coarse, rounded, read)
        vectors = np.repeat(x[None], many, 0)
        at = begin + off * rng.normal(size=(many, *begin.shape))
        _, errors = starts.fit(vectors, at, read)
        fine = np.asarray(np.isfinite(errors).all((2, 3)))
        square = np.where(fine[..., None, None], errors.astype(float) ** 2, 0.0)
        total += square.sum(0)
        count += fine.sum(0)
    # Of a model that predicts nothing the noise of the readings alone is known.
    each = np.broadcast_to(count[:, None, None], total.shape)
    return np.where(each > 0, total / np.maximum(each, 1.0), starts.noises**2)

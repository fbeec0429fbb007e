"""What models predict of the held-out windows, and what a perfect one would leave."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.estimation.starts import DRAWS, Starts, floor
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.error_localization import Conditions
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.result import Figures
from easi_jax.gap.window_set import Rows, WindowSet


@dataclass
class HeldOut:
    """Held-out windows, asked once at the end.

    Attributes:
        m: the model that was recorded.
        runs: that ``windows.run`` counts.
        predictor: that predicts them, among others or alone.
        windows: W of them.
        channels: that are compared.
        starts: their start states.
        lead: rows before the start that the gap is measured from.
        resolution: step between two readings of each channel, ``(c,)``.
        steps: error of the model's own steps, ``(W, T, c)``; None where it does not
            matter.
    """

    m: mujoco.MjModel
    runs: Sequence[Run]
    predictor: Predictor
    windows: WindowSet
    channels: Channels
    starts: Starts
    lead: int
    resolution: np.ndarray
    steps: np.ndarray | None = None

    def __post_init__(self) -> None:
        self._moved = np.zeros((len(self.windows), self.predictor.size))

    def look(self, x: np.ndarray, share: float = 0.0) -> Figures:
        """Figures of a vector ``(n,)``, the slopes of starts taken there.

        Args:
            share: of the own steps' error, that is not held against the model.
        """
        self._moved, errors = self.starts.solve(x, self._moved)
        return self._figures(x, errors, share)

    def figures(self, x: np.ndarray, share: float = 0.0) -> Figures:
        """Figures of a vector ``(n,)``, by the slopes of the last `look`."""
        return self._figures(x, self._fitted(x[None])[1][0], share)

    def squares(self, x: np.ndarray, share: float = 0.0) -> np.ndarray:
        """Mean squares of each window for vectors ``(B, n)``, ``(B, W, c)``."""
        out = [np.zeros((0, len(self.windows), self.starts.compared))]
        for one in x:
            errors = self._fitted(one[None])[1]
            out.append(measure.squares(self._counted(errors, share)[0][0])[None])
        return np.concatenate(out)

    def floor(self, x: np.ndarray) -> np.ndarray:
        """Mean squares of a perfect model, ``(c,)``, at a vector that was looked at:
        `easi_jax.estimation.starts.floor`."""
        rng = np.random.default_rng(0)
        got = floor(self.starts, x, self._moved, DRAWS, self.resolution, rng)
        return self.starts.mean_square(got, self.lead + 1)

    def _fitted(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        begin = np.broadcast_to(self._moved, (len(x), *self._moved.shape))
        return self.starts.fit(x, begin)

    def _counted(
        self, errors: np.ndarray, share: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Errors ``(B, W, H, c)`` after the start, all finite, and which windows were
        not, ``(B, W)``."""
        if share and self.steps is not None:
            errors = errors - share * self.starts.left(self.steps)
        after = self.starts.counted(errors, self.lead + 1)
        return measure.finite(after, self.predictor.largest)

    def _figures(self, x: np.ndarray, errors: np.ndarray, share: float) -> Figures:
        (after,), (lost,) = self._counted(errors[None], share)
        square, scale = measure.squares(after), self.channels.scale
        rows = self.predictor.rows(x, self.windows)
        rows = Rows(rows.readings[:, self.lead :], rows.commands[:, self.lead :])
        return Figures(
            float(measure.gap(square.mean(0), scale)),
            measure.interval(square, scale),
            np.sqrt(square.mean(0)),
            square,
            after,
            Conditions(self.m, self.windows, self.runs, rows),
            int(lost.sum()),
            np.nan_to_num(errors[:, self.lead, : self.starts.compared]),
        )

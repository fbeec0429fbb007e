"""The unknown starts of a predictor's windows."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.activations import activation_spread
from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import start_spread
from easi_jax.estimation.starts import Starts, starts_about
from easi_jax.gap.predictor import Predictor, windows_in
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.separate_trees import start_parts


def window_starts(
    m: mujoco.MjModel,
    predictor: Predictor,
    runs: Sequence[Run],
    scales: Scales,
    noise: np.ndarray,
    blocks: np.ndarray | None = None,
    count: int | None = None,
    rows: int | None = None,
) -> Starts:
    """Starts of the windows in some blocks.

    Args:
        m: the model that was recorded.
        runs: that say how far activations may be off.
        scales: of the motion in them.
        noise: of what is compared, positions first and velocities last, ``(c,)``,
            above zero; infinite for those that nobody measured.
        blocks: of the predictor's windows; all where None.
        count: of them that are no fillers; all where None.
        rows: of a window that are compared; all where None.
    """
    own, read = len(predictor.neutral), predictor.read
    every = np.arange(len(predictor.windows))
    at = (every if blocks is None else windows_in(blocks))[:count]

    length = predictor.steps + 1 if rows is None else rows

    def simulate(x: np.ndarray, moved: np.ndarray, first: int) -> np.ndarray:
        return predictor.errors(x[..., :own], blocks, moved, first)[:, :count]

    return starts_about(
        simulate,
        length,
        noise,
        scales.position,
        scales.speed,
        start_spread(m, runs),
        activation_spread(m, runs),
        runs[0].dt,
        start_parts(m),
        None if read.all() else read[at, :length],
        predictor.compares_speeds,
    )

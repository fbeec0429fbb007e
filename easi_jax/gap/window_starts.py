"""The unknown starts of a predictor's windows."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.activations import activation_guess, activation_spread
from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import start_spread
from easi_jax.data.windows import lead_rows
from easi_jax.estimation.starts import Starts
from easi_jax.gap.predictor import Predictor
from easi_jax.model.effect_catalog import Scales

# A start may be off by so much from what the log says of it: so wide that the rows of
# its window decide. A position, times its noise and its motion; speeds by their motion.
_NOISES, _MOTION = 30.0, 0.03
_DIFFERENCE = 3e-3, 0.03  # of positions and speeds, in units of their motion
_FINEST = 1e-6  # of the motion: noise of a log that has none


def known_noise(noise: np.ndarray, scales: Scales) -> np.ndarray:
    """Noise of positions ``(nv,)``, above zero."""
    return np.maximum(noise[: len(scales.position)], _FINEST * scales.position)


def window_starts(
    m: mujoco.MjModel,
    predictor: Predictor,
    runs: Sequence[Run],
    scales: Scales,
    noise: np.ndarray,
    blocks: np.ndarray | None = None,
    count: int | None = None,
) -> Starts:
    """Starts of the windows in some blocks.

    Args:
        m: the model that was recorded.
        runs: that say how far activations may be off.
        scales: of the motion in them.
        noise: of measured positions, ``(nv,)``, above zero; infinite for those that
            nobody measured.
        blocks: of the predictor's windows; all where None.
        count: of them that are no fillers; all where None.
    """
    act = np.zeros(m.na)
    if m.na:
        act = activation_spread(m, runs, [activation_guess(m, run) for run in runs])
    own, seen = len(predictor.neutral), np.isfinite(noise)
    known = np.where(seen, noise, 0.0)
    position = np.maximum(_NOISES * known, _MOTION * scales.position)
    # Nothing but the model speaks of what nobody measured.
    given = np.concatenate([position, scales.speed])
    free = start_spread(m, runs)
    spread = np.where(np.isfinite(free), free, given)
    small, part = _DIFFERENCE
    near = np.maximum(small * scales.position, 3.0 * known)
    near = np.concatenate([near, part * scales.speed])
    step = np.where(np.isfinite(free), part * spread, near)

    def simulate(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
        return predictor.errors(x[..., :own], blocks, moved)[:, :count]

    return Starts(
        simulate,
        noise,
        np.concatenate([spread, act]),
        2 * lead_rows(runs[0].dt) + 1,
        np.concatenate([step, part * act]),
    )

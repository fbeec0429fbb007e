"""Pieces of one recording know what was sent before them, and are one recording."""

import numpy as np
import pytest

from easi_jax.data.activations import activation_guess
from easi_jax.data.cleaning import rows_of
from easi_jax.data.holdout import split_held_out
from easi_jax.data.recording import Run
from easi_jax.data.segments import cut
from easi_jax.gap.error_localization import Conditions
from easi_jax.gap.window_set import Rows, window_set
from tests.easi_jax.data.test_activations import ACTUATORS, recorded


@pytest.mark.parametrize("name", ["filter", "integrator"])
def test_windows_of_a_piece_are_those_of_the_whole(name: str) -> None:
    m, run, _ = recorded(ACTUATORS[name])
    first = 160
    piece = rows_of(run, first, len(run))
    whole = window_set(m, [run], 0.2, 0.1)
    windows = window_set(m, [piece], 0.2, 0.1)
    assert whole is not None
    assert windows is not None
    whole = whole.take(np.flatnonzero(whole.row >= first))
    np.testing.assert_array_equal(whole.row, windows.row + first)
    for what in ("past", "start_act", "ctrl", "start_qpos"):
        got, want = getattr(windows, what), getattr(whole, what)
        np.testing.assert_allclose(got, want, atol=1e-12, err_msg=what)
    alone = Run(**{**vars(piece), "before": piece.ctrl[:0]})
    assert np.abs(activation_guess(m, alone) - activation_guess(m, piece)).max() > 0.01


def test_segments_of_a_piece_have_the_commands_before_it() -> None:
    _, run, _ = recorded(ACTUATORS["filter"])
    piece = rows_of(run, 100, 160)
    found = cut(piece.qpos, piece.qvel, piece.ctrl, 10, 10, 7, None, piece.before)
    assert found is not None
    want = [run.ctrl[row - 7 : row] for row in range(100, 150, 10)]
    np.testing.assert_array_equal(found.past, want)


def test_late_is_late_in_the_recording() -> None:
    m, run, _ = recorded(ACTUATORS["filter"])
    fit, held, _ = split_held_out(m, [run], 0.1)
    windows = window_set(m, held, 0.1, 0.0, len(fit))
    assert windows is not None
    none = np.zeros((len(windows), 1, 1), int)
    rows = Rows(none, none[..., 0])
    late = Conditions(m, windows, [*fit, *held], rows).general["late in the recordings"]
    last = windows.run == len(fit) + len(held) - 1
    np.testing.assert_array_equal(late, last)

"""Predictions that are not finite spoil no figure, and are counted."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.estimation.prediction_error import rms_of_steps
from easi_jax.estimation.starts import Starts
from easi_jax.excite.propose import Proposal, quick_tests
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.fitting import Fitting
from easi_jax.gap.forward_selection import Selector
from easi_jax.gap.gap_metric import Channels
from easi_jax.gap.held_out import HeldOut
from easi_jax.gap.window_set import Rows

W, H, NV = 12, 4, 2
LARGEST = np.array([0.5, 2.0])
NAMES = ("a", "b")


def some(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 0.01 * rng.normal(size=(1, W, H, NV)).astype(np.float32)


def blown(*windows: int) -> np.ndarray:
    errors = some()
    errors[0, list(windows), 2:, 1] = np.nan
    return errors


def predictor(errors: Any) -> Any:
    return SimpleNamespace(
        errors=errors,
        largest=LARGEST,
        neutral=np.zeros(1),
        rows=lambda x, windows: Rows(np.zeros((W, H, NV)), np.zeros((W, H - 1))),
        steps=H - 1,
        size=2 * NV,
    )


def held_out(errors: Any) -> HeldOut:
    """Held-out windows without a compiled program; the first row is the start."""
    spread = np.ones(2 * NV)
    noise = np.full(NV, 1e-3)
    starts = Starts(
        lambda x, moved: errors(x), noise, spread, 2, 1e-3 * spread, spread, spread
    )
    channels = Channels(NAMES, NAMES, ("rad", "m"), np.ones(NV), {})
    given = None, [], predictor(errors), [None] * W, channels, starts
    return HeldOut(*given, lead=0, resolution=np.zeros(NV))  # type: ignore[arg-type]


def repeated(*lost: int) -> Any:
    return lambda x, *_: np.repeat(blown(*lost), len(x), 0)


def test_a_lost_window_counts_as_the_largest_motion() -> None:
    bounded, lost = measure.finite(blown(3, 5)[0], LARGEST)
    assert lost.tolist() == [w in (3, 5) for w in range(W)]
    np.testing.assert_allclose(bounded[3], np.broadcast_to(LARGEST, (H, NV)))
    np.testing.assert_array_equal(bounded[~lost], some()[0][~lost])
    whole = some()[0]
    assert measure.finite(whole, LARGEST)[0] is whole


def test_held_out_figures_stay_numbers_and_say_how_many_are_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("easi_jax.gap.held_out.Conditions", lambda *_: None)
    figures = held_out(repeated(3, 5)).look(np.zeros(1))
    assert figures.not_finite == 2
    assert np.isfinite([figures.gap, *figures.interval, *figures.si]).all()
    expected = np.sqrt((2 * LARGEST**2).sum() / W / NV)
    assert figures.gap == pytest.approx(expected, rel=0.01)
    assert held_out(repeated()).look(np.zeros(1)).not_finite == 0


@pytest.mark.parametrize("lost", [(3,), tuple(range(W))], ids=["one", "all"])
def test_the_floor_is_of_what_is_known(
    lost: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("easi_jax.gap.held_out.Conditions", lambda *_: None)
    windows = held_out(repeated(*lost))
    windows.look(np.zeros(1))
    np.testing.assert_allclose(np.sqrt(windows.floor(np.zeros(1))), 1e-3, rtol=0.2)


def test_fits_go_on_with_the_windows_that_are_left() -> None:
    chosen = object.__new__(Selector)
    chosen.blocks, chosen.count, chosen.steps = np.arange(1), W, None
    chosen.rows = None
    chosen.moved = np.zeros((W, 2 * NV))
    chosen.predictor = predictor(lambda *_: blown(3))
    assert np.isfinite(chosen.errors(np.zeros((1, 1)))).all()
    chosen.predictor = predictor(lambda *_: blown(*range(8)))
    assert np.isnan(chosen.errors(np.zeros((1, 1)))).any()


def test_a_model_that_blows_up_is_told_in_one_line() -> None:
    made = object.__new__(Fitting)
    lost = repeated(*range(8))
    made.starts = held_out(lost).starts
    made.data = None  # type: ignore[assignment]
    made.selector = SimpleNamespace(  # type: ignore[assignment]
        moved=np.zeros((W, 2 * NV)), errors=lost, sticks=False
    )
    with pytest.raises(UserError, match="not finite: the model blows up"):
        made.whiten(np.zeros(1))


def test_an_identified_models_error_stays_a_number() -> None:
    error = rms_of_steps(jnp.asarray(blown(3, 5)[0]), jnp.asarray(LARGEST))
    np.testing.assert_allclose(error, LARGEST * np.sqrt(2 / W), rtol=0.01)
    whole = some()[0]
    np.testing.assert_allclose(
        rms_of_steps(jnp.asarray(whole), jnp.asarray(LARGEST)),
        np.sqrt((whole**2).mean((0, 1))),
        rtol=1e-5,
    )


def test_no_test_is_proposed_to_a_machine_without_actuators() -> None:
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    tests, way = quick_tests(m, [])
    assert tests == []
    said = Proposal("a@j", "b@j", None, 0.0, 0.0, False, way, ()).text()
    assert "no actuator" in said and "a@j from b@j" in said

"""Predictions by native MuJoCo: few calls, and the same whichever way they go."""

import mujoco
import numpy as np
import pytest

from easi_jax.data.scales import scales_of
from easi_jax.data.windows import start_rows
from easi_jax.gap.candidates import places
from easi_jax.gap.effect_vector import Layout
from easi_jax.gap.predictor import Predictor
from easi_jax.gap.window_set import WindowSet, window_set
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine, native
from easi_jax.simulation.engine import Engine
from tests.easi_jax.gap.test_late_readings import ARM, DT, STEPS, recorded


def made(seconds: float, longest: float) -> tuple[mujoco.MjModel, Layout, WindowSet]:
    """An arm, columns of all effects, and windows of its run."""
    m = mujoco.MjModel.from_xml_string(ARM.format(""))
    run = recorded(m, (0.0,))
    windows = window_set(m, [run], seconds, longest)
    assert windows is not None
    return m, Layout(m, places(m, scales_of(m, [run]))), windows


def test_a_window_is_one_call_unless_an_effect_depends_on_the_state(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    m, layout, windows = made(0.05, 0.0)
    with engine.using("mujoco"):
        p = Predictor(m, ParameterSpace(()), layout, windows, DT)
    steps = p.steps * STEPS
    calls = []
    called = native._Call._called

    def counted(self: object, *args: object) -> object:
        calls.append(1)
        return called(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(native._Call, "_called", counted)

    def predicted(**fields: float) -> tuple[np.ndarray, int]:
        x = p.neutral.copy()
        for i, c in enumerate(layout.columns):
            x[i] = fields.get(c.field, x[i])
        calls.clear()
        return p.errors(x[None])[0], len(calls)

    steady, few = predicted(coulomb=0.05)
    stepped, many = predicted(coulomb=0.05, drag=1e-12)
    dragged, _ = predicted(coulomb=0.05, drag=0.02)
    both, most = predicted(coulomb=0.05, drag=1e-12, resistance=1e-12)
    assert few <= p.devices and many == few * steps and most == 2 * many
    # Where they go step by step, states are rounded to single precision after each.
    np.testing.assert_allclose(stepped, steady, atol=2e-5)
    np.testing.assert_allclose(both, stepped, atol=2e-5)
    assert np.abs(dragged - steady).max() > 1e-3


@pytest.mark.parametrize("how", ["mjx", "mujoco"])
def test_first_rows_alone_are_those_of_the_whole(how: Engine) -> None:
    """With nothing in the steps, with play, and where readings are late."""
    m, layout, windows = made(0.2, 0.1)
    with engine.using(how):
        p = Predictor(m, ParameterSpace(()), layout, windows, DT)
    fields = [c.field for c in layout.columns]
    vectors = np.repeat(p.neutral[None], 4, 0)
    for x, (name, size) in zip(
        vectors[1:], {"drag": 0.02, "width": 0.01, "late": 0.013}.items(), strict=True
    ):
        x[fields.index(name)] = size
    whole = p.errors(vectors)
    for rows in (start_rows(DT), p.steps):
        alone = p.errors(vectors, rows=rows)
        np.testing.assert_allclose(alone, whole[:, :, :rows], atol=2e-6)


@pytest.mark.parametrize("how", ["mjx", "mujoco"])
def test_windows_of_every_length_go_through_one_program(how: Engine) -> None:
    m, layout, short = made(0.2, 0.1)
    long = made(0.6, 0.1)[2]
    given, late = (m, ParameterSpace(()), layout), [c.field for c in layout.columns]
    with engine.using(how):
        alone = Predictor(*given, short, DT)
        p = Predictor(*given, short, DT, length=long.ctrl.shape[1])
    vectors = np.repeat(alone.neutral[None], 2, 0)
    vectors[1, late.index("late")] = 0.013
    errors, whole = p.errors(vectors), alone.errors(vectors)
    assert errors.shape == whole.shape
    # Where readings are late, rows beyond the last are simulated, not extrapolated.
    np.testing.assert_allclose(errors[0], whole[0], atol=2e-6)
    np.testing.assert_allclose(errors[1, :, :-2], whole[1, :, :-2], atol=2e-6)
    more = p.on(long.take(np.arange(8)))
    assert more._compiled is p._compiled and more.steps > p.steps
    alone = alone.on(long.take(np.arange(8)))
    assert alone._compiled is not p._compiled
    np.testing.assert_allclose(more.errors(vectors), alone.errors(vectors), atol=2e-5)
    np.testing.assert_array_equal(more.largest, alone.largest)

"""Velocities of the log help to find the starts of windows, and are no channels."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from easi_jax.data.noise import pooled
from easi_jax.data.recording import Run
from easi_jax.data.velocity_lag import error_of_means
from easi_jax.data.windows import lead_rows
from easi_jax.gap import gap_metric as measure
from easi_jax.gap.analysis import Analysis
from easi_jax.gap.recorded import with_speeds
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation import engine

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="a" axis="0 -1 0" damping="0.15"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.02" mass="0.5"/>
    <body pos="0 0 -0.35"><joint name="b" axis="0 -1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/></body>
  </body></worldbody>
  <actuator><motor name="m" joint="a"/></actuator>
</mujoco>"""
DT, NOISE, SPEED_NOISE = 0.01, 1e-3, 0.02  # s, rad, rad/s


def _recorded(m: mujoco.MjModel, seed: int) -> Run:
    rng, d = np.random.default_rng(seed), mujoco.MjData(m)
    t = DT * np.arange(1000)
    ctrl = 2.0 * np.sin(2 * np.pi * rng.uniform(0.5, 1.5, 3) * t[:, None]).mean(1)
    q, v = [], []
    for u in ctrl:
        q.append(d.qpos.copy())
        v.append(d.qvel.copy())
        d.ctrl[:] = u
        for _ in range(5):
            mujoco.mj_step(m, d)
    qpos = np.array(q) + NOISE * rng.normal(size=(len(t), m.nq))
    qvel = np.array(v) + SPEED_NOISE * rng.normal(size=(len(t), m.nv))
    given = f"run{seed}", "made", DT, t, qpos, qvel, True, ctrl[:, None]
    return Run(*given, Configuration.of(m))


@pytest.fixture(scope="module")
def arm() -> tuple[mujoco.MjModel, list[Run]]:
    m = mujoco.MjModel.from_xml_string(ARM)
    return m, [_recorded(m, seed) for seed in range(3)]


def _ready(m: mujoco.MjModel, runs: list[Run], noise: np.ndarray) -> Analysis:
    """Whitened, as selection begins."""
    with engine.using("mujoco"):
        a = Analysis(
            m, ParameterSpace(()), runs[:2], runs[2:], noise, 0.2, only=["armature@a"]
        )
    a.reported.begin(a.reported.neutral)
    a.held_out.channels = a.reported.channels
    a.held_out.starts.noise = a.reported.starts.noise
    return a


def _spread(a: Analysis) -> np.ndarray:
    """Standard deviations of starts by the noise of readings, ``(s,)``."""
    starts = a.reported.starts
    gain, _ = starts.gain()
    cov = np.einsum("wstc,wutc,c->wsu", gain, gain, starts.noise**2)
    return np.sqrt(np.median(np.diagonal(cov, axis1=1, axis2=2), 0))


def _held_out(a: Analysis) -> tuple[np.ndarray, np.ndarray]:
    """RMS errors of the joints and their floors [rad]."""
    x = a.predictor.neutral
    figures = a.held_out.look(x)
    return figures.si, np.sqrt(a.held_out.floor(x))


def test_starts_are_surer_and_a_perfect_model_is_at_its_floor(
    arm: tuple[mujoco.MjModel, list[Run]],
) -> None:
    m, runs = arm
    noise = pooled(runs).std
    with_them, without = (_ready(m, runs, noise[:n]) for n in (2 * m.nv, m.nv))
    assert with_them.predictor.speeds and not without.predictor.speeds
    more, less = _spread(with_them), _spread(without)
    assert (more[2:] < 0.6 * less[2:]).all(), (more, less)
    (off, least), (_, before) = map(_held_out, (with_them, without))
    assert (least < 0.95 * before).all()
    assert ((off > 0.88 * least) & (off < 1.12 * least)).all(), off / least
    assert with_them.reported.channels.names == without.reported.channels.names
    white = with_them.reported.selector.simulate(with_them.predictor.neutral[None])
    scale = with_them.reported.channels.scale
    gap = with_them.reported.selector.residuals.gap(white[0])
    plain = measure.gap(np.square(off), scale)
    assert gap == pytest.approx(plain, rel=0.25)


def test_velocities_that_are_wrong_do_no_harm(
    arm: tuple[mujoco.MjModel, list[Run]],
) -> None:
    """Of 1.05 times what they should be, which no lag or filter explains."""
    m, runs = arm
    wrong = [replace(run, qvel=1.05 * run.qvel) for run in runs]
    noise = pooled(wrong).std
    with_them, without = (_ready(m, wrong, noise[:n]) for n in (2 * m.nv, m.nv))
    (off, _), (before, _) = map(_held_out, (with_them, without))
    np.testing.assert_allclose(off, before, rtol=0.03)
    assert (with_them.data.noise[m.nv :] > 5 * SPEED_NOISE).all()


def test_what_velocities_are_off_by_is_told_from_noise(
    arm: tuple[mujoco.MjModel, list[Run]],
) -> None:
    m, runs = arm
    rows = 2 * lead_rows(DT) + 1
    noise = np.repeat([NOISE, SPEED_NOISE], m.nv)
    late = 0.5 * m.opt.timestep
    alone = SPEED_NOISE / np.sqrt(rows)
    assert (error_of_means(runs, noise, rows, late) < 0.7 * alone).all()
    off = 0.05 * np.sqrt(np.mean([np.mean(r.qvel**2, 0) for r in runs], 0))
    wrong = [replace(run, qvel=1.05 * run.qvel) for run in runs]
    found = error_of_means(wrong, noise, rows, late)
    np.testing.assert_allclose(found, off, rtol=0.15)


def test_velocities_that_one_run_lacks_are_left_unused_and_it_is_said(
    arm: tuple[mujoco.MjModel, list[Run]],
) -> None:
    m, runs = arm
    fit = [replace(runs[0], qvel_measured=False), *runs[1:-1]]
    _, _, noise, notes = with_speeds(m, fit, runs[-1:], np.ones(2 * m.nv))
    assert len(noise) == m.nv
    assert notes == [f"velocities are left unused, since {runs[0].name} has none"]
    fit = [replace(run, qvel_measured=False) for run in runs]
    assert with_speeds(m, fit[:-1], fit[-1:], np.ones(2 * m.nv))[3] == []

"""What a test is said to tell, against fits of simulated noisy recordings of it."""

from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.data.cleaning import rows_of
from easi_jax.data.recording import Run
from easi_jax.data.scales import scales_of
from easi_jax.data.windows import lead_rows
from easi_jax.excite import candidates, choose, drives, play, separation
from easi_jax.excite import evaluate as ev
from easi_jax.excite.propose import propose, quick_tests
from easi_jax.gap.batched_least_squares import bounds_of, least_squares, lockstep
from easi_jax.gap.whitening import make_residuals
from easi_jax.gap.window_starts import window_starts
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameter_proposal import own_space

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 -1 0" damping="0.05"{armature}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
EFFECTS = ("armature", "coulomb_friction", "viscous_damping", "payload_mass")
NOISE, DT, HORIZON, ROWS = 2e-3, 0.01, 0.2, 801
DRAWS = 6


def model(armature: float = 0.0) -> mujoco.MjModel:
    extra = f' armature="{armature}"' if armature else ""
    return mujoco.MjModel.from_xml_string(XML.replace("{armature}", extra))


def played(m: mujoco.MjModel, ctrl: np.ndarray, name: str = "run") -> Run:
    motion = play.play(m, m.qpos0, ctrl, DT)
    return candidates.run_of(m, motion, DT, name)


def noisy(run: Run, rng: np.random.Generator) -> Run:
    qpos = run.qpos + NOISE * rng.standard_normal(run.qpos.shape)
    return Run(
        name=run.name,
        source="",
        dt=run.dt,
        time=run.time,
        qpos=qpos,
        qvel=np.zeros_like(run.qvel),
        qvel_measured=False,
        ctrl=run.ctrl,
        configuration=Configuration.of(model()),
    )


class Case:
    """Four recordings of a pendulum, and what each would say."""

    def __init__(self) -> None:
        self.m = m = model()
        time = np.arange(ROWS) * DT
        limits = drives.limits_of(m, 0.05, np.ones(1), np.full(1, np.inf))
        bench, _ = candidates.make_bench(m, limits, DT, ROWS)
        assert bench.feedback is None
        recipes = [
            candidates.Recipe("multisine", 0.5, 8.0, 1.0),
            candidates.Recipe("pulses", 0.3, 1.0, 0.35),
        ]
        tests = candidates.make_tests(bench, recipes, np.full(1, np.inf), time[-1], 0)
        slow = 0.6 * np.sin(2 * np.pi * 0.15 * time)[:, None]
        still = np.zeros((ROWS, 1))
        self.tests = tests
        self.runs = [*(t.run for t in tests), played(m, slow), played(m, still)]
        self.names = ["multisine", "pulses", "slow", "still"]
        self.noise = np.array([NOISE])
        self.scales = scales_of(m, self.runs)
        self.space = own_space(m)
        found = choose.effects_wanted(m, self.space, self.scales, EFFECTS)
        self.parts = ev.windows_of(m, self.runs, HORIZON, self.scales.longest, 96)
        self.predictor = ev.make_predictor(m, self.space, found, self.parts, DT)
        self.bounds = bounds_of(self.space, self.predictor.layout)
        self.places = {p.key: p for p in found}
        self.design = ev.make_design(self.predictor, self.bounds, found)
        self.seen = dict(
            zip(
                self.names,
                [
                    separation.separation(self.design, p)
                    for p in ev.products_of(
                        m, self.design, self.parts, self.runs, self.noise, self.scales
                    )
                ],
                strict=True,
            )
        )

    def column(self, key: str) -> int:
        return int(self.predictor.layout.where(self.places[key])[0]) + (
            self.predictor.own
        )

    def fits(self, run: Run, which: list[list[int]], draws: int) -> np.ndarray:
        """Estimates and costs ``(draws, sets, 1 + 2)`` from noisy recordings.

        Every other window, which do not overlap: what is said of a test counts a row
        once.
        """
        rng = np.random.default_rng(5)
        out = []
        for _ in range(draws):
            drawn = noisy(run, rng)
            longest = self.scales.longest
            (windows,) = ev.windows_of(self.m, [drawn], HORIZON, longest, 999)
            windows = windows.take(np.arange(0, len(windows), 2))
            p, x = self.predictor.on(windows), self.predictor.neutral
            starts = window_starts(self.m, p, [drawn], self.scales, self.noise)
            moved, _ = starts.solve(x, np.zeros((len(windows), p.size)))
            residuals = make_residuals(starts, lead_rows(DT), np.zeros(1), np.ones(1))

            def simulate(
                vectors: np.ndarray,
                p: Any = p,
                residuals: Any = residuals,
                moved: np.ndarray = moved,
            ) -> np.ndarray:
                at = np.broadcast_to(moved, (len(vectors), *moved.shape))
                errors = p.errors(vectors, None, at)
                return residuals.whitened(residuals.grouped(errors))

            weight = np.ones(len(windows))
            problems = [
                least_squares(x[None], active, self.bounds, weight) for active in which
            ]
            found = lockstep(problems, simulate)
            out.append([[f.cost, f.x[f.active[-1]]] for f in found])
        return np.array(out)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


def apart(case: Case, name: str, a: str, b: str) -> float:
    s = case.seen[name]
    return float(s.apart[s.keys.index(a), s.keys.index(b)])


def test_rest_says_nothing(case: Case) -> None:
    still = case.seen["still"]
    np.testing.assert_array_equal(still.visible, 0.0)
    assert np.isinf(still.std["armature@hinge"]).all()
    known = separation.alike(list(case.seen.values()))
    assert choose.score(still, known, []) == 0.0
    assert choose.score(case.seen["multisine"], known, []) > 1.0


def test_what_the_refit_covers_is_no_effect(case: Case) -> None:
    assert "viscous_damping@hinge" not in case.places
    assert {"armature@hinge", "coulomb_friction@hinge"} <= set(case.places)


def test_deviations_are_those_of_fits(case: Case) -> None:
    column = case.column("armature@hinge")
    # Away from its bound at zero.
    real = model(armature=2 * float(case.bounds.size[column]))
    measured, told = [], []
    for name in ("multisine", "pulses", "slow"):
        run = played(real, case.runs[case.names.index(name)].ctrl)
        measured.append(case.fits(run, [[0, column]], DRAWS)[:, 0, 1].std(ddof=1))
        told.append(case.seen[name].std["armature@hinge"][0])
    assert measured[2] > 5 * max(measured[:2]) and told[2] > 5 * max(told[:2])
    # Of six draws a standard deviation is known to a third.
    np.testing.assert_allclose(measured[:2], told[:2], rtol=0.6)


def test_distances_are_those_of_fits(case: Case) -> None:
    """Data with an armature, fitted by it and by dry friction in its place."""
    size = float(case.bounds.size[case.column("armature@hinge")])
    wrong = model(armature=3 * size)
    pair = ("armature@hinge", "coulomb_friction@hinge")
    which = [[0, case.column(k)] for k in pair]
    measured, told = [], []
    for name in ("multisine", "slow"):
        run = case.runs[case.names.index(name)]
        real = played(wrong, run.ctrl)
        cost = case.fits(real, which, 6)[:, :, 0]
        better = 2 * (cost[:, 1] - cost[:, 0]).mean()
        measured.append(np.sqrt(max(better, 0.0)))
        told.append(3 * apart(case, name, *pair))
    assert measured[0] > 5 * max(measured[1], 1.0) and told[0] > 5 * told[1]
    assert measured[0] == pytest.approx(told[0], rel=0.3)


def test_a_proposal_beats_the_data_given(case: Case) -> None:
    slow = case.runs[2]
    short = rows_of(slow, 0, 5)  # less than a window: says nothing
    x = case.predictor.neutral.copy()
    x[case.column("armature@hinge")] += case.bounds.size[case.column("armature@hinge")]
    (found,) = propose(
        case.m,
        case.predictor,
        case.bounds,
        x,
        [0],
        case.places["armature@hinge"],
        [case.places["coulomb_friction@hinge"]],
        [short, slow],
        case.noise,
        HORIZON,
        quick_tests(case.m, [short, slow], 8.0),
    )
    assert found.test is not None and not found.twins
    assert found.apart > 4 * found.given
    told = apart(case, "slow", "armature@hinge", "coulomb_friction@hinge")
    assert found.given == pytest.approx(told, rel=0.3)
    text = found.text()
    assert "8 s of" in text and '"motor"' in text and "times as well" in text

"""train.gap on a machine whose friction the model lacks, and its messages."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.gap.forward_selection import Selector
from easi_jax.io.models.effects_file import read_effects
from easi_jax.io.runs.step_cache import Journal
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.found_effects import FoundEffects
from easi_jax.model.found_laws import FoundLaw, add_law
from easi_jax.model.law_terms import Term
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import simulator_with
from envs import make
from tests.gap_cases import Effect, make_case
from train import gap
from train._command import main
from train._gap_problem import GapProblem, beyond_mjcf, read_model


def run(*args: object) -> None:
    main(gap.Config, gap.run, name="train.gap", args=[str(a) for a in args])


def test_what_is_read_back_is_summed_in_the_same_order(tmp_path: Path) -> None:
    """The order of sums follows how an array lies in memory: results are bit-equal."""
    x = np.moveaxis(np.random.default_rng(0).normal(size=(5, 30, 40)), 0, -1)
    assert not x.flags.c_contiguous
    first, again = (
        Journal(tmp_path / "analysis").remember(lambda: {"slope": x})["slope"]
        for _ in range(2)
    )
    assert first.strides == again.strides
    np.testing.assert_array_equal(first, x)
    np.testing.assert_array_equal(again, x)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("case")
    return make_case(
        22, "pendulum", [Effect("coulomb_friction", "hinge")], folder / "data"
    )


@pytest.fixture(scope="module")
def results(case: Any) -> Path:
    data = sorted(case.directory.glob("run*.csv"))
    out = case.directory.parent / "gap"
    run("--model", case.directory / "model.xml", "--data", *data, "--out", out)
    return out


def test_friction_is_named_and_the_gap_closed(case: Any, results: Path) -> None:
    told = json.loads((results / "gap.json").read_text())
    assert told["schema"] == 1 and told["verdict"] == "explained"
    (effect,) = told["effects"]
    assert (effect["effect"], effect["at"], effect["kind"]) == (
        "coulomb_friction",
        "hinge",
        "joint",
    )
    truth = case.effects[0].number("torque")
    torque = effect["parameters"]["torque"]
    assert torque["unit"] == "N m"
    assert torque["value"] == pytest.approx(truth, rel=0.1)
    assert 0 < torque["std"] < 0.1 * truth
    assert effect["confidence"] > 0.5
    figures = told["gap"]
    assert figures["before"] > 3 * figures["floor"] > 0
    assert figures["floor"] == pytest.approx(case.gap.floor, rel=0.3)
    assert figures["after"] < 1.2 * figures["floor"]
    low, high = figures["after_95"]
    assert low < figures["after"] < high
    assert effect["gap_after"] == pytest.approx(figures["after"])
    si = told["gap_si"]["hinge"]
    assert si["unit"] == "rad" and si["before"] > si["after"]
    assert told["held_out"] and told["ignored"] == []
    (place,) = told["where"]
    assert place["at"] == "hinge" and place["share"] == pytest.approx(1.0)


def test_the_repaired_model_loads_and_has_it(case: Any, results: Path) -> None:
    told = json.loads((results / "gap.json").read_text())
    torque = told["effects"][0]["parameters"]["torque"]["value"]
    m = mujoco.MjModel.from_xml_path(str(results / "model.xml"))
    old = mujoco.MjModel.from_xml_path(str(case.directory / "model.xml"))
    added = m.dof_frictionloss[0] - old.dof_frictionloss[0]
    assert added == pytest.approx(torque, rel=1e-3)
    entries, own = read_effects(results / "effects.yaml")
    bare = Simulator(old, ParameterSpace(()), 0.01)
    simulator = simulator_with(bare, FoundEffects(tuple(entries)))
    effects = simulator.model(jnp.asarray(simulator.space.nominal)).effects
    assert effects is not None
    np.testing.assert_allclose(effects.coulomb, [torque], rtol=1e-5)
    assert set(own) == {r["address"] for r in told["refitted"]}


def test_the_report_says_it_in_a_sentence(results: Path) -> None:
    text = (results / "report.html").read_text()
    assert "N·m of dry friction, which the model lacks" in text
    assert "times the sensor noise" in text
    assert "http://" not in text.replace("http://www.w3.org", "")


def test_results_are_not_overwritten(
    case: Any, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        run(
            *("--model", case.directory / "model.xml", "--out", results),
            *("--data", case.directory / "run1.csv"),
        )
    assert stop.value.code == 2
    assert "--overwrite" in capsys.readouterr().err


def test_laws_that_were_found_go_with_the_analysis(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The next machine of the same process has none of them."""
    names = []

    def finds(_: Any) -> None:
        names.append(add_law(FoundLaw((("j", 1.0),), (Term("qpos.j**3"),))))
        assert names[0] in CATALOG

    monkeypatch.setattr(gap, "_run", finds)
    gap.run(gap.Config())
    assert names[0] not in CATALOG


@pytest.mark.parametrize("after", [2, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.fault("killed (signal 9), then resumed")
def test_a_stopped_analysis_goes_on(
    after: int,
    case: Any,
    results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, remember = tmp_path / "gap", Journal.remember
    data = [shutil.copy(p, tmp_path) for p in sorted(case.directory.glob("run*.csv"))]
    words = ("--model", case.directory / "model.xml", "--out", out, "--data", *data)

    def stopping(self: Journal, make: Any) -> Any:
        if self.kept == after:
            raise KeyboardInterrupt
        return remember(self, make)

    with monkeypatch.context() as patched:
        patched.setattr(Journal, "remember", stopping)
        with pytest.raises(SystemExit) as stop:
            run(*words)
    assert stop.value.code == 130
    assert "--resume" in capsys.readouterr().err
    kept = sorted((out / "checkpoints" / "analysis").iterdir())
    assert len(kept) == after

    with pytest.raises(SystemExit) as stop:
        run(*words)
    assert stop.value.code == 2

    log = Path(data[0])
    measured = log.read_text()
    log.write_text(measured.rstrip().rpartition("\n")[0])  # a row less
    with pytest.raises(SystemExit) as stop:
        run(*words, "--resume")
    assert stop.value.code == 2
    assert f"{log} has changed since" in capsys.readouterr().err
    log.write_text(measured)

    # What was written last may be damaged.
    kept[-1].write_bytes(kept[-1].read_bytes()[:-100])
    made = []
    with monkeypatch.context() as patched:
        patched.setattr(Selector, "simulate", counted(Selector.simulate, made))
        run(*words, "--resume")
    assert "going on after" in capsys.readouterr().out
    old, new = (json.loads((p / "gap.json").read_text()) for p in (results, out))
    for told in (old, new):
        del told["seconds"], told["law_seconds"]
    assert new == old
    for name in ("model.xml", "effects.yaml"):
        assert (out / name).read_bytes() == (results / name).read_bytes()
    assert not (out / "checkpoints" / "analysis").exists()

    count = len(made)
    run(*words, "--resume")
    assert "is finished" in capsys.readouterr().out
    assert 0 < len(made) == count


def counted(method: Any, calls: list[int]) -> Any:
    def counting(self: Any, x: Any, *some: Any) -> Any:
        calls.append(len(x))
        return method(self, x, *some)

    return counting


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"--model": "no.xml"}, "no such model"),
        ({"--data": "no.csv"}, "no.csv"),
        ({"--horizon": "-1"}, "--horizon"),
        ({"--model": None}, "--model"),
        ({"--held-out": "{run}"}, "leave a log to fit"),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_mistakes_end_with_one_line(
    change: dict[str, str | None],
    text: str,
    case: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = str(case.directory / "run1.csv")
    options: dict[str, str | None] = {
        "--model": str(case.directory / "model.xml"),
        "--data": log,
        "--out": str(tmp_path / "out"),
        **change,
    }
    args = [
        part.replace("{run}", log)
        for name, value in options.items()
        if value is not None
        for part in (name, value)
    ]
    with pytest.raises(SystemExit) as stop:
        run(*args)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert text in error and "Traceback" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.fault("wild readings, joints that stand still")
def test_a_log_that_stands_still(
    case: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (case.directory / "run1.csv").read_text().splitlines()
    head, first = lines[0], lines[1].split(",")
    column = head.split(",").index("time")
    still = []
    for i in range(400):
        row = list(first)
        row[column] = str(0.01 * i)
        still.append(",".join(row))
    log = tmp_path / "still.csv"
    log.write_text("\n".join([head, *still]) + "\n")
    with pytest.raises(SystemExit) as stop:
        run(
            *("--model", case.directory / "model.xml", "--data", log),
            *("--out", tmp_path / "out"),
        )
    assert stop.value.code == 2
    assert "record larger or faster motion" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_effects_files_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    for text, reason in (
        ("effects: 3", "with a list"),
        ("effects:\n- {effect: frictoin, columns: {coulomb: 1}}", "unknown effect"),
        ("effects:\n- {effect: coulomb_friction, columns: {culomb: 1}}", "coulomb"),
        (
            "effects:\n- {effect: armature, columns: {armature: big}}",
            "no finite number",
        ),
        ("effects: []\nrefitted:\n- {to: 1}", "refitted 1"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=reason):
            read_effects(path)


def test_a_built_in_robot_keeps_what_its_xml_cannot_say() -> None:
    """Cartpole's cart has a speed limit; without it a gap would be found there."""
    env = make("cartpole")
    fixed = beyond_mjcf(make("cartpole").space)
    assert fixed == {"joint.cart.speed_limit": 0.6}
    assert beyond_mjcf(make("ant").space) == {}
    simulator = Simulator(env.mj_model, ParameterSpace(()), env.dt, fixed=fixed)
    model = simulator.model(jnp.zeros(0))
    np.testing.assert_allclose(model.speed_limit, env.model().speed_limit)


def test_what_a_parameter_sets_is_not_fixed_beside_it() -> None:
    """A built-in robot's speed limit is its own value, or that of a refit."""
    model = read_model("cartpole")
    space = make("cartpole").space
    some = space.select([n for n in space.names if n != "cart_speed_limit"])
    (address,) = space.parameters[space.index("cart_speed_limit")].addresses
    for own, left in ((some, {address}), (space, set())):
        problem = GapProblem(model, own, [], [], "", [], np.zeros(0), [], [])
        assert problem.fixed.keys() == left
        Simulator(model.mj_model, own, 0.02, fixed=problem.fixed)

"""``train.easi --data``: what a user with a model, parameters and logs gets."""

import html
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from easi_jax.estimation import posterior
from easi_jax.estimation.from_runs import _Finish
from easi_jax.estimation.held_out import WindowErrors
from tests.commands import refused
from train import _command, easi, evaluate

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "lift_arm"

MODEL = """<mujoco model="pendulum">
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="rod">
    <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05" limited="true"
           range="-170 170"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"
          contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>"""
PARAMETERS = """parameters:
  - name: damping
    address: joint.hinge.damping
    initial: [0.01, 0.3]
    bounds: [0.0001, 10.0]
"""
SMALL = ("--population", "8", "--generations", "2", "--set", "segments=16")


def call(*args: object) -> None:
    _command.main(easi.Config, easi.run, name="train.easi", args=[str(a) for a in args])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """A model, a parameter file and a log, all good."""
    paths = {
        "model": tmp_path / "pendulum.xml",
        "parameters": tmp_path / "parameters.yaml",
        "log": tmp_path / "log.csv",
        "out": tmp_path / "out",
    }
    paths["model"].write_text(MODEL)
    paths["parameters"].write_text(PARAMETERS)
    write_log(paths["log"])
    return paths


def write_log(path: Path, rows: int = 200, dt: float = 0.01, gain: float = 1.0) -> None:
    at = dt * np.arange(rows)
    angle = gain * 0.5 * np.sin(3 * at)
    lines = [f"{t:.6g},{a:.6f},{np.cos(3 * t):.4f}" for t, a in zip(at, angle)]  # noqa: B905
    path.write_text("\n".join(["time,qpos.hinge,ctrl.drive", *lines]) + "\n")


def arguments(files: dict[str, Path], *more: object) -> list[object]:
    head = ["--model", files["model"], "--parameters", files["parameters"]]
    return [*head, "--data", files["log"], "--out", files["out"], *SMALL, *more]


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# -- the example ------------------------------------------------------------------


COMPILED: list[str] = []


def note_compilation(event: str, duration_secs: float, **more: object) -> None:
    if event.endswith("backend_compile_duration"):
        COMPILED.append(str(more.get("fun_name")))


@dataclass(frozen=True)
class Fitted:
    """What a small search in two chunks, and a fit, wrote.

    Attributes:
        out: folder of the run.
        truth: value of each parameter.
        held: name of the log that is held out.
        channels: its joints.
        address, unit: of a parameter.
    """

    out: Path
    truth: dict[str, float]
    held: str
    channels: tuple[str, ...]
    address: str
    unit: str


def made(out: Path) -> Fitted:
    """A pendulum that is damped otherwise."""
    model, parameters = out.parent / "pendulum.xml", out.parent / "parameters.yaml"
    model.write_text(MODEL)
    parameters.write_text(PARAMETERS)
    logs = [out.parent / "sweep.csv", out.parent / "moves.csv"]
    for seed, log in enumerate(logs):
        swing(log, damping=0.2, rows=600, noise=1e-4, seed=seed)
    fit(out, model, parameters, *logs)
    truth, unit = {"damping": 0.2}, "N·m·s/rad"
    return Fitted(out, truth, "moves", ("hinge",), "joint.hinge.damping", unit)


def arm(out: Path) -> Fitted:
    """The example's command."""
    logs = (EXAMPLE / "sweep.csv", EXAMPLE / "moves.csv")
    fit(out, EXAMPLE / "model.xml", EXAMPLE / "parameters.yaml", *logs)
    channels = ("shoulder", "elbow")
    return Fitted(out, truth(), "moves", channels, "joint.*.armature", "kg·m²")


def fit(out: Path, model: Path, parameters: Path, *logs: Path) -> None:
    files = ("--model", model, "--parameters", parameters, "--data", *logs)
    call(*files, "--out", out, "--search-chunk", 1, *SMALL)


@pytest.fixture(
    scope="module", params=[made, pytest.param(arm, marks=pytest.mark.slow)]
)
def fitted(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Fitted:
    jax.monitoring.register_event_duration_secs_listener(note_compilation)
    COMPILED.clear()
    return request.param(tmp_path_factory.mktemp("fitted") / "run")


def truth() -> dict[str, float]:
    lines = (EXAMPLE / "README.md").read_text().splitlines()
    cells = [
        [c.strip() for c in line.split("|")[1:-1]] for line in lines if "|" in line
    ]
    rows = [c for c in cells if len(c) == 4 and c[2][:1].isdigit()]
    return {c[0].split(" ")[0]: float(c[2]) for c in rows}


def test_the_truth_is_found(fitted: Fitted) -> None:
    found = json.loads((fitted.out / "distribution.json").read_text())
    result = found["seeds"]["0"]
    names = [p["name"] for p in found["parameters"]]
    assert sorted(names) == sorted(fitted.truth)
    assert result["flags"] == ["determined"] * len(names)
    for name, mean in zip(names, result["mean"], strict=True):
        # The model's timestep alone moves the rotor inertia by 7 % (README).
        tolerance = 0.09 if name == "rotor_inertia" else 0.05
        assert mean == pytest.approx(fitted.truth[name], rel=tolerance), name


def test_every_program_is_compiled_once(fitted: Fitted) -> None:
    assert COMPILED.count("jit(fit)") == COMPILED.count("jit(end)") == 1
    assert COMPILED.count("jit(advance)") == 1


def test_the_held_out_error_is_reported(fitted: Fitted) -> None:
    held = json.loads((fitted.out / "distribution.json").read_text())["held_out"]
    assert held["what"] == fitted.held
    assert held["channels"] == list(fitted.channels)
    for before, after, floor in zip(
        held["before"], held["after"]["0"], held["noise_floor"], strict=True
    ):
        assert before > 0.03
        assert after < 0.1 * before
        assert floor < 1.1 * after
    page = (fitted.out / "report.html").read_text()
    for said in (*fitted.truth, fitted.address, fitted.unit, fitted.held, "<svg"):
        assert said in page
    assert not re.search(r'(src|href)="https?:', page)


# -- bad input --------------------------------------------------------------------


def refuse(capsys: pytest.CaptureFixture[str], args: list[object], *said: str) -> None:
    """One clear line, exit status 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        call(*args)
    assert stop.value.code == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("error: ")
    assert "\n" not in line
    for text in said:
        assert text in line, line


def unknown_address(f):
    edit(f["parameters"], "joint.hinge.damping", "joint.hinge.dampling")
    return 'did you mean "damping"', "parameters.yaml"


def unknown_joint(f):
    edit(f["parameters"], "joint.hinge.damping", "joint.hing.damping")
    return ('did you mean "hinge"',)


def reversed_bounds(f):
    edit(f["parameters"], "[0.0001, 10.0]", "[10.0, 0.0001]")
    return "damping", "bounds"


def reversed_initial(f):
    edit(f["parameters"], "[0.01, 0.3]", "[0.3, 0.01]")
    return "damping", "initial"


def missing_column(f):
    edit(f["log"], "ctrl.drive", "ctrl.driver")
    return "ctrl.driver", "log.csv"


def backwards(f):
    edit(f["log"], "\n0.05,", "\n0.03,")
    return "time goes back", "row"


def wrong_rate(f):
    write_log(f["log"], dt=10.0)
    return ("wrong rate",)


def single_row(f):
    write_log(f["log"], rows=1)
    return ("a single row",)


def all_non_finite(f):
    lines = f["log"].read_text().splitlines()
    rows = [line.split(",")[0] + ",nan,0" for line in lines[1:]]
    f["log"].write_text("\n".join([lines[0], *rows]) + "\n")
    return ("log.csv",)


def too_short(f):
    write_log(f["log"], rows=20)
    return ("too few",)


def not_xml(f):
    edit(f["model"], "</worldbody>", "")
    return "pendulum.xml", "cannot read"


def no_model(f):
    f["model"].unlink()
    return "pendulum.xml", "no such"


def foreign_folder(f):
    f["out"].mkdir()
    (f["out"] / "thesis.txt").write_text("mine")
    return ("holds no run",)


CASES = (
    unknown_address,
    unknown_joint,
    reversed_bounds,
    reversed_initial,
    missing_column,
    backwards,
    wrong_rate,
    single_row,
    all_non_finite,
    too_short,
    not_xml,
    no_model,
    foreign_folder,
)


@pytest.mark.parametrize("spoil", CASES, ids=lambda f: f.__name__)
@pytest.mark.fault("wrong options and files")
def test_bad_input_is_one_line(spoil, files, capsys):
    said = spoil(files)
    before = sorted(files["out"].rglob("*")) if files["out"].exists() else None
    refuse(capsys, arguments(files), *said)
    after = sorted(files["out"].rglob("*")) if files["out"].exists() else None
    assert after == before


@pytest.mark.fault("wrong options and files")
def test_what_mjx_lacks_is_one_line_with_that_engine(files, capsys):
    delayed = 'joint="hinge" delay="0.02" nsample="4"/>'
    edit(files["model"], 'joint="hinge"/>', delayed)
    refuse(capsys, arguments(files, "--engine", "mjx"), "nsample", "--engine mujoco")
    assert not files["out"].exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--strategy", "CMA_E"], ['did you mean "CMA_ES"']),
        (["--preset", "papers"], ['did you mean "paper"']),
        (["--set", "los=gan"], ['did you mean "loss"']),
        (["--set", "source=policy"], ["without their controller"]),
        (["--horizon", "-1"], ["--horizon"]),
        (["--restarts", "-1"], ["--restarts is -1"]),
        (["--noise", "0.1"], ["2 numbers"]),
        (["--robot", "cartpole"], ["exclude each other"]),
        (["--held-out", "nowhere.csv"], ["nowhere.csv"]),
    ],
)
@pytest.mark.fault("wrong options and files")
def test_bad_options_are_one_line(more, said, files, capsys):
    refuse(capsys, arguments(files, *more), *said)
    assert not files["out"].exists()


def test_data_alone_asks_for_a_model(files, capsys):
    refuse(capsys, ["--data", files["log"], "--out", files["out"]], "--model")
    args = ["--data", files["log"], "--model", files["model"], "--out", files["out"]]
    refuse(capsys, args, "--parameters")


def test_folder_that_cannot_be_written(files, capsys):
    files["out"].parent.joinpath("file").write_text("x")
    files["out"] = files["out"].parent / "file" / "out"
    refuse(capsys, arguments(files), "--out")


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_non_finite_simulations_stop_the_search(files, capsys):
    edit(files["parameters"], "joint.hinge.damping", "actuator.drive.gain")
    edit(files["parameters"], "[0.01, 0.3]", "[1.0e+37, 3.0e+37]")
    edit(files["parameters"], "[0.0001, 10.0]", "[0.0001, 1.0e+38]")
    edit(files["log"], ",1.0000\n", ",900000.0\n")
    edit(files["model"], 'joint="hinge"/>', 'joint="hinge" gear="1000"/>')
    refuse(capsys, arguments(files), "non-finite", "damping", "generation 1")


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_result_that_is_no_number_is_an_error(files, capsys, monkeypatch):
    """Whatever makes it; once it was a singular system, and training went on."""
    made = posterior.gaussian
    monkeypatch.setattr(
        posterior, "gaussian", lambda space, mean, cov: made(space, mean + np.nan, cov)
    )
    with pytest.raises(SystemExit) as stop:
        call(*arguments(files))
    assert stop.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: the fit diverged (seed 0:")
    assert "not finite for damping" in said
    assert not (files["out"] / "distribution.json").exists()


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_seed_without_a_result_has_a_reason_and_no_number(files, capsys, monkeypatch):
    monkeypatch.setattr(_Finish, "passes", diverging(_Finish.passes))
    swing(files["log"], damping=0.1, rows=600, noise=1e-4)
    call(*arguments(files, "--seeds", 0, 1))
    found = json.loads((files["out"] / "distribution.json").read_text())
    assert list(found["seeds"]) == ["1"] and found["best_seed"] == 1
    assert "not finite for damping" in found["diverged"]["0"]
    assert "seed 0 has no result: its mean or its spread" in words(capsys, files)


def test_a_machine_with_an_unknown_law_gets_no_region(files, capsys):
    """A spring that grows with the cube of the angle. The log is short, too."""
    spring = MODEL.replace('damping="0.05"', 'damping="0.05" stiffness="0 0 4"')
    swing(files["log"], damping=0.1, rows=600, noise=1e-4, model=spring)
    call(*arguments(files))
    seed = json.loads((files["out"] / "distribution.json").read_text())["seeds"]["0"]
    assert seed["no_region"].startswith("no region is stated: the model errs by")
    said = words(capsys, files)
    assert seed["no_region"] in said
    assert "too few to see how values scatter between" in said


def diverging(passes):
    """The first fit's mean is no number."""
    count = iter(range(100))

    def spoiled(self, mean, cov):
        found, weight = passes(self, mean, cov)
        if next(count) == 0:
            none = replace(found.distribution, mean=np.nan * found.distribution.mean)
            found = replace(found, distribution=none)
        return found, weight

    return spoiled


def words(capsys, files) -> str:
    """What the terminal and the report say, which is the same."""
    said = " ".join(capsys.readouterr().out.split())
    page = " ".join((files["out"] / "report.html").read_text().split())
    notes = re.findall(r"note: (.*?)(?= note: | a policy for it: )", said)
    assert notes
    for note in notes:
        for part in re.split(r": | \(|\)$", note):
            assert part in html.unescape(page), note
    return said


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_predictions_that_are_not_finite_are_counted_and_spoil_nothing(
    files, capsys, monkeypatch
):
    solved = WindowErrors._solved

    def blown(self, x):
        moved, found = solved(self, x)
        found = np.array(found)
        found[:2, -1] = np.nan
        return moved, found

    monkeypatch.setattr(WindowErrors, "_solved", blown)
    swing(files["log"], damping=0.1, rows=600, noise=1e-4)
    call(*arguments(files))
    held = json.loads((files["out"] / "distribution.json").read_text())["held_out"]
    assert held["not_finite"] == [2, 2] and held["windows"] > 8
    figures = [*held["before"], *held["after"]["0"], *held["noise_floor"]]
    assert np.isfinite(figures).all()
    said = words(capsys, files)
    for model in ("the model as given", "the result of seed 0"):
        lost = f"2 of {held['windows']} held-out windows are not finite with {model}"
        assert lost in said


@pytest.mark.parametrize(
    ("dampings", "odd"), [((0.05, 0.25), "log1"), ((0.1, 0.1), None)]
)
def test_logs_that_contradict_each_other_are_named(files, capsys, dampings, odd):
    """Of two logs one is held out, and a fit to the other says nothing of it."""
    logs = [files["log"].with_name(f"log{k}.csv") for k in range(2)]
    for k, (log, damping) in enumerate(zip(logs, dampings, strict=True)):
        swing(log, damping, rows=600, noise=1e-4, seed=k)
    files["log"] = logs[0]
    call(*arguments(files, "--held-out", logs[1]))
    said = capsys.readouterr().out
    page = (files["out"] / "report.html").read_text()
    for text in (said, page):
        text = " ".join(text.split())
        assert ("contradicts the other runs" in text) == (odd is not None)
        if odd:
            assert (
                f"{odd} contradicts the other runs: alone it says damping 0.25" in text
            )
            assert "those that were fitted 0.05" in text


def test_degrees_are_noticed_and_earlier_results_kept(files, capsys):
    """A whole small run; then a bad one into the same folder."""
    write_log(files["log"], gain=57.3 * 2)
    call(*arguments(files))
    out = capsys.readouterr().out
    assert "degrees" in out
    assert out.strip().splitlines()[-1] == f"report: {files['out'] / 'report.html'}"
    assert "holds no policy" in refused(capsys, evaluate, "--run", files["out"])
    kept = {p: p.read_bytes() for p in files["out"].rglob("*") if p.is_file()}
    refuse(capsys, arguments(files), "already holds a run")
    single_row(files)
    refuse(capsys, arguments(files, "--overwrite"), "a single row")
    assert {p: p.read_bytes() for p in files["out"].rglob("*") if p.is_file()} == kept


@pytest.mark.slow
def test_a_fit_on_some_of_the_logs_ends_where_all_have_it(files, capsys, monkeypatch):
    """As larger robots have it, whose fits would take hours with all pieces."""
    swing(files["log"], damping=0.1)
    found = {}
    for some in (False, True):
        if some:
            name = "easi_jax.estimation.from_runs.few"
            monkeypatch.setattr(name, lambda _, pieces, __: pieces.spread(6))
        call(*arguments(files, "--overwrite"))
        said = capsys.readouterr().out
        assert said.count("least-squares finish") == (2 if some else 3)
        assert said.count("on all of the logs") == 2
        found[some] = json.loads((files["out"] / "distribution.json").read_text())
        found[some] = found[some]["seeds"]["0"]
    assert found[False]["mean"][0] == pytest.approx(0.1, rel=0.05)
    std = [found[k]["unit_covariance"][0][0] ** 0.5 for k in (False, True)]
    apart = found[True]["unit_mean"][0] - found[False]["unit_mean"][0]
    assert abs(apart) < 0.5 * std[0]
    assert std[1] == pytest.approx(std[0], rel=0.2)


def swing(
    path: Path,
    damping: float,
    rows: int = 1500,
    noise: float = 1e-3,
    seed: int = 0,
    model: str = MODEL,
) -> None:
    """A log of the model, damped otherwise, with sensor noise [rad]."""
    m = mujoco.MjModel.from_xml_string(model)
    m.dof_damping[0] = damping
    d, rng, lines = mujoco.MjData(m), np.random.default_rng(seed), []
    for k in range(rows):
        d.ctrl[0] = 0.8 * np.sin(0.05 * k + seed) + 0.5 * np.sin(0.013 * k)
        angle = d.qpos[0] + noise * rng.normal()
        lines.append(f"{0.01 * k:.6g},{angle:.6f},{d.ctrl[0]:.6f}")
        mujoco.mj_step(m, d)
    path.write_text("\n".join(["time,qpos.hinge,ctrl.drive", *lines]) + "\n")


@pytest.mark.slow
@pytest.mark.fault("killed (signal 9), then resumed")
def test_a_stopped_run_goes_on_bit_equal(files, tmp_path):
    """Stopped at a moment of no one's choosing, then resumed with the same command."""
    many = ("--generations", "40", "--search-chunk", "1")
    args = [str(a) for a in arguments(files, *many)]
    found = files["out"] / "distribution.json"
    resumed = {}
    for blow in (signal.SIGKILL, signal.SIGINT):
        status, said = stopped(args, files["out"], blow)
        assert not found.exists()
        if blow == signal.SIGINT:
            assert status == 130
            assert "--resume" in said and "Traceback" not in said
            assert said.splitlines()[-1].startswith("interrupted;")
        call(*args, "--resume")
        resumed[blow] = found.read_bytes()
    call(*args, "--overwrite")
    assert set(resumed.values()) == {found.read_bytes()}


def stopped(args, out, blow):
    """Starts the command afresh in a process of its own and stops it once it has a
    checkpoint; exit status and what it said."""
    if out.exists():
        shutil.rmtree(out)
    child = subprocess.Popen(
        [sys.executable, "-m", "train.easi", *args],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 400
        while not any(out.glob("checkpoints/search/step_*")):
            assert child.poll() is None, child.communicate(timeout=100)[1]
            assert time.monotonic() < deadline
            time.sleep(0.01)
        child.send_signal(blow)
        said = child.communicate(timeout=100)[1]
    finally:
        child.kill()
    return child.returncode, said

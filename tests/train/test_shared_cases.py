"""Small inputs on which commands failed once, where ``../shared/cases`` is there."""

from pathlib import Path

import pytest

import easi_jax
from benchmarks.small_cases import CASES as ALL
from tests.commands import command, read
from tests.documented import ROOT
from train import easi, gap

CASES = ROOT.parent / "shared" / "cases"
pytestmark = pytest.mark.skipif(
    not CASES.is_dir(), reason="../shared/cases is not here"
)
CALF = """parameters:
  - {name: damping, address: joint.FR_calf_joint.damping, initial: [0.3, 3.0],
     bounds: [0.01, 100.0], scale: log}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "log", "said"),
    [
        ("filter_act", "log.csv", "with a state of their own (activation): a;"),
        ("backlash_joint", "full.csv", "leaves the model's range of -0.04 to 0.04"),
        ("backlash_joint", "log.csv", "FR_calf_joint_b (held by an equality)"),
    ],
)
def test_a_search_ends_with_files(
    case: str,
    log: str,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, parameters = CASES / case, tmp_path / "p.yaml"
    own = folder / "parameters.yaml"
    parameters.write_text(own.read_text() if own.is_file() else CALF)
    out = tmp_path / "easi"
    command(
        *(easi, "--model", folder / "model.xml", "--parameters", parameters),
        *("--data", folder / log, "--out", out, "--engine", "mujoco", "--no-refine"),
        *("--population", 8, "--generations", 2, "--set", "segments=16"),
    )
    assert (out / "report.html").is_file() and said in capsys.readouterr().out


def test_a_joint_that_no_encoder_sees() -> None:
    folder = CASES / "backlash_joint"
    m = easi_jax.read_model(folder / "model.xml")
    (run,) = easi_jax.read_log(folder / "log.csv", m).runs
    assert run.hidden.tolist() == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL)
def test_a_model_that_is_right_has_no_gap(case: str, tmp_path: Path) -> None:
    name, logs = case.split(",")[0], ALL[case]
    folder, out = CASES / name, tmp_path / "gap"
    data = [folder / log for log in logs]
    command(gap, "--model", folder / "model.xml", "--data", *data, "--out", out)
    told = read(out / "gap.json")
    assert told["verdict"] == "no_gap" and not told["effects"]


@pytest.mark.slow
def test_a_drive_with_a_state_is_identified(tmp_path: Path) -> None:
    folder, out = CASES / "filter_act", tmp_path / "easi"
    command(
        *(easi, "--model", folder / "model.xml", "--data", folder / "log.csv"),
        *("--parameters", folder / "parameters.yaml", "--out", out),
    )
    told = read(out / "distribution.json")
    found = told["seeds"]["0"]
    assert set(found["flags"]) == {"determined"}
    values = zip(told["parameters"], found["mean"], found["std"], strict=True)
    for parameter, mean, std in values:
        truth = parameter["nominal"]
        assert abs(mean - truth) < 3 * std, parameter
        assert std < 0.1 * truth

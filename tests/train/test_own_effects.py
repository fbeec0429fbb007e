"""``--effects-from``: from an owner's file to a named effect and to its parameters."""

import runpy
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.commands import command, read, refused
from train import easi, gap, udr

pytestmark = pytest.mark.timeout(900)

EXAMPLES = Path(__file__).parents[2] / "examples" / "own_effects"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Names of the script that makes the logs, and where they are."""
    names = runpy.run_path(str(EXAMPLES / "make_logs.py"))
    folder = tmp_path_factory.mktemp("own")
    names["make"](folder)
    return {**names, "folder": folder}


def given(folder: Path) -> tuple[Any, ...]:
    runs = sorted(folder.glob("run*.csv"))
    return ("--model", folder / "model.xml", "--data", *runs)


def named(folder: Path, file: str) -> dict:
    own = ("--effects-from", EXAMPLES / file)
    command(gap, *given(folder), *own, "--out", folder / "gap")
    return read(folder / "gap" / "gap.json")


@pytest.mark.slow
def test_a_coupling_spring_is_found_and_searched(made: dict, capsys) -> None:
    folder = made["folder"] / "coupled_arm"
    told = named(folder, "coupling_spring.py")
    assert told["verdict"] == "explained"
    (effect,) = told["effects"]
    assert (effect["effect"], effect["at"]) == ("coupling_spring", "")
    found = {k: v["value"] for k, v in effect["parameters"].items()}
    truth = {"stiffness": made["SPRING"], "rest": made["REST"]}
    assert found == pytest.approx(truth, rel=0.02)
    report = (folder / "gap" / "report.html").read_text()
    assert "couples shoulder and elbow" in report

    file = ("--effects", folder / "gap" / "effects.yaml")
    out = ("--out", folder / "easi", "--generations", 3)
    assert "--effects-from" in refused(capsys, easi, *given(folder), *file, *out)
    own = ("--effects-from", EXAMPLES / "coupling_spring.py")
    command(easi, *given(folder), *file, *own, *out)
    names = [
        p["name"] for p in read(folder / "easi" / "distribution.json")["parameters"]
    ]
    assert "coupling_spring.stiffness" in names


@pytest.mark.slow
def test_a_quadratic_thrust_is_found(made: dict) -> None:
    told = named(made["folder"] / "lift", "propeller.py")
    (effect,) = told["effects"]
    assert (effect["effect"], effect["at"]) == ("quadratic_thrust", "rotor")
    share = effect["parameters"]["share"]["value"]
    assert share == pytest.approx(made["SHARE"], rel=0.05)


def test_a_file_that_is_wrong_leaves_nothing(
    made: dict, tmp_path: Path, capsys
) -> None:
    path = tmp_path / "mine.py"
    shutil.copy(EXAMPLES / "coupling_spring.py", path)
    text = path.read_text().replace('"elbow"', '"wrist"')
    path.write_text(text)
    own = ("--effects-from", path, "--out", tmp_path / "gap")
    said = refused(capsys, gap, *given(made["folder"] / "coupled_arm"), *own)
    assert "mine.py, line" in said and "wrist" in said
    assert not (tmp_path / "gap").exists()
    path.write_text("x = 1\n")
    said = refused(capsys, udr, "--effects-from", path, "--out", tmp_path / "udr")
    assert "no easi_jax.OwnEffect" in said and not (tmp_path / "udr").exists()

"""Commands read only what lies in the model's folder, unless they are told to."""

from pathlib import Path
from typing import Any

import pytest

from tests.commands import command, refused
from train import easi, excite, gap, parameters

PART = """<mujocoinclude><worldbody><body name="b"><joint name="j" damping="1"/>
<geom size=".1"/></body></worldbody></mujocoinclude>"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    for name in ("robot", "parts"):
        (tmp_path / name).mkdir()
    (tmp_path / "parts" / "part.xml").write_text(PART)
    path = tmp_path / "robot" / "model.xml"
    path.write_text('<mujoco><include file="../parts/part.xml"/></mujoco>')
    return path


def test_parameters_of_a_model_with_parts_elsewhere(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = model.parent / "p.yaml"
    words = ("--model", model, "--out", out)
    assert "--allow-assets" in refused(capsys, parameters, *words)
    assert not out.exists()
    command(parameters, *words, "--allow-assets", model.parents[1] / "parts")
    assert "joint.j.damping" in out.read_text()


@pytest.mark.parametrize(
    ("module", "more"),
    [(gap, ("--data",)), (excite, ()), (easi, ("--parameters", "p", "--data"))],
)
def test_others_refuse_too(
    model: Path, capsys: pytest.CaptureFixture[str], module: Any, more: tuple[str, ...]
) -> None:
    log = model.parent / "log.csv"
    words = ("--model", model, *more, *([log] if more else []))
    out = model.parent / "out"
    line = refused(capsys, module, *words, "--out", out)
    assert "../parts/part.xml lies outside of the model's folder" in line
    assert not out.exists()
    allowed = (*words, "--out", out, "--allow-assets", model.parents[1] / "parts")
    assert "lies outside" not in refused(capsys, module, *allowed)

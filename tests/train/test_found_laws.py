"""A law that nobody listed, from logs to a file that other commands take."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.commands import command, read
from tests.gap_cases.laws import draw_law
from train import easi, gap

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

CUBIC = 6  # a seed of `draw_law` whose law is a cubic spring


def test_a_law_is_found_named_and_searched(tmp_path: Path) -> None:
    case, out = tmp_path / "case", tmp_path / "gap"
    answer = draw_law(CUBIC, case)
    assert answer["law"] == "cubic"
    runs = sorted(case.glob("run*.csv"))
    given = ("--model", case / "model.xml", "--data", *runs)
    command(gap, *given, "--out", out)
    told = read(out / "gap.json")
    (law,) = [e for e in told["effects"] if e["effect"] == "found_law"]
    assert "^3" in law["law"]
    value = law["parameters"]["c1"]["value"]
    np.testing.assert_allclose(value, -answer["size"], rtol=0.1)
    assert told["gap"]["after"] < 0.5 * told["gap"]["known_effects"]
    assert f"found_law@{law['at']}" in told["not_in_model_xml"]
    report = (out / "report.html").read_text()
    assert "The law that was found" in report and "found_law_" not in report
    (entry,) = [
        e
        for e in yaml.safe_load((out / "effects.yaml").read_text())["effects"]
        if e["effect"] == "found_law"
    ]
    assert entry["columns"]["c1"] == pytest.approx(value)

    file = ("--effects", out / "effects.yaml", "--generations", 3)
    command(easi, *given, *file, "--out", tmp_path / "easi")
    found = read(tmp_path / "easi" / "distribution.json")["parameters"]
    assert f"found_law@{law['at']}.c1" in [p["name"] for p in found]

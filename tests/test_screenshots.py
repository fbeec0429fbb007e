"""The pictures of reports in ``docs``: made here, of what the commands write now.

UPDATE_SCREENSHOTS=1 pytest -m slow tests/test_screenshots.py  # puts new ones in place
"""

import base64
import io
import os
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from tests.browser import chromium, page
from tests.commands import command
from tests.documented import ROOT
from tests.gap_cases import Effect, make_case
from train import easi, gap

BROWSER = chromium()
SIZE = (1000, 1300)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine"),
]


def gap_report(folder: Path) -> Path:
    effects = [Effect("coulomb_friction", "hinge")]
    case = make_case(22, "pendulum", effects, folder / "data")
    logs = sorted(case.directory.glob("run*.csv"))
    model = case.directory / "model.xml"
    command(gap, "--model", model, "--data", *logs, "--out", folder / "gap")
    return folder / "gap" / "report.html"


def easi_report(folder: Path) -> Path:
    arm = ROOT / "examples" / "lift_arm"
    files = ("--model", arm / "model.xml", "--parameters", arm / "parameters.yaml")
    logs = ("--data", arm / "sweep.csv", "--held-out", arm / "moves.csv")
    command(easi, *files, *logs, "--out", folder / "arm")
    return folder / "arm" / "report.html"


@pytest.mark.parametrize("make", [gap_report, easi_report])
def test_screenshot(make: Callable[[Path], Path], tmp_path: Path) -> None:
    report = make(tmp_path)
    assert BROWSER is not None
    with page(BROWSER, tmp_path / "profile") as tab:
        tab.open(report, *SIZE)
        wrong = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled")
        assert tab.told(*wrong, "Log.entryAdded") == []
        assert tab.value("document.documentElement.scrollHeight") > SIZE[1]
        taken = tab.ask("Page.captureScreenshot", format="png")
    png = base64.b64decode(taken["data"])
    kept = ROOT / "docs" / f"{make.__name__}.png"
    if os.environ.get("UPDATE_SCREENSHOTS"):
        kept.write_bytes(png)
    new, old = (
        matplotlib.image.imread(io.BytesIO(p)) for p in (png, kept.read_bytes())
    )
    assert new.shape == old.shape == (*SIZE[::-1], new.shape[2])
    # Where there is ink: the same report, though its numbers may be others.
    ink = [np.abs(p[..., :3] - p[0, 0, :3]).max(-1) > 0.1 for p in (new, old)]
    rows = [i.reshape(26, -1).mean(1) for i in ink]
    assert 0.02 < ink[0].mean() < 0.6
    assert np.corrcoef(*rows)[0, 1] > 0.7
    page_text = "".join(p.read_text() for p in (ROOT / "docs").glob("*.md"))
    assert f"]({kept.name})" in page_text

"""A report in a real browser: quiet, alone, responsive, printable."""

import base64
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from easi_jax.io.report import figures, gap_figures
from easi_jax.io.report.html import ParameterRow, Picture, Report, Table, write_report
from tests.browser import Page, chromium, page

BROWSER = chromium()
pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine"),
    pytest.mark.timeout(180),
]
EVIL = '<script>document.title = "harmed"</script>'


def drawn(folder: Path) -> Path:
    """A report with every kind of figure, and a hostile name."""
    rng = np.random.default_rng(0)
    steps, t = np.arange(1, 11) * 10_000, np.linspace(0.0, 0.2, 21)
    rise = 150 * (1 - np.exp(-np.arange(10) / 3))[:, None]
    curves = {
        "UDR": (steps, 0.6 * rise + rng.normal(0, 8, (10, 5))),
        "EASI": (steps, rise + rng.normal(0, 8, (10, 5))),
    }
    mean = 0.3 + 0.2 * np.exp(-np.arange(20) / 5)[:, None] * [1.0, -0.5]
    motion = np.sin(20 * t)[None, :, None] * np.ones((3, 1, 1))
    pictures = [
        Picture("By step", figures.returns_by_step(curves), "Returns rise."),
        Picture(
            "By method",
            figures.returns_by_method({k: y[-1] for k, (_, y) in curves.items()}),
            "EASI returns more.",
        ),
        Picture(
            "Parameters",
            figures.parameters_by_generation(
                *(mean, 0.1 * mean, ["length", EVIL], ["m", "kg"]), truth=[0.3, 0.3]
            ),
            "Means go to the truth.",
        ),
        Picture(
            "Traces",
            gap_figures.traces(
                t, motion, 1.3 * motion, 1.02 * motion, ["hip"], ["rad"]
            ),
            "The repaired model follows.",
        ),
    ]
    row = ParameterRow(
        EVIL, ("body.b.mass",), "kg", (0.1, 1.0), 0.3, 0.01, "determined"
    )
    wide = Table("Wide", [f"column {k}" for k in range(12)], [list(range(12))])
    report = Report(
        title=f"A {EVIL}",
        headline=["Return rises from 90 to 150."],
        command="python -m train.easi --out " + "long/" * 30,
        parameters=[row],
        tables=[wide],
        pictures=pictures,
        config={"seed": 0},
    )
    path = folder / "report.html"
    write_report(path, report)
    return path


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drawn(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    assert BROWSER is not None
    with page(BROWSER, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def test_quiet_and_alone(tab: Page, report: Path) -> None:
    tab.open(report)
    wrong = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
    assert tab.told(*wrong) == []
    asked = [
        e["params"]["request"]["url"] for e in tab.told("Network.requestWillBeSent")
    ]
    assert [u for u in asked if not u.startswith("data:")] == [report.as_uri()]
    assert tab.value("document.title") == f"A {EVIL}"
    assert tab.value("document.scripts.length") == 0


def test_pictures_have_words(tab: Page, report: Path) -> None:
    tab.open(report)
    shown = tab.ask("Accessibility.getFullAXTree")["nodes"]
    images = [
        n["name"]["value"] for n in shown if n.get("role", {}).get("value") == "image"
    ]
    assert images == [
        *("Returns rise.", "EASI returns more.", "Means go to the truth."),
        "The repaired model follows.",
    ]


def test_a_curve_under_the_pointer_stands_out_and_says_what_it_is(
    tab: Page, report: Path
) -> None:
    tab.open(report, height=6000)
    count = tab.value("document.querySelectorAll('.told').length")
    assert count == 12 + 10 + 2 + 9
    told = tab.value(
        "[...document.querySelectorAll('.told title')].map(x => x.innerHTML)"
    )
    assert told[5].startswith("UDR, median: ")
    for index in (5, 12):  # a curve, a dot
        place = tab.value(
            f"""(() => {{
                const it = document.querySelectorAll('.told')[{index}];
                const path = it.querySelector(':scope > path');
                const at = path.getPointAtLength(path.getTotalLength() / 2);
                const p = new DOMPoint(at.x, at.y).matrixTransform(path.getScreenCTM());
                return [p.x, p.y];
            }})()"""
        )
        seen = (
            f"(() => {{ const it = document.querySelectorAll('.told')[{index}];"
            "const x = getComputedStyle(it.querySelector('use') || it.children[1]);"
            "return it.querySelector('use') ? x.fillOpacity : x.strokeOpacity; })()"
        )
        tab.point(2, 2)
        assert tab.value(seen) == "0"
        tab.point(*place)
        assert tab.value(seen) == "0.3"


def test_narrow_screens_do_not_scroll_sideways(tab: Page, report: Path) -> None:
    for width in (1200, 400):
        tab.open(report, width=width)
        assert tab.value("document.documentElement.scrollWidth") <= width


def test_details_open(tab: Page, report: Path) -> None:
    tab.open(report, height=6000)
    x, y = tab.value(
        "(() => { const r = document.querySelector('summary').getBoundingClientRect();"
        "return [r.x + 20, r.y + r.height / 2]; })()"
    )
    assert tab.value("document.querySelector('details').open") is False
    tab.press(x, y)
    assert tab.value("document.querySelector('details').open") is True


def test_it_prints(tab: Page, report: Path) -> None:
    tab.open(report)
    printed = tab.ask("Page.printToPDF", printBackground=True)
    pdf = base64.b64decode(printed["data"])
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) >= 2

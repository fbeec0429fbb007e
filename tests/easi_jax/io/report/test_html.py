import html.parser
import re

import pytest

from easi_jax.errors import UserError
from easi_jax.io.report import figures
from easi_jax.io.report.figure_style import FAINT
from easi_jax.io.report.html import (
    Diagnostic,
    ParameterRow,
    Picture,
    Report,
    Table,
    render,
    write_report,
)

VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(html.parser.HTMLParser):
    """Checks nesting and unique names; keeps text, references and tags."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.refs, self.tags, self.words = [], [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("href", "xlink:href", "src"):
                self.refs.append(value)
            self.refs += [f"#{x}" for x in re.findall(r"url\(#([^)]+)\)", value or "")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def _row(**changes):
    given = {
        "name": "cart_mass",
        "addresses": ("body.cart.mass",),
        "unit": "kg",
        "initial": (0.1, 0.9),
        "mean": 0.3015,
        "std": 0.0066,
        "flag": "determined",
    }
    return ParameterRow(**{**given, **changes})


@pytest.fixture(scope="module")
def report():
    curves = {"UDR": ([0, 1], [[1.0], [2.0]])}
    svg = figures.returns_by_step(curves)
    return Report(
        title="EASI on <Cartpole>",
        headline=["Return rises from 152.2 to 186.1."],
        command="python -m train.easi --out a",
        parameters=[
            _row(truth=0.3),
            _row(name="pole_mass", flag="not determined"),
            _row(name="cart_limit", flag="at bound", bounds=(0.3, 9.0)),
        ],
        undetermined=["The overall scale changes nothing."],
        tables=[
            Table("Held-out error", ("channel", "RMS"), [("cart", 0.0021)], "Run 2.")
        ],
        pictures=[
            Picture("Training", svg, 'Two "curves" & a <line>', "Thin: seeds."),
            Picture("Training again", svg, "The same"),
        ],
        diagnostics=[
            Diagnostic("non-finite simulations", 0),
            Diagnostic("at a bound", 1, ok=False, note="widen cart_limit"),
        ],
        notes=["run 2: 3 rows dropped"],
        config={"seed": 0, "search": {"rate": 3e-4, "logs": ["a.csv", "b.csv"]}},
        versions={"packages": {"jax": "0.10.2"}, "commit": None},
    )


@pytest.fixture(scope="module")
def page(report):
    return Page(render(report))


def test_everything_given_is_shown(page):
    for words in (
        "EASI on <Cartpole>",
        "Return rises from 152.2 to 186.1.",
        "python -m train.easi --out a",
        "body.cart.mass",
        "0.3015 ± 0.0066",
        "+0.5 %",
        "0.1 to 0.9",
        "not determined",
        "lower bound 0.3",
        "The overall scale changes nothing.",
        "Run 2.",
        "0.0021",
        "Thin: seeds.",
        "widen cart_limit",
        "run 2: 3 rows dropped",
        "search.rate 0.0003",
        "search.logs a.csv, b.csv",
        "packages.jax 0.10.2",
    ):
        assert words in page.text, words


def test_page_needs_no_network_and_runs_no_script(page, report):
    assert "script" not in {tag for tag, _ in page.tags}
    assert page.refs
    assert all(ref.startswith("#") for ref in page.refs)
    assert "@import" not in render(report)
    policy = [a for t, a in page.tags if a.get("http-equiv")]
    assert policy[0]["content"].startswith("default-src 'none'")


def test_names_are_unique_and_references_resolve(page):
    assert len(page.ids) == len(set(page.ids))
    assert {ref[1:] for ref in page.refs} <= set(page.ids)


def test_pictures_have_alt_text_and_follow_the_theme(page, report):
    labels = [a["aria-label"] for t, a in page.tags if t == "svg"]
    assert labels == ['Two "curves" & a <line>', "The same"]
    assert FAINT in report.pictures[0].svg
    assert FAINT not in render(report)
    assert "var(--faint)" in render(report)


def test_unknown_values_are_not_shown_as_known(report):
    text = render(report)
    shown = text[text.index("pole_mass") :]
    assert 'class="number weak">0.3015 ± 0.0066' in shown[: shown.index("</tr>")]


@pytest.mark.fault("markup in names")
def test_foreign_text_is_escaped():
    evil = "<script>alert(1)</script>"
    text = render(
        Report(
            title=evil,
            headline=[evil],
            command=evil,
            parameters=[_row(name=evil, unit=evil, addresses=(evil,))],
            undetermined=[evil],
            tables=[Table(evil, (evil,), [(evil,)], evil)],
            pictures=[Picture(evil, "<svg></svg>", evil, evil)],
            diagnostics=[Diagnostic(evil, evil, note=evil)],
            notes=[evil],
            config={evil: evil},
        )
    )
    assert "<script" not in text
    assert Page(text).text.count(evil) >= 14


def test_empty_sections_are_left_out():
    page = Page(render(Report("Title", ["One sentence."])))
    assert [tag for tag, _ in page.tags if tag in ("h2", "table", "details")] == []
    assert page.text.endswith("One sentence.")


def test_truth_columns_only_where_a_truth_is_known():
    with_truth = Page(render(Report("T", [], parameters=[_row(truth=0.0)])))
    assert "truth" in with_truth.words
    assert "truth" not in Page(render(Report("T", [], parameters=[_row()]))).words


@pytest.mark.fault("disk full, folder read-only")
def test_written_whole_or_refused(tmp_path, report):
    write_report(tmp_path / "report.html", report)
    written = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert written == render(report)
    with pytest.raises(UserError, match="cannot write"):
        write_report(tmp_path / "report.html" / "x.html", report)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == written


def test_a_change_has_no_more_digits_than_its_deviation_leaves():
    assert _row(nominal=0.3, mean=0.3704, std=0.004).change == "x 1.23"
    assert _row(nominal=0.3, mean=0.3704, std=0.1).change == "x 1.2"

"""One self-contained ``report.html`` for people: no network, light and dark, prints."""

import dataclasses
import html
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jinja2

from easi_jax.io.files import atomic_write, to_plain
from easi_jax.io.report.figure_style import BLUE, FAINT, GREEN, GRID, INK, VERMILION
from easi_jax.io.report.numbers import cell, number, quantity, shown_unit
from easi_jax.model.results import Flag

# `Flag`, or what follows from what the owner of the machine knows.
Known = Literal[Flag, "relative", "taken"]

_KINDS = {
    **dict.fromkeys(("determined", "relative"), "good"),
    "taken": "plain",
    "at bound": "bad",
}
Svg = str | Callable[[], str]

# Colors that need another shade on a dark page.
_THEMED = {
    INK: "--ink",
    FAINT: "--faint",
    GRID: "--line",
    BLUE: "--blue",
    VERMILION: "--vermilion",
    GREEN: "--green",
}


@dataclasses.dataclass(frozen=True)
class ParameterRow:
    """One identified parameter, in SI units.

    Attributes:
        name: as declared.
        addresses: places in the model that it sets.
        unit: ``""`` where it has none.
        initial: range the search started from.
        mean: of the distribution found.
        std: of the distribution found.
        flag: what may be believed of it.
        truth: where it is known.
        bounds: where it may go; given with the flag ``at bound``.
        nominal: the model's value.
        depends: parameters taken from the model that a ``relative`` value rests on.
        region: whether ``std`` may be stated.
    """

    name: str
    addresses: tuple[str, ...]
    unit: str
    initial: tuple[float, float]
    mean: float
    std: float
    flag: Known
    truth: float | None = None
    bounds: tuple[float, float] | None = None
    nominal: float | None = None
    depends: tuple[str, ...] = ()
    region: bool = True

    @property
    def found(self) -> str:
        """What was found, with its standard deviation where one may be stated."""
        if self.flag == "taken" or not self.region:
            return number(self.mean)
        return quantity(self.mean, self.std)

    @property
    def change(self) -> str:
        """A multiple of the model's value, where what was found can be believed; two
        digits where the deviation leaves no more."""
        if self.flag not in ("determined", "relative") or not self.nominal:
            return "-"
        digits = 3 if self.std < 0.1 * abs(self.mean) else 2
        return f"x {number(self.mean / self.nominal, digits)}"

    @property
    def verdict(self) -> str:
        """What may be believed of it."""
        if self.flag == "taken":
            return "taken from the model"
        given = f"given {', '.join(self.depends)}"
        said = given if self.flag == "relative" else self.flag
        return said if self.region else f"{said}; no region"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of results; numbers are shown with four digits.

    Attributes:
        title: heading.
        columns: heads.
        rows: cells; strings stay as they are.
        note: one sentence below, such as what was held out.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure of ``easi_jax.io.report.figures``.

    Attributes:
        title: heading.
        svg: its SVG text, or what draws it; trusted, so it must not come from outside.
        alt: what it shows, for who cannot see it.
        caption: one sentence below.
        file: name of its file in a run's ``figures/``, where it has one.
    """

    title: str
    svg: Svg
    alt: str
    caption: str = ""
    file: str = ""

    @property
    def text(self) -> str:
        """The SVG text, drawn now where it is not yet."""
        return self.svg if isinstance(self.svg, str) else self.svg()


@dataclasses.dataclass(frozen=True)
class Diagnostic:
    """One check of the run.

    Attributes:
        label: such as ``non-finite simulations``.
        value: what was found.
        ok: False draws the eye.
        note: what it means or what to do.
    """

    label: str
    value: str | float | int
    ok: bool = True
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Report:
    """Everything a report shows; empty sections are left out.

    Attributes:
        title: such as ``EASI on Cartpole``.
        headline: the result in one sentence or a few.
        command: that made it.
        parameters: one row each.
        undetermined: directions that the data do not determine, one sentence each.
        tables: held-out errors, returns and the like.
        pictures: figures in their order.
        diagnostics: checks of the run.
        notes: remarks from reading logs and from resuming.
        config: the run's configuration.
        versions: as ``easi_jax.io.runs.versions.versions`` gives them.
    """

    title: str
    headline: Sequence[str]
    command: str = ""
    parameters: Sequence[ParameterRow] = ()
    undetermined: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    diagnostics: Sequence[Diagnostic] = ()
    notes: Sequence[str] = ()
    config: Any = None
    versions: Mapping[str, Any] | None = None


def write_report(path: Path, report: Report) -> None:
    """Writes ``report`` as one HTML file, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    atomic_write(path, render(report))


def render(report: Report) -> str:
    """The HTML text of ``report``."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"cell": cell, "numeric": _numeric}
    environment.tests["numeric"] = _numeric
    return environment.get_template("report.html.j2").render(
        report=report,
        parameters=[_parameter_cells(row) for row in report.parameters],
        has_truth=any(row.truth is not None for row in report.parameters),
        has_model=any(row.nominal is not None for row in report.parameters),
        pictures=[(p, inline_svg(p, i)) for i, p in enumerate(report.pictures)],
        config=list(flatten(to_plain(report.config))),
        versions=list(flatten(to_plain(report.versions))),
    )


def inline_svg(picture: Picture, index: int) -> str:
    """The picture's SVG for use inside a page.

    Its names become unique within the page, its size and colors the page's.
    """
    drawn = picture.text
    text = drawn[drawn.index("<svg") :]
    prefix = f"p{index}-"
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r"url\(#", f"url(#{prefix}", text)
    text = re.sub(r'href="#', f'href="#{prefix}', text)
    for color, name in _THEMED.items():
        text = text.replace(color, f"var({name})")
    root, rest = text.split(">", 1)
    root = re.sub(r'\s(width|height)="[^"]*"', "", root)
    label = html.escape(picture.alt, quote=True)
    return f'{root} role="img" aria-label="{label}">{rest}'


def flatten(tree: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted names and values of a nested mapping."""
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from flatten(value, f"{prefix}.{key}" if prefix else str(key))
    elif prefix:
        values = tree if isinstance(tree, list) else [tree]
        # In full, where cell() would round: these are to be copied.
        texts = [repr(v) if isinstance(v, float) else cell(v) for v in values]
        yield prefix, ", ".join(texts)


def _parameter_cells(row: ParameterRow) -> dict[str, Any]:
    error = ""
    if row.truth is not None and row.truth != 0 and row.flag != "taken":
        off = round(100 * (row.mean / row.truth - 1), 1)
        error = f"{off + 0.0:+.1f} %"  # no -0.0
    flag = row.flag
    note = ""
    if flag == "at bound" and row.bounds is not None:
        low, high = row.bounds
        lower = abs(row.mean - low) <= abs(row.mean - high)
        note = f"lower bound {cell(low)}" if lower else f"upper bound {cell(high)}"
    return {
        "name": row.name,
        "addresses": row.addresses,
        "unit": shown_unit(row.unit),
        "initial": f"{cell(row.initial[0])} to {cell(row.initial[1])}",
        "model": cell(row.nominal),
        "value": row.found,
        "change": row.change,
        "truth": cell(row.truth),
        "error": error,
        "flag": row.verdict,
        "kind": _KINDS.get(flag, "unsure"),
        "note": note,
    }


def _numeric(text: str) -> bool:
    return re.match(r"\(?[-+]?\d|-$|not a number$|-?infinite$", text) is not None

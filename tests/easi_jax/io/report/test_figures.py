import re
import xml.etree.ElementTree as ET

import matplotlib
import numpy as np
import pytest

from benchmarks.fuzz_readers import harmless
from easi_jax.io.report import figures, gap_figures
from easi_jax.io.report.figure_style import _log_ticks
from easi_jax.io.report.html import Picture, inline_svg

SVG = "{http://www.w3.org/2000/svg}"


def _texts(svg):
    return ["".join(node.itertext()) for node in ET.fromstring(svg).iter(f"{SVG}text")]


def _parameters(**changes):
    mean = np.linspace([2.0, 1e-4], [1.0, 1e-3], 12)
    given = {
        "mean": mean,
        "std": 0.3 * mean,
        "names": ["cart_mass", "price $x$ <&>"],
        "units": ["kg", ""],
        "truth": [1.0, np.nan],
        "initial": [[0.3, 3.0], [1e-5, 1e-2]],
        "log": [False, True],
    }
    return figures.parameters_by_generation(**{**given, **changes})


def test_parameters_by_generation_names_everything():
    texts = _texts(_parameters())
    assert {"cart_mass [kg]", "price $x$ <&>", "generation"} <= set(texts)
    assert {"mean", "± 2 std", "truth", "start range"} <= set(texts)
    plain = _texts(_parameters(truth=None, initial=None))
    assert not {"truth", "start range"} & set(plain)


def test_truth_changes_the_picture_only_where_it_is_known():
    known = _parameters(truth=[1.0, 5e-4])
    dashes = [svg.count("stroke-dasharray") for svg in (_parameters(), known)]
    assert dashes[1] == dashes[0] + 1


@pytest.mark.parametrize("log", [True, False])
@pytest.mark.parametrize(
    "mean",
    [[[np.nan], [np.nan]], [[0.0], [0.0]], [[1.0], [np.inf]], [[5.0]], [[-1.0], [2.0]]],
)
def test_degenerate_histories_still_draw(mean, log):
    svg = figures.parameters_by_generation(mean, np.abs(mean), ["a"], ["m"], log=[log])
    assert "a [m]" in _texts(svg)


def test_returns_show_every_seed_and_the_method_names():
    steps = np.arange(4)
    curves = {"UDR": (steps, np.ones((4, 3))), "EASI": (steps, 2 * np.ones((4, 5)))}
    svg = figures.returns_by_step(curves)
    assert {"UDR", "EASI", "environment steps"} <= set(_texts(svg))
    lines = re.findall(r"stroke-opacity: 0\.45", svg)
    assert len(lines) == 8


def test_dots_show_every_seed_and_the_median():
    svg = figures.returns_by_method({"UDR": [1.0, 2.0, 9.0], "EASI": [5.0, np.nan]})
    assert {"UDR", "EASI", "2", "5"} <= set(_texts(svg))
    assert len(re.findall(r"<use [^>]*fill-opacity: 0\.75", svg)) == 4


def test_methods_without_any_return_still_draw():
    nothing = np.full((2, 2), np.nan)
    assert "UDR" in _texts(figures.returns_by_method({"UDR": nothing[0]}))
    figures.returns_by_step({"UDR": ([0, 1], nothing)})


def test_prediction_errors_write_each_value():
    errors = {"nominal": [0.5, 20.0], "identified": [0.125, np.nan]}
    svg = figures.prediction_errors(
        errors, ["x", "theta"], ["m", "rad"], floor=[0.1, 1]
    )
    texts = [text.strip() for text in _texts(svg)]
    assert {"nominal", "identified", "x [m]", "theta [rad]"} <= set(texts)
    assert {"0.5", "0.125", "20", "not finite", "noise floor"} <= set(texts)


def test_same_data_give_the_same_text_and_global_style_is_left_alone():
    before = dict(matplotlib.rcParams)
    assert _parameters() == _parameters()
    assert dict(matplotlib.rcParams) == before


def test_log_ticks_lie_inside_and_are_few():
    for low, high in [(1e-5, 1e-2), (0.9, 1.3), (2e-4, 7e-4), (1e-9, 1e9), (4.1, 4.2)]:
        ticks = _log_ticks(low, high)
        assert 2 <= len(ticks) <= 5
        assert all(low <= tick <= high for tick in ticks)


EVIL = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "]]></text><script>alert(1)</script>",
    "$\\frac{$",
]


@pytest.mark.parametrize(
    "draw",
    [
        lambda n: _parameters(names=n[:2], units=n[2:]),
        lambda n: figures.returns_by_step({x: (np.arange(3), np.ones(3)) for x in n}),
        lambda n: figures.returns_by_method({x: np.ones(2) for x in n}),
        lambda n: figures.prediction_errors({x: np.ones(4) for x in n}, n, n),
        lambda n: gap_figures.gap_steps(n, [1.0] * 4, 0.5, 1.5, 0.1),
        lambda n: gap_figures.residual_maps(
            n, n, np.ones((4, 4)), np.ones((4, 4)), np.ones(4)
        ),
        lambda n: gap_figures.traces(
            np.arange(3.0), *[np.zeros((1, 3, 4))] * 3, names=n, units=n
        ),
    ],
)
def test_names_are_text_and_nothing_else(draw):
    svg = draw(EVIL)
    shown = " ".join(_texts(svg))
    assert all(name in shown for name in EVIL)
    tags = {node.tag.removeprefix(SVG) for node in ET.fromstring(svg).iter()}
    assert not tags & {"script", "img", "a", "foreignObject"}
    harmless(inline_svg(Picture("t", svg, EVIL[1]), 0))


def _map_font(columns: int) -> float:
    names = [f"speed_{i}" for i in range(columns)]
    values = np.linspace(1.0, 777.0, 3 * columns).reshape(3, columns)
    svg = gap_figures.residual_maps(["a", "b", "c"], names, values, values, np.ones(3))
    shown = re.findall(r"<text[^>]*font-size: ([\d.]+)px[^>]*>([\d.]+)</text>", svg)
    sizes = [size for size, text in shown if text in ("1.0", "777")]
    assert len(sizes) == 4
    return float(sizes[0])


def test_labels_of_a_heat_map_fit_their_cells():
    assert _map_font(40) < _map_font(24) < _map_font(3)

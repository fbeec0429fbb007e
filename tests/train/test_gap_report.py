"""The report of train.gap: what it says, and hostile names in the model or the logs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fuzz_readers import harmless
from easi_jax.io.report.gap_report import (
    effect_rows,
    gap_json,
    gap_report,
    headline,
    map_picture,
    steps_picture,
    traces_picture,
)
from easi_jax.io.report.html import render
from easi_jax.model.results import ErrorMap, GapFigures, Retrained, Traces
from tests.gap_results import effect, result
from train.gap import Config

EVIL = "<script>alert(1)</script>"
HANDLER = '"><img src=x onerror=alert(1)>'


@pytest.mark.timeout(120)
@pytest.mark.fault("markup in names")
def test_names_do_no_harm() -> None:
    one, flat = np.ones((1, 1)), np.zeros((3, 4, 1))
    found = result(
        EVIL,
        HANDLER,
        readings=(
            effect("sensor_delay", f"qvel.{HANDLER}", "sensor", rival=""),
            effect("sensor_bias", EVIL, "sensor", rival=""),
        ),
    )
    pictures = [
        steps_picture(found),
        map_picture(ErrorMap((EVIL,), (HANDLER,), one, one, np.ones(1))),
        traces_picture(Traces(np.arange(4.0), flat, flat, flat, (EVIL,), (HANDLER,))),
    ]
    pictures.append(dataclasses.replace(pictures[0], title=EVIL, alt=HANDLER))
    config = dataclasses.replace(Config(), model=EVIL, data=(Path(HANDLER),))
    page = render(gap_report(found, pictures, config))
    harmless(page)
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") > 15
    assert "onerror" in page  # shown as text


def test_an_effect_with_which_the_error_rises_is_marked() -> None:
    falls, rises = effect(), effect("armature", unit="kg m^2", gaps=(0.1, 0.15))
    found = result(effects=(falls, rises))
    first, second = (s for s in headline(found) if "which the model lacks" in s)
    assert "falls from 2 times the sensor noise to the noise itself" in first
    assert "on held-out data rises, from 1 to 1.5 times the sensor noise" in second
    changes = [row[4] for row in effect_rows(found, "; ", "none")]
    assert changes == ["0.2 to 0.1", "0.1 to 0.15, rises"]
    assert "+ armature@hinge (rises)" in str(steps_picture(found).svg)
    assert "the held-out gap rises is marked" in render(gap_report(found))
    assert "rises" not in render(gap_report(result()))


def test_numbers_are_those_that_people_write() -> None:
    page = render(gap_report(result()))
    assert "With it the 0.2 s prediction error falls" in page
    assert "RMS over windows of 0.2 s" in page and "0.200009" not in page
    assert "torque 0.100 ± 0.010 rad" in page and "50 %" in page


def test_a_result_with_nothing_in_it_has_a_report() -> None:
    """No effect, no place of the error, no noise, figures that are not finite."""
    unknown = float("nan"), float("nan")
    none = GapFigures(float("nan"), unknown, (float("inf"),), (unknown,), 7)
    found = result(
        effects=(),
        refitted=(),
        where=None,
        record_next=(),
        floor=0.0,
        before=none,
        refit=none,
        after=none,
    )
    page = render(gap_report(found, [steps_picture(found)]))
    assert "A gap of not a number remains" in page
    told = gap_json(found)
    assert told["where"] == [] and told["not_finite"] == 7
    # With another verdict, an effect beside a floor of nothing.
    assert "infinite" in " ".join(headline(result(floor=0.0)))


def test_gap_json_holds_every_key_of_the_format() -> None:
    told = gap_json(
        result(retrained=Retrained("cartpole", 2400, {"0": 1.0}, {"0": 2.0}))
    )
    assert list(told) == [
        *("schema", "verdict", "effects", "refitted", "gap", "unexplained_share"),
        *("gap_si", "undecided", "horizon_seconds", "start_seconds", "not_finite"),
        *("ignored", "held_out", "where", "disagreeing_runs", "record_next", "notes"),
        *("seconds", "law_seconds", "not_in_model_xml", "retrained"),
    ]
    (named,) = told["effects"]
    assert named == {
        "effect": "coulomb_friction",
        "at": "hinge",
        "kind": "joint",
        "parameters": {"torque": {"value": 0.1, "std": 0.01, "unit": "rad"}},
        "confidence": 0.9,
        "explains": pytest.approx((0.2**2 - 0.1**2) / (0.2**2 - 0.1**2)),
        "removal_cost": 0.7,
        "removal_sure": None,
        "rival_odds": None,
        "outcome": "converged",
        "indistinguishable": ("viscous_damping@rad",),
        "gap_after": 0.1,
    }
    channel = told["gap_si"]["hinge"]
    assert channel["unit"] == "rad" and channel["open"] is True
    assert "floor_is_upper_bound" not in channel
    assert channel["after_95"] == (0.8, 1.3) and told["gap"]["open"] is False
    assert told["unexplained_share"] == pytest.approx(1.0)
    assert told["undecided"] == ["cart"]
    assert told["retrained"]["with"] == {"0": 2.0}

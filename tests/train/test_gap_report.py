"""The report of train.gap when names in the model or the logs are hostile."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.fuzz_readers import harmless
from easi_jax.gap.sensor_faults import ReadingFault
from easi_jax.io.report.gap_figures import residual_maps
from easi_jax.io.report.html import Picture
from train import _gap_results
from train.gap import Config

EVIL = "<script>alert(1)</script>"
HANDLER = '"><img src=x onerror=alert(1)>'


def outcome() -> Any:
    """One effect at a joint, a run that disagrees, a channel left out."""
    figures = SimpleNamespace(gap=0.2, interval=(0.1, 0.3), si=np.ones(1))
    found = SimpleNamespace(
        parts=(),
        place=SimpleNamespace(
            effect="coulomb_friction", at=EVIL, kind="joint", key=f"friction@{EVIL}"
        ),
        values={"torque": (0.1, 0.01, HANDLER)},
        confidence=0.9,
        gap_after=0.1,
        indistinguishable=[f"viscous_damping@{HANDLER}"],
    )
    return SimpleNamespace(
        channels=SimpleNamespace(
            names=[EVIL],
            units=[HANDLER],
            scale=np.ones(1),
            ignored={HANDLER: EVIL},
        ),
        verdict="unexplained",
        **{"before": figures, "refit": figures, "after": figures, "floor": 0.1},
        floor_si=np.ones(1),
        found=[found],
        disagreeing={EVIL: 3.0},
        notes=[EVIL, HANDLER],
        horizon=0.2,
        record_next=[EVIL],
        refitted=[{"address": f"joint.{EVIL}.damping", "from": 1, "to": 2, "std": 1}],
    )


@pytest.mark.timeout(120)
@pytest.mark.fault("markup in names")
def test_names_do_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = np.ones((1, 1))
    svg = residual_maps([EVIL], [HANDLER], one, one, np.ones(1))
    monkeypatch.setattr(
        _gap_results, "_residual_map", lambda *_: [Picture(EVIL, svg, HANDLER, EVIL)]
    )
    monkeypatch.setattr(_gap_results, "_telling", lambda _: np.arange(1))
    monkeypatch.setattr(
        _gap_results, "_traces", lambda *_: tuple(np.zeros((3, 1, 4, 1)))
    )
    problem = SimpleNamespace(
        model=SimpleNamespace(name=EVIL),
        readings=[
            ReadingFault(
                "sensor_delay",
                f"qvel.{HANDLER}",
                {"late": 0.01},
                {"late": 0.001},
                {"delay": (0.01, 0.001, "s")},
                0.9,
            ),
            ReadingFault(
                "sensor_bias",
                EVIL,
                {"bias": 0.1},
                {"bias": 0.01},
                {"bias": (0.1, 0.01, "m")},
                0.9,
            ),
        ],
        fit=[SimpleNamespace(dt=0.01)],
        held_name=EVIL,
    )
    content = {"where": [{"at": EVIL, "share": 0.5, "when": HANDLER}]}
    config = dataclasses.replace(Config(), model=EVIL, data=(Path(HANDLER),))
    path = _gap_results._report(
        SimpleNamespace(path=tmp_path), config, problem, outcome(), content
    )
    page = path.read_text(encoding="utf-8")
    harmless(page)
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") > 15
    assert "onerror" in page  # shown as text

"""What grows is timed once, and shown for every device."""

import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks import scaling, scaling_summary
from benchmarks._page import shown
from envs import make

SMALL = scaling.Config(
    populations=(8, 16), horizons=(1,), seeds=(1,), generations=1, iterations=1
)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list:
    """Sizes that are timed, in place of timing them."""
    asked: list = []

    def generation(_config, _env, _mesh, space, **search) -> dict[str, float]:
        asked.append(search or space.size)
        return {"seconds": 0.5, "control_steps_per_s": 2000.0}

    def training(*args) -> dict[str, float]:
        asked.append(args[-1])
        return {"seconds": 0.25, "control_steps_per_s": 400.0}

    monkeypatch.setattr(scaling, "_generation", generation)
    monkeypatch.setattr(scaling, "_training", training)
    return asked


def test_a_stopped_run_goes_on(tmp_path: Path, counted: list) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path / "scaling.jsonl")
    rest = [{"horizon": 1}, 1]
    scaling.run(config)
    assert counted == [4, 5, 11, *({"population": p} for p in (8, 16)), *rest]
    lines = config.out.read_text().splitlines()
    config.out.write_text("\n".join(lines[:4]) + "\n")
    del counted[:]
    scaling.run(config)
    assert counted == [{"population": 16}, *rest]
    (text,) = [t for t in shown(scaling_summary.SECTIONS, tmp_path) if "| 8 |" in t]
    assert "0.5 (2,000)" in text and text.count("cartpole, ") == 1


def test_every_part_of_a_go2() -> None:
    space = scaling.every_part(make("go2").mj_model)
    assert space.size == 117 and "body_FL_calf_com_z" in space.names
    low, high = space.initial
    assert ((low <= space.nominal) & (space.nominal <= high)).all()


def test_what_was_not_run_is_said(tmp_path: Path) -> None:
    assert "Not run" in shown(scaling_summary.SECTIONS, tmp_path)[1]


def test_more_machines_on_paper(tmp_path: Path) -> None:
    fixed, each = scaling_summary.line_through(
        [300, 1024, 4096], [0.13, 0.2024, 0.5096]
    )
    assert (fixed, each) == pytest.approx((0.1, 1e-4))
    assert scaling_summary.gathering(8e9, 8, 1e9, 0.5) == pytest.approx(7.0 + 1.5)
    rows = [
        {
            **{"robot": "ant", "option": [], "devices": 2, "device": "cpu"},
            **{"what": "population", "size": n, "seconds": 0.1 + 1e-4 * n},
            **{"control_steps_per_s": 1.0, "gathered_bytes": 1e5 * n},
        }
        for n in (1000, 2000)
    ]
    told, table = scaling_summary.on_paper(rows)
    assert told.startswith("On paper")
    # 0.1 + 0.1 / 8 s, 1e8 bytes to 7/8 in 0.07 s and three latencies.
    assert "| ant, 2 cores | 1000 | 0.2 | 0.183 (38%) | " in table
    assert scaling_summary.on_paper(rows[:1]) == []
    # More devices than cores are shown, and nothing is reckoned from them.
    known = {"versions": {"commit": None, "runtime": {"cores": 1}}}
    assert scaling_summary.on_paper([r | known for r in rows]) == []
    (tmp_path / "scaling.jsonl").write_text(
        "".join(
            json.dumps(r | known | {"control_steps_per_s": 1.0}) + "\n" for r in rows
        )
    )
    page = "\n".join(shown(scaling_summary.SECTIONS, tmp_path))
    assert "| ant, 2 virtual devices on 1 cores | 0.2 (1) | 0.3 (1) |" in page
    drawn = scaling_summary.figures(tmp_path)["scaling.svg"]
    assert "ant, 2 virtual devices on 1 cores" in drawn and ">2000<" in drawn


def test_one_population_alone_bounds_what_more_gpus_bring() -> None:
    ant = {"robot": "ant", "option": []}
    cpu = ant | {"devices": 1, "device": "cpu", "what": "population", "seconds": 9.0}
    rows = [cpu | {"size": 3000, "gathered_bytes": 4.5e9}]
    gpu = ant | {"devices": 1, "device": "H100", "what": "parameters"}
    rows += [gpu | {"size": n, "seconds": 0.5} for n in (4, 11)]
    (table,) = scaling_summary.on_paper(rows)[1:]
    # 300 in 0.5 s: 3000 in 0.5 s, or in 5 s / 8; told in 4.5e9 * 7/8 / 450e9 s.
    assert "| ant, 1 H100 | 3000 | not run | 0.509 to 0.634 (2% to 1%) |" in table


@pytest.mark.slow
def test_more_individuals_take_longer(tmp_path: Path) -> None:
    config = dataclasses.replace(
        SMALL, populations=(64, 4096), out=tmp_path / "scaling.jsonl"
    )
    scaling.run(config)
    rows = [json.loads(line) for line in config.out.read_text().splitlines()]
    small, large = (r["seconds"] for r in rows if r["what"] == "population")
    assert large > 2 * small

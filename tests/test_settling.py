"""`benchmarks.settling`: which trainings there are, and when one has settled."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import settling
from benchmarks._page import shown
from benchmarks.settling import Cell, Config, added, cells, settings_of
from easi_jax.rl.config import PpoConfig, SacConfig
from tests.commands import refused


def test_settings_are_the_presets_but_for_one() -> None:
    plain, apart = (
        settings_of(Cell("ant", s, 1.5, 0)) for s in ("preset", "clipped apart")
    )
    assert isinstance(plain, PpoConfig) and not plain.clip_apart
    assert isinstance(apart, PpoConfig) and apart.clip_apart
    assert plain.env_steps == 6_000_000, "half as many more than the preset's 4 million"
    weak = settings_of(Cell("ballbalance", "rewards x 0.1", 1.0, 0))
    assert isinstance(weak, SacConfig) and weak.reward_scaling == 0.1


def test_no_cell_asks_for_what_an_algorithm_lacks() -> None:
    every = cells(Config(seeds=(0,)))
    assert len({c.key for c in every}) == len(every)
    apart = {c.robot for c in every if c.setting == "clipped apart"}
    assert apart == {"ant", "go2"}, "the others are trained by SAC"
    assert {c.budget for c in every} == {0.5, 1.0, 1.5, 3.0}


def test_what_more_steps_add_is_of_the_same_seeds(tmp_path: Path) -> None:
    def row(budget: float, seed: int, value: float) -> dict[str, Any]:
        cell = Cell("ant", "preset", budget, seed)
        known = {"key": cell.key, "return": value, "steps": round(4e6 * budget)}
        return {**vars(cell), **known, "versions": {"commit": "0123456"}}

    once = [row(1.0, 0, 100.0), row(1.0, 1, 200.0), row(1.0, 2, 900.0)]
    more = [row(1.5, 1, 204.0), row(1.5, 0, 102.0)]
    assert added(once, more) == pytest.approx(0.02)
    assert added([row(1.0, 0, -100.0)], [row(1.5, 0, -90.0)]) == pytest.approx(0.1)
    assert added(once[2:], more) is None
    text = "".join(json.dumps(r) + "\n" for r in once + more)
    (tmp_path / "settling.jsonl").write_text(text)
    page = "\n".join(shown(settling.SECTIONS, tmp_path))
    assert "| 4,000,000 | 400.0 (100.0, 200.0, 900.0) | +2.0%, settled |" in page
    assert "| 6,000,000 | 153.0 (102.0, 204.0) | - |" in page


@pytest.mark.fault("wrong options and files")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robots", "ants"], 'did you mean "ant"'),
        (["--settings", "clip"], "clipped apart"),
        (["--budgets", "0"], "numbers above 0"),
    ],
)
def test_mistakes_are_one_line(words: list[Any], said: str, capsys: Any) -> None:
    assert said in refused(capsys, settling, *words)

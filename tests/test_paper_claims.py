"""One page for the paper's claims, made of committed rows."""

import json
from pathlib import Path

from benchmarks import paper_claims
from benchmarks._common import RESULTS
from benchmarks.paper_claims import Answer
from benchmarks.paper_tables import whole

LINE = "| A policy trained under what EASI found"


def line(folder: Path, begin: str = LINE) -> list[str]:
    text = paper_claims.page(folder)
    (found,) = (x for x in text.splitlines() if x.startswith(begin))
    return [x.strip() for x in found.strip("|").split(" | ")]


def row(method: str, seed: int, value: float) -> dict[str, object]:
    return {
        **{"key": f"{method} {seed}", "method": method, "robot": "cartpole"},
        **{"target": "cart_kp*0.5", "seed": seed, "trajectories": 200},
        **{"env_steps": None, "start": None, "settings": [], "options": []},
        **{"policy": True, "curves": False, "return": value},
    }


def test_committed_page_is_that_of_the_committed_files() -> None:
    assert (RESULTS / "CLAIMS.md").read_text() == paper_claims.page(RESULTS) + "\n"


def test_what_was_not_run_is_said(tmp_path: Path) -> None:
    (tmp_path / "paper.jsonl").write_text("")
    (tmp_path / "engines.jsonl").write_text("")
    text = paper_claims.page(tmp_path)
    assert text.count("| not run | not run |") == len(paper_claims.CLAIMS)


def test_a_verdict_follows_the_figures(tmp_path: Path) -> None:
    (tmp_path / "engines.jsonl").write_text("")

    def verdict(easi: float) -> tuple[str, str]:
        rows = [row("UDR", s, 100.0 + s) for s in (0, 1)]
        rows += [row("EASI default", s, easi + s) for s in (0, 1)]
        text = "".join(json.dumps(r) + "\n" for r in rows)
        (tmp_path / "paper.jsonl").write_text(text)
        found = line(tmp_path)
        return found[2], found[3]

    told, holds = verdict(150.0)
    assert "UDR 100.5 ± 0.7, default 150.5 ± 0.7" in told and holds == "holds"
    assert verdict(90.0)[1] == "**does not hold**"


def test_verdicts_count_cases() -> None:
    assert Answer([], []).verdict == "not run"
    assert Answer(["a"], [True, False]).verdict == "holds in 1 of 2"


def test_every_claim_has_an_answer_in_the_committed_rows() -> None:
    rows = paper_claims.Rows(
        whole(paper_claims.load(RESULTS, "paper.jsonl")),
        paper_claims.load(RESULTS, "engines.jsonl"),
    )
    for claim in paper_claims.CLAIMS:
        answer = claim.ours(rows)
        assert answer.figures and answer.holds, claim.says

"""Thresholds that decide what people are told: one place, and the chance of each."""

import ast
import dataclasses
import inspect
import itertools
import re
from pathlib import Path

import pytest
from scipy.stats import norm, t

from easi_jax.gap import decisions
from easi_jax.gap.decisions import BLOCKS, DECIDE, Decisions

GAP = Path(inspect.getfile(decisions)).parent

# Numbers of other modules: they set how much is computed, or how, and decide nothing.
ELSEWHERE = {
    "analysis": {"_SHORT", "_MIDDLE", "_LONG", "_FITTED", "_LONGEST", "_STEPS"},
    "batched_least_squares": {
        *("_ROUNDS", "_PAYS", "_SETTLED", "_HUBER", "_DIM", "_UNSEEN", "_AT"),
        "_FOLLOWED",
    },
    "candidates": {"_PAIRS"},
    "discretization_error": {"FINER", "_OWN_SHIFT"},
    "effect_search": {"RIVALS", "_STAGES", "_BEAM", "_LOST", "_BLOWS_UP"},
    "excitation_coverage": {"_PAST", "_STILL", "_MOST"},
    "fitting": {"_DRAWS", "_PAIRS", "STEPS_SEEN", "_WHOLE", "_BENT", "_LET_PASS"},
    "forward_selection": {"_LOST"},
    "gap_metric": {"_DRAWS"},
    "law_search": {"_HOLDS", "_RIDGE", "_STIFF"},
    "linear_response": {
        *("_SPACING", "_MOVED", "_LEAST", "_MOST", "_ALIKE", "_STUCK", "_BATCH"),
    },
    "model_comparison": {"_TINY", "_UNLIKELY"},
    "offered_terms": {
        *("_WIDTH", "_BENDS", "_LAGS", "_WARMS", "_PAIRED", "_PLAIN", "_TWO"),
        "_THREE",
    },
    "predictor": {
        *("BLOCK", "_ITEMS", "_STEPPED", "_ACCELERATOR_ITEMS", "_ROW", "_PASSES"),
        "_ROUNDED",
    },
    "result": {"_ANYTHING", "_ALIKE", "_TELLS"},
    "screening": {
        *("_SHORTLIST", "_MORE", "_STARTS", "_HOPELESS", "_FEW", "_LONG", "_SIMULATED"),
        *("_HOLDS", "_AT_ONCE"),
    },
    "sensor_faults": {
        *("_LONGEST", "PIECES", "_SAME_STEP", "_TRIED", "_TRY", "_ROUNDING"),
    },
    "summary": {"_SHOWN", "_LEAST"},
    "verdict": {"_MISSED"},
    "whitening": {"_GROUPS", "_FIRST"},
    "window_set": {"_BEFORE", "_EXTREME"},
}


def numbers(path: Path) -> set[str]:
    """Names of constants of a module that are numbers."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if not isinstance(node, ast.Assign):
            continue
        parts = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
        if all(
            isinstance(x, ast.Constant) and type(x.value) in (int, float) for x in parts
        ):
            for target in node.targets:
                names = target.elts if isinstance(target, ast.Tuple) else [target]
                found |= {x.id for x in names if isinstance(x, ast.Name)}
    return found


def test_no_threshold_stands_elsewhere() -> None:
    """A new number in a module of the workflow belongs to the decisions, or is named
    here as one that decides nothing."""
    found = {p.stem: numbers(p) for p in GAP.glob("*.py") if p.stem != "decisions"}
    assert {k: v for k, v in found.items() if v} == ELSEWHERE


def documented() -> dict[str, str]:
    """The sentences after each field."""
    (body,) = (
        n.body
        for n in ast.parse(inspect.getsource(decisions)).body
        if isinstance(n, ast.ClassDef)
    )
    out = {}
    for node, after in itertools.pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            assert isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            out[node.target.id] = " ".join(str(after.value.value).split())
    return out


def test_each_threshold_is_documented() -> None:
    told = documented()
    assert set(told) == {f.name for f in dataclasses.fields(Decisions)}
    assert all(len(text) > 5 and text.endswith(".") for text in told.values())


@pytest.mark.parametrize(
    ("name", "chance"),
    [
        ("sure", t.sf(DECIDE.sure, BLOCKS - 1)),
        ("likely", t.sf(DECIDE.likely, BLOCKS - 1)),
        ("law_sure", t.sf(DECIDE.law_sure, BLOCKS - 1)),
        ("as_good", t.sf(DECIDE.as_good, BLOCKS - 1)),
        ("bias_sure", 2 * t.sf(DECIDE.bias_sure, BLOCKS - 1)),
        ("interval", 1 - DECIDE.interval),
    ],
)
def test_stated_chances_are_those_of_the_numbers(name: str, chance: float) -> None:
    text = documented()[name]
    (stated,) = re.findall(r"([\d.]+) %", text)
    digits = len(stated.partition(".")[2])
    assert round(100 * chance, digits) == float(stated), (name, 100 * chance)


def test_a_channel_is_seldom_one_by_chance() -> None:
    assert 2 * norm.sf(DECIDE.visible) == pytest.approx(6e-7, rel=0.1)
    assert "6e-7" in documented()["visible"]

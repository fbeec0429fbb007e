"""A killed ``train.pipeline`` goes on to the same end; small and without refinement."""

import json
import shutil
from pathlib import Path

import pytest

from tests.commands import command
from train import pipeline

# One program holds the whole chain; compiling it takes minutes on a busy machine.
pytestmark = pytest.mark.timeout(1500)

ARGS = (
    *("--env", Path(__file__).parents[1] / "tiny_robot" / "env.py"),
    *("--env-steps", 2400, "--eval-episodes", 4, "--generations", 2, "--no-refine"),
    *("--population", 8, "--trajectories", 4, "--target", "gear*0.5"),
    *("--set", "segments=16", "real_batch=64", "discriminator_updates=2"),
)
ENDS = ("results.json", "distribution.json")
LOST = {
    "while the program ran": ("checkpoints/program", *ENDS, "report.html"),
    "while results were written": ("results.json", "report.html"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("pipeline") / "run"
    command(pipeline, "--out", out, *ARGS)
    return out


@pytest.mark.parametrize(
    "when",
    [
        # The whole chain is traced again.
        pytest.param("while the program ran", marks=pytest.mark.slow),
        "while results were written",
    ],
)
@pytest.mark.fault("killed (signal 9), then resumed")
def test_goes_on_bit_equal(whole: Path, tmp_path: Path, when: str) -> None:
    copy = tmp_path / "run"
    shutil.copytree(whole, copy)
    for name in LOST[when]:
        path = copy / name
        path.unlink() if path.is_file() else shutil.rmtree(path)
    command(pipeline, "--out", copy, *ARGS, "--resume")
    for name in ENDS:
        assert (copy / name).read_text() == (whole / name).read_text(), name
    rows = [json.loads(x) for x in (copy / "metrics.jsonl").read_text().splitlines()]
    assert len({(r["stage"], r["step"]) for r in rows}) == len(rows)
    assert (copy / "report.html").is_file()

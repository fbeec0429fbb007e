"""Documents keep their word: links resolve, commands parse and (slow) run."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from scripts.docs_site import equations
from tests.documented import ROOT, commands, parsed

PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [
    ROOT / "README.md",
    *PAGES,
    *sorted((ROOT / "examples").rglob("*.md")),
    ROOT / "benchmarks" / "results" / "README.md",
]
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FENCED = re.compile(r"```.*?```", re.S)
name = lambda p: str(p.relative_to(ROOT))  # noqa: E731


def anchors(page: Path) -> set[str]:
    """What ``#...`` can name in a page, as Markdown renderers make it of headings."""
    text = _FENCED.sub("", page.read_text())
    heads = re.findall(r"^#+ (.*)$", text, re.M)
    plain = (re.sub(r"[^\w\- ]", "", h).strip().lower() for h in heads)
    modules = re.findall(r"^::: ([\w.]+)$", text, re.M)
    return {re.sub(r"[-\s]+", "-", h) for h in plain} | set(modules)


@pytest.mark.parametrize("page", DOCUMENTS, ids=name)
def test_links_resolve(page: Path) -> None:
    for link in _LINK.findall(_FENCED.sub("", page.read_text())):
        assert "://" not in link, f"{link}: nothing here needs the network"
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists() and target.is_relative_to(ROOT), link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", DOCUMENTS, ids=name)
def test_commands_parse(page: Path) -> None:
    for words in commands(page.read_text()):
        parsed(words)


def test_a_wrong_command_is_found() -> None:
    (good,) = commands("run `python -m train.udr --seeds 0 1` first")
    assert parsed(good).seeds == (0, 1)
    (continued,) = commands("    python -m train.udr \\\n        --robot ant  # slow")
    assert continued == ["train.udr", "--robot", "ant"]
    for wrong in ("train.udr --sedes 0", "train.urd", "train.udr --seeds zero"):
        (words,) = commands(f"    python -m {wrong}")
        with pytest.raises(AssertionError):
            parsed(words)


def test_every_command_is_documented() -> None:
    text = "".join(p.read_text() for p in DOCUMENTS[:1] + PAGES)
    told = {words[0] for words in commands(text)}
    own = (f"train.{p.stem}" for p in (ROOT / "train").glob("[a-z]*.py"))
    assert set(own) <= told


def test_batch_jobs_are_there() -> None:
    text = (ROOT / "docs" / "batch.md").read_text()
    named = set(re.findall(r"scripts/slurm/(\w+\.sbatch)|`(\w+\.sbatch)`", text))
    there = {p.name for p in (ROOT / "scripts" / "slurm").glob("*.sbatch")}
    assert {a or b for a, b in named} == there
    for line in re.findall(r"^    sbatch .*?\.sbatch (.*)$", text, re.M):
        words = line.split()
        parsed(words if words[0].startswith("train.") else ["benchmarks.paper", *words])


def test_the_site_has_every_page_and_module() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    nav = [next(iter(item.values())) for item in yaml.safe_load(text)["nav"]]
    assert sorted(nav) == [p.name for p in PAGES]
    reference = (ROOT / "docs" / "reference.md").read_text()
    modules = re.findall(r"^::: ([\w.]+)$", reference, re.M)
    assert len(modules) == len(set(modules)) > 20
    for module in modules:
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file(), module


def test_equations_become_mathml() -> None:
    pytest.importorskip("latex2mathml")
    out = equations("with $\\xi$ and\n\n$$a = \\frac{1}{2} b$$\n")
    assert out.count("<math") == 2 and "<mfrac>" in out and "$" not in out


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("mkdocstrings") is None, reason="needs the extra docs"
)
def test_the_site_builds(tmp_path: Path) -> None:
    command = ("-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path))
    subprocess.run([sys.executable, *command], cwd=ROOT, check=True, timeout=1200)
    assert (
        'id="easi_jax.search.Search' in (tmp_path / "reference/index.html").read_text()
    )
    assert "<math" in (tmp_path / "method/index.html").read_text()


# What makes a command small, where the document does not say otherwise.
_SEARCH = {
    **{"--generations": "3", "--population": "8"},
    **{"--trajectories": "4", "--eval-episodes": "2"},
}
TINY = {
    "train.udr": {"--env-steps": "2500", "--eval-episodes": "2"},
    "train.easi": _SEARCH,
    "train.pipeline": {**_SEARCH, "--env-steps": "2500"},
    "train.evaluate": {"--episodes": "2"},
}
# Minutes to hours each, and run by tests of their own: here they are only parsed.
LONG = ("benchmarks.", "scripts.", "train.gap", "train.excite")
ELSEWHERE = {"--effects", "--target-effects"}  # tests/train/test_effects_option.py
STAND_INS = {"LOG": "LOG.csv", "RUN": "results/easi"}


def shop(folder: Path) -> None:
    """A folder with the files that the documents speak of."""
    (folder / "examples").symlink_to(ROOT / "examples")
    shutil.copytree(ROOT / "examples" / "my_robot", folder / "my_robot")
    arm = ROOT / "examples" / "lift_arm"
    for source, target in (
        *(("model.xml", "M.xml"), ("parameters.yaml", "P.yaml")),
        *(("sweep.csv", "LOG.csv"), ("moves.csv", "LOG2.csv")),
    ):
        shutil.copy(arm / source, folder / target)


def tiny(words: list[str]) -> list[str]:
    """The command, small, and free to replace what an earlier one has written."""
    found = [STAND_INS.get(w, w) for w in words]
    for option, value in TINY.get(words[0], {}).items():
        found += [] if option in words else [option, value]
    again = hasattr(parsed(words), "overwrite")
    return [*found, "--overwrite"] if again else found


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_commands_run(tmp_path: Path) -> None:
    shop(tmp_path)
    names = ("docs/index.md", "README.md", "docs/your_own_robot.md", "docs/export.md")
    every = [w for n in names for w in commands((ROOT / n).read_text())]
    chosen = [w for w in every if not w[0].startswith(LONG) and not ELSEWHERE & set(w)]
    assert len(chosen) >= 12
    ran = set()
    for words in map(tiny, chosen):
        if tuple(words) in ran:
            continue
        ran.add(tuple(words))
        done = subprocess.run(
            [sys.executable, "-m", *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=1200,
        )
        assert done.returncode == 0, (words, done.stderr[-2000:])

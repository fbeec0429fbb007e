"""Documents keep their word: links resolve, commands parse and (slow) run."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from scripts.docs_site import equations
from tests.documented import ROOT, commands, parsed
from tests.recordings import Ros
from tests.test_layout import LEVELS

PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [
    ROOT / "README.md",
    *PAGES,
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
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
        path = ROOT / module.replace(".", "/")
        found = path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()
        assert found, module


def test_the_layout_of_the_readme_is_that_of_the_tree() -> None:
    """Every package and module of the library, in the order of their levels."""
    layout = section((ROOT / "README.md").read_text(), "Layout")
    told = re.findall(r"`easi_jax/(\w+)(?:\.py)?`", layout)
    there = {
        p.stem
        for p in (ROOT / "easi_jax").glob("[a-z]*")
        if p.suffix == ".py" or (p / "__init__.py").is_file()
    }
    assert set(told) == there - {"version"}
    levels = [name for name in LEVELS if name in told]
    assert [name for name in told if name in levels] == levels
    for top in ("envs", "train", "benchmarks", "scripts", "tests"):
        assert f"`{top}`" in layout


def test_public_ci_runs_the_commands_of_the_readme() -> None:
    """Both make targets, on the Pythons that pyproject.toml names first and last."""
    flow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    job = flow["jobs"]["commands"]
    targets = re.findall(r"^    make (\w+)", (ROOT / "README.md").read_text(), re.M)
    assert job["strategy"]["matrix"]["command"] == targets == ["demo", "test"]
    assert {step["run"] for step in job["steps"] if "run" in step} == {
        "make ${{ matrix.command }}"
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [
        c.rpartition(" ")[2] for c in project["classifiers"] if " :: Python :: " in c
    ]
    assert job["strategy"]["matrix"]["python"] == named
    assert project["requires-python"] == f">={named[0]}"


def test_hooks_are_installed_by_make() -> None:
    """Every hook is a program of the environment that ``make install-dev`` makes."""
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    hooks = [hook for repo in config["repos"] for hook in repo["hooks"]]
    assert {"ruff-check", "ruff-format", "pyright"} <= {hook["id"] for hook in hooks}
    dev = (ROOT / "pyproject.toml").read_text()
    for hook in hooks:
        program, *arguments = hook["entry"].split()
        folder, _, name = program.rpartition("/")
        assert folder == ".venv/bin" and (name == "python" or f'"{name}' in dev)
        for path in (a for a in arguments if a.endswith(".py")):
            assert (ROOT / path).is_file(), path


def test_equations_become_mathml() -> None:
    pytest.importorskip("latex2mathml")
    out = equations("with $\\xi$ and\n\n$$a = \\frac{1}{2} b$$\n")
    assert out.count("<math") == 2 and "<mfrac>" in out and "$" not in out


_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:[.,]\d+)*%?(?![\w%])")


def section(text: str, title: str, mark: str = "## ") -> str:
    """What stands below a heading, up to the next of its rank."""
    return text.split(f"\n{mark}{title}\n")[1].split(f"\n{mark}")[0]


@pytest.mark.parametrize("page", ["README.md", "benchmarks/results/SUMMARY.md"])
def test_results_are_those_that_were_measured(page: str) -> None:
    """Every figure of a summary stands in the page made from the committed files."""
    results = (ROOT / "benchmarks" / "results" / "README.md").read_text()
    measured = set(_NUMBER.findall(results.split("\n## Speed\n")[1]))
    title = "Results" if page == "README.md" else "Summary"
    told = section("\n" + (ROOT / page).read_text(), title)
    text = re.sub(r"`[^`]*`|\]\([^)]*\)|^\d+\. ", "", told, flags=re.M)
    unknown = [n for n in _NUMBER.findall(text) if n not in measured]
    assert len(_NUMBER.findall(text)) > 25
    assert not unknown, f"not among the committed results: {unknown}"


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("mkdocstrings") is None, reason="needs the extra docs"
)
def test_the_site_builds(tmp_path: Path) -> None:
    command = ("-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path))
    subprocess.run([sys.executable, *command], cwd=ROOT, check=True, timeout=1200)
    assert (
        'id="easi_jax.search.easi.Search'
        in (tmp_path / "reference/index.html").read_text()
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
    "train.demonstrate": {"--env-steps": "10240", "--episodes": "20"},
}
# Run at a size of their own by the tests of notebooks, sweeps and experiments.
SIZED_ELSEWHERE = ("benchmarks.", "scripts.")
STAND_INS = {"LOG": "LOG.csv", "RUN": "results/easi", "RECORDING": "bag/"}
HIDDEN = """
effects:
- {effect: coulomb_friction, at: cart, kind: joint, columns: {coulomb: 0.5}}
"""
ORDER = (
    *("index", "your_own_robot", "export", "gap", "importers", "batch", "engines"),
    *("imitation", "real_go2"),
)
NOT_RUN = ("method", "reference", "user_files")  # pages of reading, not of doing


def simulator(folder: Path) -> None:
    """``robot.xml``, the built-in Cartpole, and logs of one whose rail rubs more."""
    text = (ROOT / "envs" / "assets" / "cartpole.xml").read_text()
    (folder / "robot.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_frictionloss[0] = 0.6
    control, every = 0.02, 40
    model.opt.timestep = control / every
    ros = Ros()
    for run in range(3):
        rng = np.random.default_rng(run)
        rates, phases = rng.uniform(2.0, 14.0, 5), rng.uniform(0, 6.3, 5)
        data = mujoco.MjData(model)
        data.qpos[1] = np.pi
        lines = ["time,qpos.cart,qpos.pole,ctrl.cart"]
        for row in range(500):
            at = control * row
            command = 0.05 * np.sin(rates * at + phases).sum()
            seen = data.qpos + rng.normal(0, 1e-4, 2)
            lines.append(f"{at:.4f},{seen[0]:.9g},{seen[1]:.9g},{command:.9g}")
            if run == 0:
                ros.joints(at, ["cart", "pole_hinge"], seen)
                ros.array(at, [command])
            data.ctrl[0] = command
            mujoco.mj_step(model, data, every)
        (folder / f"run{run + 1}.csv").write_text("\n".join(lines))
    ros.write(folder / "bag")
    names = "joints: {pole_hinge: pole}\nactuators: [cart]\n"
    (folder / "names.yaml").write_text(names)
    (folder / "hidden.yaml").write_text(HIDDEN)


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
    simulator(folder)


def tiny(words: list[str], folder: Path) -> list[str]:
    """The command, small, and free to replace what an earlier one has written."""
    found = [words[0]]
    for word in (STAND_INS.get(w, w) for w in words[1:]):
        there = sorted(folder.glob(word)) if "*" in word and "/" in word else []
        found += [str(p.relative_to(folder)) for p in there] or [word]
    options = TINY.get(words[0], {})
    if words[0] == "train.easi" and "--model" in words:
        # Beside the run in a target that other commands go on from.
        options = {"--generations": "3", "--population": "8", "--out": "results/logs"}
    for option, value in options.items():
        found += [] if option in words else [option, value]
    if words[0] == "train.import_logs" and "--mapping" not in words:
        found += ["--mapping", "names.yaml"]
        found = ["robot.xml" if w == "M.xml" else w for w in found]
    again = hasattr(parsed(found), "overwrite")
    return [*found, "--overwrite"] if again else found


def test_every_page_is_run_or_said_not_to_be() -> None:
    assert sorted(p.stem for p in PAGES) == sorted(ORDER + NOT_RUN)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_commands_run(tmp_path: Path) -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs" / f"{n}.md" for n in ORDER)]
    every = [w for p in pages for w in commands(p.read_text())]
    chosen = [w for w in every if not w[0].startswith(SIZED_ELSEWHERE)]
    assert len(chosen) >= 25
    shop(tmp_path)
    ran, failed = set(), []
    for given in chosen:
        words = tiny(given, tmp_path)
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
        if done.returncode:
            failed.append((words, done.stderr[-2000:]))
        elif words[0] == "train.gap" and "robot.xml" in words:
            shutil.copy(tmp_path / "results" / "gap" / "effects.yaml", tmp_path)
            told = (tmp_path / "effects.yaml").read_text()
            assert "coulomb_friction" in told and "at: cart" in told
    assert not failed

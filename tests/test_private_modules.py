"""Places that lean on private modules of other packages are listed, with a bound."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOPS = ("easi_jax", "envs", "train", "scripts", "benchmarks", "examples", "tests")
# Public by name, yet changed from release to release without notice.
UNSTABLE = ("jax.extend", "brax.training", "evosax.algorithms.distribution_based")
STATE = "mujoco.mjx.Data._impl"  # and of `mujoco.mjx.Model`
FUNCTIONS = "_mjPRIVATE"  # of MuJoCo's library, reached through ctypes


def _private(name: str) -> str | None:
    """The private or unstable module in a dotted name of another package."""
    parts = name.split(".")
    if parts[0] in TOPS or parts[0] in sys.stdlib_module_names:
        return None
    if any(name.startswith(f"{module}.") for module in UNSTABLE):
        return next(module for module in UNSTABLE if name.startswith(f"{module}."))
    hidden = [i for i, p in enumerate(parts) if re.match(r"_[^_]", p)]
    return ".".join(parts[: hidden[0] + 2]) if hidden else None


def _names(tree: ast.Module) -> Iterator[str]:
    """Dotted names of other packages that a file imports or reaches through one."""
    bound: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                bound[alias.asname or alias.name] = f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.partition(".")[0]
                bound[alias.asname or top] = alias.name if alias.asname else top
                yield alias.name

    def dotted(node: ast.AST) -> str | None:
        if isinstance(node, ast.Name):
            return bound.get(node.id)
        if isinstance(node, ast.Attribute) and (above := dotted(node.value)):
            return f"{above}.{node.attr}"
        return None

    yield from bound.values()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            if node.attr == "_impl":
                yield STATE
            elif node.attr.startswith(FUNCTIONS):
                yield f"mujoco.{FUNCTIONS}"
            elif name := dotted(node):
                yield name
        elif isinstance(node, ast.Constant) and re.fullmatch(
            r"_impl\.\w+", str(node.value)
        ):
            yield STATE


def _used(tree: ast.Module) -> set[str]:
    found = {m for name in _names(tree) if (m := _private(name))}
    return {m for m in found if not any(other.startswith(f"{m}.") for other in found)}


def _listed() -> dict[str, set[str]]:
    text = (ROOT / "CONTRIBUTING.md").read_text().split("## Private modules")[1]
    found = {}
    for row in re.findall(r"^\| `(.*)$", text.partition("\n## ")[0], re.M):
        module, files = f"`{row}".split("|")[:2]
        found[module.strip(" `")] = set(re.findall(r"`([^`]+\.py)`", files))
    return found


def test_the_list_of_private_modules_is_complete() -> None:
    used: dict[str, set[str]] = {}
    for top in TOPS:
        for path in sorted((ROOT / top).rglob("*.py")):
            for module in _used(ast.parse(path.read_text())):
                used.setdefault(module, set()).add(str(path.relative_to(ROOT)))
    listed = _listed()
    wrong = [
        f"{module}: used in {sorted(used.get(module, ()))}, "
        f"CONTRIBUTING.md lists {sorted(listed.get(module, ()))}"
        for module in sorted({*used, *listed})
        if used.get(module) != listed.get(module)
    ]
    assert not wrong, "\n".join(wrong)


def test_what_is_private_is_bounded_from_above() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = {
        re.split(r"[\[<>=]", requirement)[0]: requirement
        for requirement in project["dependencies"]
    }
    packages = {"mujoco": "mujoco-mjx"}  # its module `mujoco.mjx` is a package apart
    for module in _listed():
        top = module.partition(".")[0]
        requirement = bounds[packages.get(top, top)]
        assert "<" in requirement, f"{module}: {requirement} has no upper bound"


def test_private_use_is_seen() -> None:
    source = (
        "from mujoco.mjx._src import smooth\n"
        "from mujoco import mjx\n"
        "import jax\n"
        "mjx._src.types.Option\n"
        "data._impl.efc_J\n"
        "jax.extend.core\n"
        "from easi_jax._version import x\n"
        "import os\nos._exit(0)\n"
    )
    assert _used(ast.parse(source)) == {
        "mujoco.mjx._src.smooth",
        "mujoco.mjx._src.types",
        "mujoco.mjx.Data._impl",
        "jax.extend",
    }

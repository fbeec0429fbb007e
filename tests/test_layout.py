"""The levels of import, and who may touch files or start processes."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]

# What each package may import besides itself: those to its left.
LEVELS = (
    *("errors", "progress", "version", "devices", "model", "data", "simulation", "io"),
    *("rl", "search", "estimation", "gap", "excite", "export", "baselines"),
    *("pipeline", "api", "easi_jax", "envs", "train", "benchmarks", "scripts"),
)

# Files outside `io` that touch the disk or start a process, and why.
OUTSIDE_IO = {
    "easi_jax/devices/runtime.py": "makes the folder of jax's compilation cache",
    "easi_jax/baselines/npe.py": "sbi needs torch, which must not share our process",
    "easi_jax/baselines/_npe_process.py": "is that process",
}
PROCESSES = {
    "easi_jax/baselines/npe.py": "sbi in a process of its own",
    "easi_jax/io/report/video.py": "MuJoCo picks its way to OpenGL once a process",
    "easi_jax/io/runs/versions.py": "asks git for the commit",
}
_TOUCH = re.compile(
    r"\b(subprocess|shutil|tempfile|os\.(replace|makedirs|mkdir|remove|unlink))\b"
    r"|(?<![\w.])open\(|\.(write|read)_(text|bytes)\(|\.mkdir\(|\.unlink\("
    r"|np\.(load|save|savez)\(|from_xml_path\("
)


def _modules(top: str) -> Iterator[tuple[Path, ast.Module]]:
    for path in sorted((ROOT / top).rglob("*.py")):
        yield path.relative_to(ROOT), ast.parse(path.read_text())


def _package(module: str) -> str:
    parts = module.split(".")
    if parts[0] != "easi_jax" or len(parts) == 1 or parts[1].startswith("_"):
        return parts[0]
    return parts[1]


def _name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name


@cache
def _ours() -> dict[str, tuple[Path, ast.Module]]:
    tops = ("easi_jax", "envs", "train", "benchmarks", "scripts")
    return {_name(p): (p, t) for top in tops for p, t in _modules(top)}


def _target(name: str, ours: dict[str, tuple[Path, ast.Module]]) -> str | None:
    while name and name not in ours:
        name = name.rpartition(".")[0]
    return name or None


def test_nothing_imports_upwards() -> None:
    rank = {name: i for i, name in enumerate(LEVELS)}
    ours = _ours()
    upwards = []
    for name, (path, tree) in ours.items():
        mine = _package(name)
        assert mine in rank, f"{path}: give package {mine} a level"
        for imported in _imports(tree):
            other = _target(imported, ours)
            if other is None or _package(other) == mine:
                continue
            if rank[_package(other)] > rank[mine]:
                upwards.append(f"{path} imports {imported}")
    assert not upwards


def test_no_circle() -> None:
    """No module reaches itself; a package's face counts where it is imported."""
    ours = _ours()
    arrows = {
        name: {t for i in _imports(tree) if (t := _target(i, ours)) and t != name}
        for name, (_, tree) in ours.items()
    }
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, " -> ".join((*above[above.index(name) :], name))
        if name in done:
            return
        for other in sorted(arrows[name]):
            visit(other, (*above, name))
        done.add(name)

    for name in arrows:
        visit(name, ())


def test_files_are_touched_in_io_alone() -> None:
    touched = set()
    for path, _ in _modules("easi_jax"):
        if path.parts[1] == "io":
            continue
        code = re.sub(r'"""[\s\S]*?"""', "", (ROOT / path).read_text())
        if _TOUCH.search(code):
            touched.add(str(path))
    assert touched == set(OUTSIDE_IO)


def test_processes_are_started_where_the_list_says() -> None:
    started = {
        str(path)
        for path, tree in _modules("easi_jax")
        if "subprocess" in set(_imports(tree))
    }
    assert started == set(PROCESSES)


def test_every_test_that_the_page_of_user_files_names_is_there() -> None:
    page = (ROOT / "docs" / "user_files.md").read_text()
    defined = {
        node.name
        for _, tree in _modules("tests")
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    }
    files = set(re.findall(r"`((?:\w+/)*test_\w+\.py)", page))
    named = set(re.findall(r"(?:`|::)(test_\w+)`", page))
    assert len(named) > 30 and named <= defined, named - defined
    assert all((ROOT / "tests" / name).is_file() for name in files)


_WAITING = re.compile(
    r"subprocess\.(run|call|check_call|check_output)|.*\.(communicate|wait)"
)


def test_every_test_that_waits_for_a_process_has_a_time_limit() -> None:
    waits = [
        (f"{path}:{node.lineno}", {k.arg for k in node.keywords})
        for path, tree in _modules("tests")
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and _WAITING.fullmatch(ast.unparse(node.func))
    ]
    assert len(waits) > 20
    assert [at for at, given in waits if "timeout" not in given] == []


_LONGEST = 80  # lines of a function, its signature and docstring among them


def test_no_function_is_longer_than_a_reader_can_hold() -> None:
    long = [
        f"{path}: {node.name}, {lines} lines"
        for top in ("easi_jax", "train", "envs", "benchmarks")
        for path, tree in _modules(top)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (lines := (node.end_lineno or 0) - node.lineno + 1) > _LONGEST
    ]
    assert long == []

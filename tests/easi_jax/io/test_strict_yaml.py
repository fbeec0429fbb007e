"""YAML from strangers: plain data, soon, or one clear line."""

import os
from pathlib import Path

import pytest

from benchmarks.fuzz_mutations import bomb
from easi_jax.errors import UserError
from easi_jax.io.strict_yaml import read_yaml


def content(folder: Path, text: str) -> object:
    path = folder / "a.yaml"
    path.write_text(text)
    return read_yaml(path)


def test_plain_data_and_small_aliases(tmp_path: Path) -> None:
    assert content(tmp_path, "a: &x [1, b]\nc: *x\nd: {e: null}") == {
        "a": [1, "b"],
        "c": [1, "b"],
        "d": {"e": None},
    }
    assert content(tmp_path, "a: &x {k: 1}\nb: {<<: *x, l: 2}") == {
        "a": {"k": 1},
        "b": {"k": 1, "l": 2},
    }
    assert content(tmp_path, "") is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (bomb().decode(), "aliases repeat too much"),
        ("&a [*a]", "aliases repeat too much"),
        ("&a {b: *a}", "aliases repeat too much"),
        ("[" * 100_000, "nested too deeply"),
        ("{a: " * 100_000, "nested too deeply"),
        ("- " * 100_000, "nested too deeply"),
        *((f"a: !!{x}", "tags") for x in ("int ''", "bool x", "timestamp x", "set 3")),
        ("!!python/object/apply:os.mkdir [x]", "tags"),
        ("!local x", "tags"),
        ("? {a: b}\n: 1", "a key is no plain value"),
        ("? [a]\n: 1", "a key is no plain value"),
        ("{a: 1, a: 2}", '"a" is there twice'),
        ("a: 2001-99-99", "not valid YAML"),
    ],
)
@pytest.mark.timeout(60)
@pytest.mark.fault("wrong options and files")
def test_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(UserError, match=said) as error:
        content(tmp_path, text)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="a pipe or a device"):
        read_yaml(tmp_path / "pipe")
    with pytest.raises(UserError, match="cannot be read"):
        read_yaml(tmp_path)

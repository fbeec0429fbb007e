"""Files of runs that were edited, cut short or are of another kind."""

import copy
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fuzz_readers import DISTRIBUTION_CONTENT, POLICIES_CONTENT
from easi_jax.errors import UserError
from easi_jax.export.randomization import read_randomization, to_yaml
from easi_jax.io.files import read_json
from easi_jax.io.runs.folder import RunFolder, read_config
from easi_jax.io.runs.metrics import read_metrics
from easi_jax.io.runs.schemas import TRAINED, checked, read_distribution
from train import udr
from train._robots import read_policies


def write(folder: Path, name: str, content: Any) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_distribution_with_open_bounds_is_exported(tmp_path: Path) -> None:
    found = read_distribution(write(tmp_path, "d.json", DISTRIBUTION_CONTENT))
    assert found["parameters"][0]["bounds"] == [0.001, math.inf]
    text = write(tmp_path, "r.yaml", to_yaml(found, "1", "cart"))
    assert read_randomization(text).bounds[1, 0] == math.inf


def test_a_run_with_nothing_but_defaults_is_one(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "udr", udr.Config(), command="train.udr"):
        pass
    config = read_config(tmp_path / "udr")
    assert config["env_steps"] is None, "the robot's own"
    assert checked(config, TRAINED, "it") == config


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("parameters",), 3, "parameters is no list"),
        (("parameters",), [], "has not 0 parameters"),
        (("parameters", 0), [], "parameters.0 is no mapping"),
        (("parameters", 0, "nominal"), "many", "nominal is not a number"),
        (("parameters", 0, "nominal"), True, "nominal is not a number"),
        (("parameters", 0, "nominal"), int("9" * 400), "nominal is not a number"),
        (("parameters", 0, "name"), None, '"parameters.0.name" is missing'),
        (("parameters", 0, "bounds"), [1.0], "two ends"),
        (("parameters", 0, "addresses"), [], "no address"),
        (("parameters", 0, "initial"), [0.0, 1.0], "above 0"),
        (("parameters", 0, "scale"), "cubic", "cubic"),
        (("seeds",), {}, "no seed"),
        (("seeds", "0", "mean"), [1.0], "seed 0 has not 2 parameters"),
        (("seeds", "0", "unit_covariance", 0), [1.0], "seed 0 has not 2"),
        (("seeds", "²"), DISTRIBUTION_CONTENT["seeds"]["0"], "no whole number"),
        (("best_seed",), 7, "none of its seeds"),
        (("best_seed",), "x", "best_seed is not a whole number"),
    ],
)
@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_an_edited_distribution_is_refused(
    tmp_path: Path, place: tuple[Any, ...], value: Any, said: str
) -> None:
    content: Any = copy.deepcopy(DISTRIBUTION_CONTENT)
    holder = content
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = value
    path = write(tmp_path, "d.json", content)
    with pytest.raises(UserError) as error:
        read_distribution(path)
    assert said in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"methods": 3}, "methods is no list"),
        ({"methods": [3]}, "methods.0 is not a text"),
        ({"methods": []}, "no method"),
        ({"seeds": ["a"]}, "seeds.0 is not a whole number"),
        ({"seeds": []}, "seeds are"),
        ({"env_steps": "many"}, "env_steps is not"),
        ({"robot": None}, '"robot" is missing'),
        ({"effects": [1]}, "effects is no mapping"),
    ],
)
@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_edited_results_are_refused(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    path = write(tmp_path, "results.json", POLICIES_CONTENT)
    assert read_policies(path)["seeds"] == [0, 1]
    write(tmp_path, "results.json", {**POLICIES_CONTENT, **change})
    with pytest.raises(UserError, match=said):
        read_policies(path)


@pytest.mark.parametrize(
    "head",
    [
        [],
        {"format": 1},
        {"format": 1, "command": "c", "config": 3},
        {"format": 1, "command": [], "config": {}},
    ],
)
@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_an_edited_configuration_is_refused(tmp_path: Path, head: Any) -> None:
    write(tmp_path, "config.json", head)
    with pytest.raises(UserError):
        read_config(tmp_path)
    with pytest.raises(UserError):
        RunFolder.open(tmp_path, {}, command="c", resume=True)


@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_json_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nested too deeply"):
        read_json(write(tmp_path, "deep.json", "[" * 100_000))
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(UserError, match="a pipe or a device"):
        read_json(tmp_path / "pipe.json")
    with pytest.raises(UserError, match="cannot read"):
        read_json(tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        '{"stage": "a", "step": 1, "x": ' + "9" * 400 + "}",
        '{"stage": "a", "step": 1, "x": []}',
        '{"stage": "a", "step": "1"}',
        '{"stage": "a"}',
        "[" * 100_000,
    ],
)
@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_an_edited_line_of_metrics_is_named(tmp_path: Path, line: str) -> None:
    with pytest.raises(UserError, match="line 1: not a metrics line"):
        read_metrics(write(tmp_path, "metrics.jsonl", line + "\n"))


def test_forms() -> None:
    form = {"a": [int], "b?": str, "c": {"*": float}}
    content = {"a": [1], "b": None, "c": {"x": "-Infinity"}, "d": object}
    assert checked(content, form, "here")["c"] == {"x": -math.inf}
    with pytest.raises(UserError, match=r"here: a\.0 is not a whole number"):
        checked({**content, "a": [True]}, form, "here")

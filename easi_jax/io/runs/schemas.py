"""JSON files of runs, checked: folders are passed on, edited, and cut short."""

from pathlib import Path
from typing import Any

from easi_jax.errors import UserError
from easi_jax.io.files import number, read_json
from easi_jax.model.parameters import Parameter, ParameterSpace

# Forms: a type; [form] for a list; {key: form} for a mapping, where a key that ends in
# "?" may be missing or null, and the key "*" stands for all others.
CONFIG = {"format": int, "command": str, "config": {}}
MADE_WITH = {"robot": str, "env?": str, "option?": [str]}
TRAINED = {
    **MADE_WITH,
    "env_steps?": int,
    "seeds": [int],
    "algorithm?": str,
    "demonstrations?": str,
    "labelled?": float,
    "skills?": int,
    "skill?": str,
    "demonstrations_sha256?": str,
    "effects?": {},
    "target_effects?": {},
    "found?": str,
}
POLICIES = {**TRAINED, "methods": [str]}
_SEED = {
    "mean": [float],
    "unit_mean": [float],
    "unit_covariance": [[float]],
    "outcome?": str,
    "reason?": str,
}
DISTRIBUTION = {
    "parameters": [
        {
            "name": str,
            "addresses": [str],
            "unit": str,
            "nominal": float,
            "initial": [float],
            "bounds": [float],
            "scale": str,
        }
    ],
    "seeds": {"*": _SEED},
    "best_seed?": int,
    "diverged?": {"*": str},
}
GAP = {"effects": [{"effect": str, "at": str, "indistinguishable": [str]}]}
_WORDS = {int: "a whole number", float: "a number", str: "a text"}


def read_distribution(path: Path) -> dict[str, Any]:
    """What ``distribution.json`` holds, its parameters and seeds of one size; the best
    seed is the first where it does not say.

    Raises:
        UserError: it cannot be read, or is another file.
    """
    found = read_checked(path, DISTRIBUTION, "a distribution of train.easi")
    parameters, seeds = found["parameters"], found["seeds"]
    n = len(parameters)
    for i, p in enumerate(parameters):
        place = f"{path}: parameters.{i}"
        if not p["addresses"]:
            raise UserError(f"{place}: no address")
        if len(p["initial"]) != 2 or len(p["bounds"]) != 2:
            raise UserError(f"{place}: initial and bounds have two ends")
        if p["scale"] not in ("log", "linear"):
            raise UserError(f'{place}: scale is "{p["scale"]}", not log or linear')
        if p["scale"] == "log" and not min(p["initial"]) > 0:
            raise UserError(f"{place}: a logarithmic range starts above 0")
    for seed, s in seeds.items():
        sizes = {len(s["mean"]), len(s["unit_mean"]), len(s["unit_covariance"])}
        if sizes | {len(row) for row in s["unit_covariance"]} != {n}:
            raise UserError(f"{path}: seed {seed} has not {n} parameters")
        if not (seed.isascii() and seed.isdecimal() and len(seed) < 20):
            raise UserError(f'{path}: seed "{seed}" is no whole number')
    if not n or not seeds:
        raise UserError(f"{path}: no parameter or no seed")
    if found.get("best_seed") is None:
        found["best_seed"] = int(next(iter(seeds)))
    elif str(found["best_seed"]) not in seeds:
        raise UserError(f"{path}: best_seed is none of its seeds")
    return found


def space_of(found: dict[str, Any]) -> ParameterSpace:
    """The parameters of `read_distribution`."""
    return ParameterSpace(
        tuple(
            Parameter(
                name=p["name"],
                addresses=tuple(p["addresses"]),
                nominal=p["nominal"],
                initial=tuple(p["initial"]),
                bounds=tuple(p["bounds"]),
                unit=p["unit"],
                log=p["scale"] == "log",
            )
            for p in found["parameters"]
        )
    )


def read_checked(path: Path, form: Any, what: str) -> Any:
    """The content of a JSON file of the given form.

    Raises:
        UserError: it cannot be read, or has another form; names the place in it.
    """
    return checked(read_json(path), form, f"{path} is not {what}")


def checked(content: Any, form: Any, where: str, at: str = "") -> Any:
    """``content`` if it has ``form``, its numbers as Python's.

    Raises:
        UserError: ``where``, and the first place that has another form.
    """
    place = f"{where}: {at or 'it'}"
    if isinstance(form, list):
        if not isinstance(content, list):
            raise UserError(f"{place} is no list")
        (each,) = form
        return [checked(x, each, where, f"{at}.{i}") for i, x in enumerate(content)]
    if isinstance(form, dict):
        if not isinstance(content, dict):
            raise UserError(f"{place} is no mapping")
        out, before = dict(content), f"{at}." if at else ""
        for name, each in form.items():
            key = name.removesuffix("?")
            if name == "*":
                keys = list(content)
            elif content.get(key) is not None:
                keys = [key]
            elif key != name:
                keys = []
            else:
                raise UserError(f'{where}: "{before}{key}" is missing')
            for k in keys:
                out[k] = checked(content[k], each, where, before + k)
        return out
    known = (int, float, str) if form is float else form
    wrong = UserError(f"{place} is not {_WORDS[form]}")
    if not isinstance(content, known) or isinstance(content, bool):
        raise wrong
    try:
        return number(content) if form is float else content
    except ValueError:
        raise wrong from None

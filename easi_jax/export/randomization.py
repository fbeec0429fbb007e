"""A found distribution as ranges and covariance in YAML, and as a function for brax and
MuJoCo Playground.

The file stands for itself: means and a covariance in logarithms of SI values (plain SI
values for parameters on a linear scale), bounds, and the addresses of what they are in
the model.
"""

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import yaml

from easi_jax.errors import UserError
from easi_jax.io.strict_yaml import read_yaml
from easi_jax.model.found_effects import set_by_none
from easi_jax.model.mjx_model import put_model, with_parameters
from easi_jax.model.written_effects import undone

_WIDE = 2.0  # standard deviations of a range
_COUPLING = "nC", "M_rowadr", "M_rownnz", "M_colind"  # which inertias couple in MJX
_HEAD = """\
# Made by train.export. `covariance` is of ln(value), for `scale: linear` of the value;
# `range` is mean -+ 2 standard deviations inside `bounds`, `factor` the same over
# `nominal`: the value of the model that the run was made with.
"""


def to_yaml(found: Mapping[str, Any], seed: str, robot: str) -> str:
    """The text of a randomization file, of a run's ``distribution.json``.

    Args:
        found: the content of that file.
        seed: which of its seeds.
        robot: name.
    """
    parameters, result = found["parameters"], found["seeds"][seed]
    logs = np.array([p["scale"] == "log" for p in parameters])
    ends = np.array([p["initial"] for p in parameters], float)
    ends[logs] = np.log(ends[logs])
    low, width = ends[:, 0], ends[:, 1] - ends[:, 0]
    mean = low + width * np.array(result["unit_mean"])
    cov = np.array(result["unit_covariance"]) * np.outer(width, width)
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    entries = []
    for i, p in enumerate(parameters):
        lower, upper = p["bounds"]
        sides = np.array([mean[i], mean[i] - _WIDE * std[i], mean[i] + _WIDE * std[i]])
        middle, first, last = np.clip(np.exp(sides) if logs[i] else sides, lower, upper)
        entry = {
            "name": p["name"],
            "address": list(p["addresses"]),
            "unit": p["unit"],
            "scale": p["scale"],
            "nominal": _round(p["nominal"]),
            "mean": _round(middle),
            "std": _round(std[i]),
            "range": [_round(first), _round(last)],
        }
        if p["nominal"]:
            factors = sorted((first / p["nominal"], last / p["nominal"]))
            entry["factor"] = [_round(x) for x in factors]
        entries.append({**entry, "bounds": [float(lower), float(upper)]})
    content = {
        "schema": 1,
        "robot": robot,
        "seed": int(seed),
        "parameters": entries,
        "covariance": [[_round(x) for x in row] for row in cov],
    }
    return _HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _round(x: float) -> float:
    return float(f"{x:.7g}")


@dataclass(frozen=True)
class Randomization:
    """What a randomization file says.

    Attributes:
        names: of the parameters.
        addresses: what each is in the model.
        log: whether on a logarithmic scale, ``(n,)``.
        mean: of the logarithm or of the value, ``(n,)``.
        root: a square root of the covariance, ``(n, n)``.
        bounds: ``(2, n)``, SI.
    """

    names: tuple[str, ...]
    addresses: tuple[tuple[str, ...], ...]
    log: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    bounds: np.ndarray

    def draw(self, key: jax.Array) -> jax.Array:
        """One sample ``(n,)`` in SI units, inside the bounds; pure."""
        z = self.mean + self.root @ jax.random.normal(key, self.mean.shape)
        value = jnp.where(self.log, jnp.exp(jnp.where(self.log, z, 0.0)), z)
        return jnp.clip(value, *self.bounds)


def read_randomization(path: Path | str) -> Randomization:
    """Reads what `to_yaml` wrote.

    Raises:
        UserError: no such file, or not of this form.
    """
    content = read_yaml(Path(path))
    try:
        entries = content["parameters"]
        log = np.array([p["scale"] == "log" for p in entries])
        mean = np.array([float(p["mean"]) for p in entries])
        mean = np.where(log, np.log(np.where(log, mean, 1.0)), mean)
        cov = np.array(content["covariance"], float).reshape(len(entries), -1)
        values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
        return Randomization(
            names=tuple(str(p["name"]) for p in entries),
            addresses=tuple(tuple(map(str, p["address"])) for p in entries),
            log=log,
            mean=mean,
            root=vectors * np.sqrt(np.maximum(values, 0.0)),
            bounds=np.array([p["bounds"] for p in entries], float).T,
        )
    except (LookupError, TypeError, ArithmeticError, ValueError) as error:
        raise UserError(
            f"{path} is no randomization file of train.export ({error!r})"
        ) from None


Randomizer = Callable[[Any, jax.Array], tuple[Any, Any]]


def domain_randomizer(path: Path | str, mj_model: mujoco.MjModel) -> Randomizer:
    """``randomization_fn(model, keys) -> (batched model, in_axes)``, as brax's and
    MuJoCo Playground's training wrappers take it.

    Args:
        path: file that ``train.export --to randomization`` wrote.
        mj_model: that the MJX model is made from.

    Raises:
        UserError: a file of another form, an address that the model lacks, or one that
            MJX would leave out of it since it is zero there.

    A model of ``train.export --to mjcf`` has effects in its numbers and says how it is
    without: they count once (`easi_jax.model.written_effects`).

    Warns of parameters that MJX has no word for (a joint's speed limit, a delay).
    """
    given = read_randomization(path)
    plain = undone(mj_model)
    rest = set_by_none(plain.without, given.addresses, plain.values)
    base = put_model(plain.without, given.addresses, rest)
    _check_compiled(mj_model, base, given.addresses)
    moved = with_parameters(base, jnp.asarray(_middle(given))).mjx
    names = _changed(base.mjx, moved)
    if not names:
        raise UserError(f"{path}: MJX has no word for any of {', '.join(given.names)}")
    unsaid = [
        name
        for i, name in enumerate(given.names)
        if not _reaches(base, moved, names, _middle(given), i)
    ]
    if unsaid:
        warnings.warn(
            f"{path}: MJX has no word for {', '.join(unsaid)}, which stay as they are",
            stacklevel=2,
        )

    def one(key: jax.Array) -> dict[str, jax.Array]:
        model = with_parameters(base, given.draw(key)).mjx
        return {name: _leaf(model, name) for name in names}

    drawn = jax.jit(jax.vmap(one))

    def randomize(model: Any, keys: jax.Array) -> tuple[Any, Any]:
        values = drawn(keys)
        axes = jax.tree.map(lambda _: None, model)
        return (
            model.tree_replace(values),
            axes.tree_replace({name: 0 for name in names}),
        )

    return randomize


def _reaches(
    base: Any, at: Any, names: Sequence[str], middle: np.ndarray, i: int
) -> bool:
    """Whether one of the parameters moves any of some leaves of the MJX model that is
    ``at`` their ``middle``."""
    other = middle.copy()
    other[i] = 1.01 * middle[i] + 1e-3
    moved = with_parameters(base, jnp.asarray(other)).mjx
    return any(
        not np.array_equal(_leaf(at, name), _leaf(moved, name)) for name in names
    )


def _middle(given: Randomization) -> np.ndarray:
    return np.where(given.log, np.exp(np.where(given.log, given.mean, 0.0)), given.mean)


def _check_compiled(
    m: mujoco.MjModel, base: Any, addresses: Sequence[tuple[str, ...]]
) -> None:
    """Refuses a model of which MJX would compile another program for some addresses:
    what is zero or off is left out of it, and so is the coupling of inertias about a
    center of mass that lies at its joint."""
    own = _compiled(put_model(m, (), {}).mjx)
    if _alike(own, _compiled(base.mjx)):
        return
    for tied in addresses:
        theirs = _compiled(put_model(m, (tied,), {}).mjx)
        if not _alike({k: v for k, v in own.items() if k not in _COUPLING}, theirs):
            raise UserError(
                f"{', '.join(tied)}: MJX leaves it out of this model, where it is "
                "zero or off; take the model of train.export --to mjcf"
            )
        if not _alike(own, theirs):
            raise UserError(
                f"{', '.join(tied)}: MJX leaves out how the body's turns couple, since "
                "its center of mass is at its joint; write its <inertial> with a pos "
                "of 1e-6 m from there"
            )


def _compiled(m: Any) -> dict[str, Any]:
    """What of an `mjx.Model` is no array of JAX, and so part of the program."""
    return {n: v for n, v in _leaves(m) if not isinstance(v, jax.Array)}


def _alike(some: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Whether ``others`` say the same of all that is in ``some``."""
    return all(
        np.array_equal(value, others[name])
        if isinstance(value, np.ndarray)
        else value == others[name]
        for name, value in some.items()
    )


def _changed(old: Any, new: Any) -> list[str]:
    """Leaves of an `mjx.Model` that parameters write."""
    was = dict(_leaves(old))
    return [
        name
        for name, value in _leaves(new)
        if isinstance(value, jax.Array)
        and value is not was[name]
        and "_impl" not in name.split(".")
    ]


def _leaves(m: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Name and value of every leaf of an `mjx.Model`."""
    for field in dataclasses.fields(m):
        value, name = getattr(m, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def _leaf(tree: Any, name: str) -> Any:
    return reduce(getattr, name.split("."), tree)

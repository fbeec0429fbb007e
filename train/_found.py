"""What a run of ``train.easi`` found, as the physics of a training: ``train.udr --found
RUN``. The folder of the policy keeps it, so that the policy is tested in it later."""

import dataclasses
from pathlib import Path
from typing import Any

from train._effects import Given, found_in

FILE = "found.json"  # in a policy's folder, in the form of distribution.json


@dataclasses.dataclass(frozen=True)
class Found:
    """A robot as it was identified.

    Attributes:
        env: the environment with the parameters of the run, whose nominal values are
            the means that were found.
        distribution: over these parameters.
        given: the effects that it has.
        content: what is to be kept of it.
        note: for the report.
    """

    env: Any
    distribution: Any
    given: Given
    content: dict[str, Any]
    note: str


def found_robot(folder: Path, env: Any) -> Found:
    """The robot of ``env`` as a run found it; other parameters of ``env`` keep their
    nominal values.

    Raises:
        UserError: no finished run of ``train.easi``, or of another robot.
    """
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.io.runs.folder import read_config
    from easi_jax.io.runs.schemas import read_distribution
    from easi_jax.model.distribution import gaussian

    path = folder / "distribution.json"
    if not path.is_file():
        raise UserError(
            f"--found {folder}: no distribution.json in it; give a finished run of "
            "train.easi"
        )
    content, given = read_distribution(path), Given(read_config(folder).get("effects"))
    seed = str(content["best_seed"])
    result = content["seeds"][seed]
    content = {**content, "seeds": {seed: result}}
    identified = _identified(env, content, given.effects, f"--found {folder}")
    cov = np.array(result["unit_covariance"], float)
    mean = np.array(result["unit_mean"], float)
    note = (
        f"physics drawn from what {folder} found: {identified.space.size} parameters, "
        "with their covariance; others keep their nominal values"
    )
    drawn = gaussian(identified.space, mean, cov)
    return Found(identified, drawn, given, content, note)


def as_found(folder: Path, env: Any, given: Given) -> Any:
    """The robot of ``env`` with effects, as that which the policies of a folder were
    trained in was identified, where they were trained under what a run found.

    Raises:
        UserError: what the folder keeps is damaged, or is of another robot.
    """
    from easi_jax.io.runs.schemas import read_distribution
    from train._effects import robots

    path = folder / FILE
    if not path.is_file():
        return robots(env, given)[0]
    return _identified(env, read_distribution(path), given.effects, str(path))


def _identified(
    env: Any, content: dict[str, Any], effects: dict[str, Any] | None, where: str
) -> Any:
    from easi_jax.errors import UserError
    from easi_jax.io.runs.schemas import space_of
    from easi_jax.model.found_effects import joined
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.with_effects import env_identified

    (result,) = content["seeds"].values()
    try:
        own, values = joined(env.mj_model, ParameterSpace(()), found_in(effects))
        values |= {a: p.nominal for p in own.parameters for a in p.addresses}
        return env_identified(env, space_of(content), result["mean"], values)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None

"""What a run of ``train.easi`` found, as the physics of a training: ``train.udr --found
RUN``."""

import dataclasses
from pathlib import Path
from typing import Any

from train._effects import Given, found_in


@dataclasses.dataclass(frozen=True)
class Found:
    """A robot as it was identified.

    Attributes:
        env: the environment with the parameters of the run, whose nominal values are
            the means that were found.
        distribution: over these parameters.
        given: the effects that it has.
        note: for the report.
    """

    env: Any
    distribution: Any
    given: Given
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
    from easi_jax.io.runs.schemas import read_distribution, space_of
    from easi_jax.model.distribution import gaussian
    from easi_jax.model.found_effects import joined, set_by_none
    from easi_jax.model.parameters import ParameterSpace
    from easi_jax.simulation.with_effects import env_identified

    path = folder / "distribution.json"
    if not path.is_file():
        raise UserError(
            f"--found {folder}: no distribution.json in it; give a finished run of "
            "train.easi"
        )
    settings, content = read_config(folder), read_distribution(path)
    seed = str(content.get("best_seed", next(iter(content["seeds"]))))
    result = content["seeds"][seed]
    space = space_of(content)
    given = Given(settings.get("effects"))
    try:
        own, values = joined(env.mj_model, ParameterSpace(()), found_in(given.effects))
        values |= {a: p.nominal for p in own.parameters for a in p.addresses}
        fixed = set_by_none(env.mj_model, space.addresses, values)
        identified = env_identified(env, space, result["mean"], fixed)
    except UserError as error:
        raise UserError(f"--found {folder}: {error}") from None
    cov = np.array(result["unit_covariance"], float)
    drawn = gaussian(space, np.array(result["unit_mean"], float), cov)
    note = (
        f"physics drawn from what {folder} found: {space.size} parameters, with their "
        "covariance; parameters that it lacks keep the model's values"
    )
    return Found(identified, drawn, given, note)

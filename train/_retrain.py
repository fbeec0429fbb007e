"""What ``train.gap --retrain`` does: is a policy better for knowing the effects?"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from easi_jax.model.results import Retrained


def check_robot(robot: str, mj_model: Any, env_steps: int | None = None) -> None:
    """Whether a robot has the places of the model that was analysed, and can be trained
    for ``env_steps``.

    Raises:
        UserError: no such robot or file, a joint, actuator or body is missing in it, or
            too few steps.
    """
    from easi_jax.errors import UserError
    from easi_jax.model.addresses import names
    from envs import open_env
    from train._robots import training_config

    env = open_env(*_which(robot))
    training_config(env, env_steps)
    known = env.mj_model
    for kind in ("joint", "actuator", "body"):
        missing = [n for n in names(mj_model, kind) if n not in names(known, kind)]
        if missing:
            raise UserError(
                f'--retrain {robot}: that robot has no {kind} "{missing[0]}" of the '
                "model, so effects found there have no place in it"
            )


def _which(robot: str) -> tuple[str, Path | None]:
    path = Path(robot)
    return ("", path) if path.suffix == ".py" else (robot, None)


def retrain(
    robot: str,
    folder: Path,
    effects: Path,
    seeds: tuple[int, ...],
    env_steps: int | None,
    resume: bool = False,
) -> "Retrained":
    """Trains a policy with the effects and one without, and tests both with them.

    Runs of ``train.udr`` in ``folder/retrain_with`` and ``folder/retrain_without``; the
    robot with the effects stands for the real one. ``resume`` goes on with them.
    """
    from easi_jax.io.files import read_json
    from easi_jax.model.results import Retrained
    from train import udr
    from train._command import say

    name, path = _which(robot)
    returns: dict[str, Any] = {}
    steps = env_steps
    for which, known in (("without", None), ("with", effects)):
        out = folder / f"retrain_{which}"
        say(f"training {which} the effects, in {out}")
        udr.run(
            udr.Config(
                robot=name,
                env=path,
                out=out,
                effects=known,
                target_effects=effects,
                seeds=seeds,
                env_steps=env_steps,
                resume=resume,
            )
        )
        told = read_json(out / "results.json")
        (returns[which],) = told["returns"].values()
        steps = told["env_steps"]
    return Retrained(robot, steps, returns["without"], returns["with"])

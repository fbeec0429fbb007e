"""Building a robot's pipeline from what commands are given."""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from train._effects import Given, robots
from train._found import as_found

_IMITATES = ("demonstrations", "labelled", "skills", "skill")


def training_config(
    env: Any,
    env_steps: int | None = None,
    algorithm: str | None = None,
    imitated: Mapping[str, Any] = MappingProxyType({}),
) -> Any:
    """Training settings of a robot, with another budget or algorithm where given.

    Args:
        imitated: `TrainingOptions` of imitation by name, as a command or a run folder
            has them.

    Raises:
        UserError: no such algorithm, or options of imitation that do not go with it,
            with the robot, or with each other.
    """
    from dataclasses import replace

    from easi_jax.errors import UserError
    from easi_jax.rl.config import EssInfoGailConfig
    from easi_jax.rl.presets import imitating, training_preset
    from train._command import say

    config = training_preset(env, algorithm)
    if env_steps is not None:
        config = replace(config, env_steps=env_steps)
    path = imitated.get("demonstrations")
    if not isinstance(config, EssInfoGailConfig):
        if imitated:
            raise UserError(
                f"--{next(iter(imitated))} goes with --algorithm ess_infogail: add it"
            )
        return config
    if path is None:
        raise UserError(
            "--algorithm ess_infogail imitates: give --demonstrations FILE (python -m "
            "train.demonstrate makes them)"
        )
    options = {k: v for k, v in imitated.items() if k != "demonstrations"}
    config = imitating(config, env, Path(path), **options)
    assert config.demonstrations is not None
    for note in config.demonstrations.notes:
        say(f"note: {note}")
    return config


def imitation_of(config: Any) -> dict[str, Any]:
    """Options of imitation that a command or a run folder was given."""
    get = config.get if isinstance(config, dict) else partial(getattr, config)
    return {name: get(name) for name in _IMITATES if get(name) is not None}


def recorded(given: Given, config: Any, training: Any) -> dict[str, Any]:
    """What a run folder keeps of a command's options: of imitation what was given, and
    what the demonstrations were."""
    found = given.recorded(config)
    for name in (*_IMITATES, "found"):
        if found.get(name) is None:
            found.pop(name, None)
    shown = getattr(training, "demonstrations", None)
    return found if shown is None else {**found, _DIGEST: shown.digest}


_DIGEST = "demonstrations_sha256"


# Where the reference's recipe is another than the preset, which is Cartpole's.
_PAPER = {
    robot: {"discriminator_updates": 20, "stale_first_observation": True}
    for robot in ("ant", "ballbalance")
}


def search_config(
    preset: str, settings: tuple[str, ...], robot: str = "", **changes: Any
) -> Any:
    """A search preset with ``NAME=VALUE`` settings and keyword changes (not None); the
    preset `paper` is that of the ``robot``.

    Raises:
        UserError: unknown preset or name, or a value of the wrong kind.
    """
    from easi_jax.errors import UserError, nearest
    from easi_jax.search.config import preset as make

    base = make(preset)
    known = asdict(base)
    chosen = dict(_PAPER.get(robot, {})) if preset == "paper" else {}
    chosen |= {k: v for k, v in changes.items() if v is not None}
    for setting in settings:
        name, sign, text = setting.partition("=")
        if not sign or name not in known:
            raise UserError(
                f"--set {setting}: write NAME=VALUE with a name of the search "
                f"settings{nearest(name, known)}"
            )
        chosen[name] = _value(setting, text, known[name])
    return make(preset, **chosen)


def chosen_search(config: Any, robot: str = "", **changes: Any) -> Any:
    """`search_config` of a command's `SearchOptions`."""
    return search_config(
        config.preset,
        config.set,
        robot,
        strategy=config.strategy,
        generations=config.generations,
        population=config.population,
        **changes,
    )


def _value(setting: str, text: str, like: Any) -> Any:
    from easi_jax.errors import UserError

    try:
        if isinstance(like, bool):
            return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
        if isinstance(like, tuple):
            return tuple(int(x) for x in text.split(",") if x)
        return type(like)(text)
    except (KeyError, ValueError):
        kind = {bool: "true or false", tuple: "whole numbers with commas"}
        wanted = kind.get(type(like), f"a {type(like).__name__}")
        raise UserError(f"--set {setting}: the value must be {wanted}") from None


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raises UserError for an empty list and for seeds that are repeated, negative or
    too large: jax takes 32 bits of them."""
    from easi_jax.errors import UserError

    most = 2**32 - 1
    good = seeds and len(set(seeds)) == len(seeds) and min(seeds) >= 0
    if not good or max(seeds) > most:
        raise UserError(
            f"seeds are {list(seeds)}: give at least one, each 0 to {most} and once"
        )


def check_chunk(chunk: int | None) -> None:
    """Raises UserError for a chunk below one."""
    from easi_jax.errors import UserError

    if chunk is not None and chunk < 1:
        raise UserError(f"--chunk is {chunk}: give at least 1")


def training_chunk(chunk: int | None, training: Any) -> int:
    """Iterations between two signs of life: those asked for, or about 50,000 control
    steps, and a whole number of evaluations."""
    if chunk is not None:
        return chunk
    every = training.evaluate_every or 1
    return max(1, round(50_000 / (training.steps_per_iteration * every))) * every


def env_of(folder: Path, made_with: Any, path: Path | None) -> Any:
    """The environment that a run folder was made with, its effects left out.

    Args:
        folder: named in messages.
        made_with: ``robot`` and ``env`` as the folder holds them.
        path: ``--env`` of this command. A folder's own word for a file is not enough:
            the file is run, and folders are passed on.

    Raises:
        UserError: the folder needs ``--env``, or does not go with it.
    """
    from easi_jax.errors import UserError
    from envs import open_env

    theirs = made_with.get("env")
    if theirs and path is None:
        raise UserError(
            f"{folder} was made with the environment {theirs}: say --env FILE with a "
            "file that you trust, it will be run"
        )
    if path is not None and not theirs:
        raise UserError(
            f"{folder} was made with the built-in robot {made_with['robot']}: leave "
            "--env out"
        )
    return open_env(made_with["robot"], path, made_with.get("option", ()))


def target_of(
    env: Any, changes: tuple[str, ...] | None, given: Given
) -> tuple[str, ...]:
    """Changes of the pseudo-real robot; where none are given the environment's own, or
    nothing besides the effects that it was given."""
    if changes is not None:
        return changes
    return () if given.target_effects else getattr(env, "default_target", ())


def save_policies(folder: Any, method: str, policies: Any) -> None:
    """Keeps the policies ``(S, ...)`` of one method in a run folder."""
    from easi_jax.io.runs import checkpoints

    place = folder.checkpoints / f"policy_{method}"
    checkpoints.save(place, 0, policies, config_hash=folder.config_hash)


def load_policies(
    folder: Path,
    method: str | None = None,
    env_file: Path | None = None,
    given: Given | None = None,
) -> dict[str, Any]:
    """Policies of a finished run of train.udr, train.easi or train.pipeline.

    Args:
        folder: the run folder.
        method: UDR, Fixed, EASI or Oracle; the run's own where not given.
        env_file: see `env_of`.
        given: effects that the robot has; the run's own where there are none.

    Returns:
        ``env``, its ``option``, ``seeds``, ``training``, ``method``, ``policies`` ``(S,
        ...)``, and the effects that ``env`` has, ``given``.

    Raises:
        UserError: no finished run, or none of that method.
    """
    import jax

    from easi_jax.errors import UserError, nearest
    from easi_jax.io.runs import checkpoints
    from easi_jax.io.runs.folder import read_config
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig

    config = read_config(folder)
    if not (folder / "results.json").exists():
        if config.get("data"):
            raise UserError(
                f"{folder} holds no policy: train.easi --data trains none; give a run "
                "of train.udr, train.pipeline, or train.easi without --data"
            )
        raise UserError(f"{folder} holds an unfinished run: finish it with --resume")
    result = read_policies(folder / "results.json")
    own = "EASI" if "EASI" in result["methods"] else result["methods"][0]
    chosen = method or own
    if chosen not in result["methods"]:
        raise UserError(
            f'{folder} has no policy "{chosen}" (it has '
            f"{', '.join(result['methods'])}){nearest(chosen, result['methods'])}"
        )
    if given is None or given.effects is None:
        given = Given(result.get("effects"))
    env = as_found(folder, env_of(folder, result, env_file), given)
    seeds = tuple(result["seeds"])
    training = acting_config(env, result)
    pipe = Pipeline(env, PipelineConfig(training=training))
    keys = jax.random.split(jax.random.key(0), len(seeds))
    target = jax.eval_shape(
        lambda k: pipe.policies(
            pipe.train_init(k, pipe.spread(pipe.udr(), len(seeds)))
        ),
        keys,
    )
    found = checkpoints.restore(folder / "checkpoints" / f"policy_{chosen}", target)
    if found is None:
        raise UserError(f"{folder} has lost its policies: run it again")
    return {
        "env": env,
        "option": tuple(result.get("option", ())),
        "seeds": seeds,
        "training": training,
        "method": chosen,
        "policies": found.state,
        "given": given,
    }


def acting_config(env: Any, result: Mapping[str, Any]) -> Any:
    """Settings of a training with policies of the form that a run's have; what they
    imitated is not needed to act."""
    from dataclasses import replace

    from easi_jax.rl.config import EssInfoGailConfig
    from easi_jax.rl.presets import training_preset

    config = training_preset(env, result.get("algorithm") or "sac")
    steps = result["env_steps"]
    config = config if steps is None else replace(config, env_steps=steps)
    return config.acting() if isinstance(config, EssInfoGailConfig) else config


def check_same_demonstrations(folder: Path, config: Any, training: Any) -> None:
    """Refuses demonstrations that are not those that a run of ``folder`` imitated.

    Raises:
        UserError: they are others.
    """
    from easi_jax.errors import UserError

    given = getattr(training, "demonstrations", None)
    if given is not None and config.get(_DIGEST, given.digest) != given.digest:
        raise UserError(
            f"{given.source} is not what {folder} imitated: put the file back, or run "
            "train.udr again"
        )


def read_policies(path: Path) -> dict[str, Any]:
    """``results.json`` of a run that has policies.

    Raises:
        UserError: of another run, or edited into another form.
    """
    from easi_jax.errors import UserError
    from easi_jax.io.files import read_json
    from easi_jax.io.runs.schemas import POLICIES, checked

    told = read_json(path)
    if isinstance(told, dict) and "methods" not in told:
        raise UserError(f"{path.parent} holds no policies: no policy was trained there")
    told = checked(told, POLICIES, f"{path} is not the result of a training")
    if not told["methods"]:
        raise UserError(f"{path}: no method")
    check_seeds(tuple(told["seeds"]))
    return told


def load_udr(folder: Path, env_file: Path | None = None) -> dict[str, Any]:
    """What ``train.udr`` left: seeds, settings, policies, training states.

    ``env_file``: see `env_of`. ``env`` has no effects yet; ``given`` are the run's.

    Raises:
        UserError: the folder holds no finished run of train.udr.
    """
    import jax

    from easi_jax.errors import UserError
    from easi_jax.io.runs import checkpoints
    from easi_jax.io.runs.folder import config_hash, read_config
    from easi_jax.io.runs.schemas import TRAINED, checked
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys

    config = read_config(folder)
    if "robot" not in config or "env_steps" not in config or "udr" in config:
        raise UserError(f"{folder} holds no run of train.udr; give one with --udr")
    config = checked(config, TRAINED, f"{folder} holds no run of train.udr")
    if not (folder / "results.json").exists():
        raise UserError(
            f"{folder} holds an unfinished run of train.udr: finish it with --resume"
        )
    env = env_of(folder, config, env_file)
    given = Given(config.get("effects"), config.get("target_effects"))
    trained = as_found(folder, env, given)
    if config.get("fixed"):
        trained = robots(env, given)[1] or trained
    training = training_config(
        *(env, config["env_steps"], config.get("algorithm"), imitation_of(config))
    )
    check_same_demonstrations(folder, config, training)
    pipe = Pipeline(trained, PipelineConfig(training=training))
    seeds = tuple(int(s) for s in config["seeds"])
    keys = seed_keys(list(seeds))
    wide = pipe.spread(pipe.udr(), len(seeds))
    target = jax.eval_shape(lambda k: pipe.train_init(k, wide), keys)
    found = checkpoints.restore(
        folder / "checkpoints" / "train", target, config_hash=config_hash(config)
    )
    if found is None:
        raise UserError(f"{folder} has lost its checkpoint: run train.udr again")
    return {
        "env": env,
        "seeds": seeds,
        "training": training,
        "trainer": pipe.trainer,
        "states": found.state,
        "policies": pipe.policies(found.state),
        "given": given,
        "config": config,
        "method": read_policies(folder / "results.json")["methods"][0],
    }


def load_networks(
    folder: Path,
    env_file: Path | None,
    env: Any,
    training: Any,
    seeds: tuple[int, ...],
) -> Any:
    """Training states of a run of train.udr, one for each of ``seeds``; a seed that it
    lacks gets those of its first.

    Raises:
        UserError: no finished run, or networks of another shape or algorithm.
    """
    import jax
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.rl.config import EssInfoGailConfig
    from easi_jax.rl.presets import algorithm_of

    old = load_udr(folder, env_file)
    theirs = old["training"]
    pairs = (
        ("robot", old["env"].name, env.name),
        ("observation size", old["env"].obs_size, env.obs_size),
        ("action size", old["env"].action_size, env.action_size),
        ("algorithm", algorithm_of(theirs), algorithm_of(training)),
        ("hidden layers", tuple(theirs.hidden), tuple(training.hidden)),
    )
    if isinstance(theirs, EssInfoGailConfig):
        pairs += tuple(
            (name.replace("_", " "), getattr(theirs, name), getattr(training, name))
            for name in ("skills", "continuous", "frames", "judge_hidden")
        )
        labels = (getattr(c.demonstrations, "skills", ()) for c in (theirs, training))
        pairs += (("list of labels", *labels),)
    for what, one, other in pairs:
        if one != other:
            raise UserError(
                f"--start-from {folder}: its {what} is {one}, this training's {other}"
            )
    at = np.array([old["seeds"].index(s) if s in old["seeds"] else 0 for s in seeds])
    return jax.tree.map(lambda x: x[at], old["states"])

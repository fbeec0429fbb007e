"""``python -m train.export``: what a run found, for those who have not this package."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any

import tyro

from train._command import main, say
from train._options import OwnEffectsOptions

_FORMS = ("onnx", "stablehlo", "mjcf", "randomization")


@dataclasses.dataclass(frozen=True)
class Config(OwnEffectsOptions):
    """Writes a run's policy and parameters for other programs.

    onnx: the policy with its normalizer and action scaling, for onnxruntime
    (examples/onnx_policy/loop.py drives a robot with it). stablehlo: the same as
    jax.export writes it. mjcf: the model with the identified parameters and effects,
    for plain MuJoCo. randomization: ranges and covariance as YAML, for domain
    randomization in brax, MuJoCo Playground (easi_jax.export.randomization) and others
    (docs/export.md).
    """

    run_folder: Annotated[Path, tyro.conf.Positional]
    """Finished run of train.udr, train.easi or train.pipeline."""
    to: tuple[str, ...] = ()
    """onnx, stablehlo, mjcf, randomization; not given: all that the run has."""
    out: Path | None = None
    """Folder for the files; RUN_FOLDER/export where not given."""
    method: str | None = None
    """Policy to export: UDR, Fixed, EASI or Oracle; the run's own where not given."""
    seed: int | None = None
    """Seed whose policy and parameters are exported; not given: the first, for a
    search in logs the one that predicts best."""
    env: Path | None = None
    """The environment file that the run was made with."""
    model: Path | None = None
    """MJCF that the robot's model came from, for mjcf; a built-in robot's own, and that
    of a search in logs, where not given."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""


def run(config: Config) -> None:
    """Reads, converts, writes."""
    from easi_jax.errors import UserError, nearest

    for form in config.to:
        if form not in _FORMS:
            known = ", ".join(_FORMS)
            raise UserError(f'--to "{form}": {known}{nearest(form, _FORMS)}')
    from easi_jax.io.files import atomic_write
    from easi_jax.io.runs.folder import read_config
    from easi_jax.io.runs.schemas import read_checked

    settings, results = read_config(config.run_folder), {}
    if (config.run_folder / "results.json").exists():
        results = read_checked(config.run_folder / "results.json", {}, "a run's result")
    policies = "methods" in results
    identified = (config.run_folder / "distribution.json").exists()
    has = {"onnx": policies, "stablehlo": policies}
    has |= {"mjcf": identified, "randomization": identified}
    if not any(has.values()):
        raise UserError(f"{config.run_folder} holds no finished run")
    for form in config.to:
        if not has[form]:
            what = (
                "policy" if form in ("onnx", "stablehlo") else "identified parameters"
            )
            raise UserError(f"--to {form}: {config.run_folder} holds no {what}")
    chosen = config.to or tuple(form for form in _FORMS if has[form])
    files: dict[str, str | bytes] = {}
    if {"onnx", "stablehlo"} & {*chosen}:
        files |= _policy_files(config, chosen)
    if {"mjcf", "randomization"} & {*chosen}:
        files |= _parameter_files(config, {**settings, **results}, chosen)
    out = config.out or config.run_folder / "export"
    source = config.model or settings.get("model")
    replaced = {os.path.realpath(out / name) for name in files}
    if source and os.path.realpath(str(source)) in replaced:
        raise UserError(
            f"--out {out} would replace the model that the run was made with: name "
            "another folder"
        )
    for name, content in files.items():
        atomic_write(out / name, content)
        say(f"written: {out / name}")


def _policy_files(config: Config, chosen: tuple[str, ...]) -> dict[str, str | bytes]:
    import jax

    from easi_jax.errors import UserError
    from easi_jax.export.policy import FORMS, interface_of, policy_files
    from train._robots import load_policies

    found = load_policies(config.run_folder, config.method, config.env)
    seeds, env = found["seeds"], found["env"]
    if config.seed is not None and config.seed not in seeds:
        known = ", ".join(map(str, seeds))
        raise UserError(f"--seed {config.seed}: the run has {known}")
    at = 0 if config.seed is None else seeds.index(config.seed)
    policy = jax.tree.map(lambda x: x[at], found["policies"])
    mapped = getattr(env, "action_map", None)
    forms = tuple(form for form in chosen if form in FORMS)
    told = {"method": found["method"], "seed": seeds[at]}
    files = policy_files(policy, interface_of(env), mapped, forms, **told)
    if mapped is None:
        say(f"note: {env.name} has no action_map: the policy's output is its action")
    return files


def _parameter_files(
    config: Config, settings: dict[str, Any], chosen: tuple[str, ...]
) -> dict[str, str | bytes]:
    from easi_jax.errors import UserError
    from easi_jax.export.randomization import to_yaml
    from easi_jax.io.runs.schemas import read_distribution

    found = read_distribution(config.run_folder / "distribution.json")
    seed = str(found["best_seed"] if config.seed is None else config.seed)
    if seed not in found["seeds"]:
        raise UserError(f"--seed {seed}: the run has {', '.join(found['seeds'])}")
    robot = str(settings.get("robot") or settings.get("model") or "robot")
    files: dict[str, str | bytes] = {}
    if "randomization" in chosen:
        files["randomization.yaml"] = to_yaml(found, seed, Path(robot).stem)
    if "mjcf" in chosen:
        files |= _model_files(config, settings, found, seed)
    return files


def _model_files(
    config: Config, settings: dict[str, Any], found: dict[str, Any], seed: str
) -> dict[str, str | bytes]:
    from easi_jax.export.mjcf import written_machine
    from easi_jax.io.runs.schemas import space_of
    from train._effects import found_in

    parameters = space_of(found).parameters
    means = found["seeds"][seed]["mean"]
    values = {p.name: mean for p, mean in zip(parameters, means, strict=True)}
    effects = found_in(settings.get("effects"))
    model = written_machine(*_model_of(config, settings), parameters, values, effects)
    if model.left:
        say(f"note: not in model.xml: {', '.join(model.left)}")
    return model.files()


def _model_of(config: Config, settings: dict[str, Any]) -> tuple[Path, Any, Any]:
    """File of the run's model, the model, and its control step where there is one."""
    from easi_jax.errors import UserError
    from easi_jax.io.models.mjcf import check_assets
    from easi_jax.io.runs.folder import has_changed
    from easi_jax.io.runs.schemas import MADE_WITH, checked
    from envs import REGISTRY
    from envs.robot import model_file
    from train._log_problem import load_model
    from train._robots import env_of

    if settings.get("model"):  # of measured logs
        path = Path(config.model or str(settings["model"]))
        named = [path, *check_assets(path, config.allow_assets)]
        changed = [p for p in named if has_changed(config.run_folder, p)]
        if changed:
            say(
                f"note: {changed[0]} has changed since the run was made: model.xml has "
                "what was found in the model as it was, and the changes"
            )
        held = None
        if settings.get("held_base"):
            mapping = settings.get("mapping")
            logs = [Path(p) for p in settings.get("data", ())]
            held = (logs, Path(mapping) if mapping else None)
        return path, load_model(path, config.allow_assets, held), None
    settings = checked(settings, MADE_WITH, f"{config.run_folder} holds no run")
    env = env_of(config.run_folder, settings, config.env)
    if config.model is not None:
        load_model(config.model, config.allow_assets)
        return config.model, env.mj_model, env.dt
    if env.name not in REGISTRY:
        raise UserError(
            f"{env.name} does not say which file its model is from: give --model M.xml"
        )
    return model_file(env.name), env.mj_model, env.dt


if __name__ == "__main__":
    main(Config, run, name="train.export")

"""``python -m train.evaluate``: test a trained policy in any target."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from train._command import compiled, main, say, show_table
from train._options import EngineOptions, OwnEffectsOptions


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions, OwnEffectsOptions):
    """Tests the policies of a run in a target of your choice.

    Prints the return of every seed and, with --out, writes all episodes as JSON.
    """

    run: Path = Path("results/easi")
    """Folder of a finished run of train.udr, train.easi or train.pipeline."""
    env: Path | None = None
    """The Python file of your own environment, where the run was made with one."""
    policy: str | None = None
    """UDR, Fixed, EASI or Oracle; not given: what the run was made for."""
    target: tuple[str, ...] = ()
    """The robot to test in: parameters that differ from the nominal ones, as
    NAME*FACTOR or NAME=VALUE."""
    effects: Path | None = None
    """Effects of the robot to test in (effects.yaml of train.gap); not given: those
    that the policy was trained with."""
    episodes: int = 100
    """Episodes for each seed."""
    seed: int = 0
    """Seed of resets."""
    beside: Path | None = None
    """Another run of the same robot: its policy is tested in the same target from the
    same resets, and the video shows it on the right."""
    out: Path | None = None
    """JSON file to write; nothing is written where not given."""
    render: Path | None = None
    """Motion in one episode of the first seed to write: a video, .gif or .mp4 (with
    ffmpeg), or six moments of it, .svg."""


@dataclasses.dataclass(frozen=True)
class _Played:
    """What a policy did: its run, as `train._robots.load_policies` gives it, the
    target, returns ``(S, episodes)``, and positions of an episode ``(T + 1, nq)``."""

    saved: dict[str, Any]
    target: Any
    returns: Any
    motion: Any


def run(config: Config) -> None:
    """Evaluates and prints."""
    from easi_jax.errors import UserError
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.report.video import check_video
    from train._effects import effect_notes, read_given
    from train._robots import check_seeds, load_policies

    check_seeds((config.seed,))
    if config.episodes < 1:
        raise UserError(f"--episodes is {config.episodes}: give at least 1")
    if config.render is not None:
        check_video(config.render)
    given = read_given(config)
    runs = [load_policies(config.run, config.policy, config.env, given)]
    if config.beside is not None:
        runs.append(load_policies(config.beside, None, config.env, given))
        names = [saved["env"].name for saved in runs]
        if names[0] != names[1]:
            raise UserError(
                f"{config.beside} is of {names[1]}, and {config.run} of {names[0]}: "
                "only runs of one robot can be shown beside each other"
            )
    every = [_played(config, saved) for saved in runs]
    for played in every:
        saved = played.saved
        rows = [
            (s, f"{r.mean():.1f}", f"{r.std():.1f}", f"{r.min():.1f}")
            for s, r in zip(saved["seeds"], played.returns, strict=True)
        ]
        show_table(
            f"{saved['method']} policy on {saved['env'].name}, target "
            f"{', '.join(config.target) or 'nominal'}",
            ("seed", "mean return", "std of episodes", "worst episode"),
            rows,
        )
        for note in effect_notes(saved["given"]):
            say(note)
    if config.out is not None:
        result = _result(every[0])
        if len(every) > 1:
            result["beside"] = _result(every[1])
        atomic_write(config.out, to_json(result))
        say(f"written: {config.out}")
    if config.render is not None:
        _render(config.render, every)
        say(f"written: {config.render}")


def _played(config: Config, saved: dict[str, Any]) -> _Played:
    """Plays the policies of a run."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, target_parameters
    from easi_jax.simulation.compile_time import expected

    env = saved["env"]
    theta = target_parameters(env.space, config.target)
    pipe = Pipeline(
        env, PipelineConfig(training=saved["training"], eval_episodes=config.episodes)
    )
    keys = jax.random.split(jax.random.key(config.seed), len(saved["seeds"]))
    target = jnp.asarray(theta, jnp.float32)
    play = partial(jax.jit(pipe.play), saved["policies"], target, keys)
    returns, motion = map(
        np.asarray, compiled("physics", play, expected(pipe.simulator))
    )
    return _Played(saved, theta, returns, motion[0])


def _result(played: _Played) -> dict[str, Any]:
    saved = played.saved
    env, seeds = saved["env"], zip(saved["seeds"], played.returns, strict=True)
    return {
        "robot": env.name,
        "method": saved["method"],
        "target": dict(zip(env.space.names, played.target.tolist(), strict=True)),
        "returns": {str(s): r.tolist() for s, r in seeds},
        **saved["given"].results(),
    }


def _render(path: Path, every: Sequence[_Played]) -> None:
    """Draws what was played, side by side, each with the name of its policy."""
    from easi_jax.io.report.video import side_by_side

    env = every[0].saved["env"]
    motions = [(played.saved["method"], played.motion) for played in every]
    side_by_side(
        *(path, env.mj_model, env.dt, motions), lambda text: say(f"note: {text}")
    )


if __name__ == "__main__":
    main(Config, run, name="train.evaluate")

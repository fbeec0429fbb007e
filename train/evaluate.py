"""``python -m train.evaluate``: test a trained policy in any target."""

import dataclasses
from functools import partial
from pathlib import Path

from train._command import compiled, main, say, show_table
from train._options import EngineOptions, OwnEffectsOptions

_FPS = 25  # frames per second of a video, about


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
    out: Path | None = None
    """JSON file to write; nothing is written where not given."""
    render: Path | None = None
    """Video of one episode of the first seed to write, .gif or .mp4 (with ffmpeg)."""


def run(config: Config) -> None:
    """Evaluates and prints."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.report.video import check_video, render, write_video
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, target_parameters
    from easi_jax.simulation.compile_time import expected
    from train._effects import effect_notes, read_given
    from train._robots import check_seeds, load_policies

    check_seeds((config.seed,))
    if config.episodes < 1:
        raise UserError(f"--episodes is {config.episodes}: give at least 1")
    if config.render is not None:
        check_video(config.render)
    given = read_given(config)
    saved = load_policies(config.run, config.policy, config.env, given)
    env = saved["env"]
    theta = target_parameters(env.space, config.target)
    pipe = Pipeline(
        env, PipelineConfig(training=saved["training"], eval_episodes=config.episodes)
    )
    key = jax.random.key(config.seed)
    keys = jax.random.split(key, len(saved["seeds"]))
    target = jnp.asarray(theta, jnp.float32)
    play = partial(jax.jit(pipe.play), saved["policies"], target, keys)
    returns, motion = map(
        np.asarray, compiled("physics", play, expected(pipe.simulator))
    )
    rows = [
        (s, f"{r.mean():.1f}", f"{r.std():.1f}", f"{r.min():.1f}")
        for s, r in zip(saved["seeds"], returns, strict=True)
    ]
    show_table(
        f"{saved['method']} policy on {env.name}, target "
        f"{', '.join(config.target) or 'nominal'}",
        ("seed", "mean return", "std of episodes", "worst episode"),
        rows,
    )
    for note in effect_notes(saved["given"]):
        say(note)
    if config.out is not None:
        result = {
            "robot": env.name,
            "method": saved["method"],
            "target": dict(zip(env.space.names, theta.tolist(), strict=True)),
            "returns": {
                str(s): r.tolist() for s, r in zip(saved["seeds"], returns, strict=True)
            },
            **saved["given"].results(),
        }
        atomic_write(config.out, to_json(result))
        say(f"written: {config.out}")
    if config.render is not None:
        every = max(1, round(1 / (_FPS * env.dt)))
        shown = motion[0][::every]
        frames = render(env.mj_model, shown, tell=lambda text: say(f"note: {text}"))
        write_video(config.render, frames, 1 / (every * env.dt))
        say(f"written: {config.render}")


if __name__ == "__main__":
    main(Config, run, name="train.evaluate")

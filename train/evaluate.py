"""``python -m train.evaluate``: test a trained policy in any target."""

import dataclasses
from pathlib import Path

from train._command import main, say, show_table


@dataclasses.dataclass(frozen=True)
class Config:
    """Tests the policies of a run in a target of your choice.

    Prints the return of every seed and, with --out, writes all episodes as JSON.
    """

    run: Path = Path("results/easi")
    """Folder of a finished run of train.udr, train.easi or train.pipeline."""
    policy: str | None = None
    """UDR, EASI or Oracle; not given: what the run was made for."""
    target: tuple[str, ...] = ()
    """The robot to test in: parameters that differ from the nominal ones, as
    NAME*FACTOR or NAME=VALUE."""
    episodes: int = 100
    """Episodes for each seed."""
    seed: int = 0
    """Seed of resets."""
    out: Path | None = None
    """JSON file to write; nothing is written where not given."""


def run(config: Config) -> None:
    """Evaluates and prints."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.pipeline import Pipeline, PipelineConfig, target_parameters
    from envs import make
    from train._robots import load_policies

    if config.episodes < 1:
        raise UserError(f"--episodes is {config.episodes}: give at least 1")
    saved = load_policies(config.run, config.policy)
    env = make(saved["robot"])
    theta = target_parameters(env.space, config.target)
    pipe = Pipeline(
        env, PipelineConfig(training=saved["training"], eval_episodes=config.episodes)
    )
    key = jax.random.key(config.seed)
    keys = jax.random.split(key, len(saved["seeds"]))
    returns = np.asarray(
        jax.jit(pipe.returns)(saved["policies"], jnp.asarray(theta, jnp.float32), keys)
    )
    rows = [
        (s, f"{r.mean():.1f}", f"{r.std():.1f}", f"{r.min():.1f}")
        for s, r in zip(saved["seeds"], returns, strict=True)
    ]
    show_table(
        f"{saved['method']} policy on {saved['robot']}, target "
        f"{', '.join(config.target) or 'nominal'}",
        ("seed", "mean return", "std of episodes", "worst episode"),
        rows,
    )
    if config.out is not None:
        result = {
            "robot": saved["robot"],
            "method": saved["method"],
            "target": dict(zip(env.space.names, theta.tolist(), strict=True)),
            "returns": {
                str(s): r.tolist() for s, r in zip(saved["seeds"], returns, strict=True)
            },
        }
        config.out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(config.out, to_json(result))
        say(f"written: {config.out}")


if __name__ == "__main__":
    main(Config, run, name="train.evaluate")

"""brax's own PPO and SAC beside ours, on our robots, by the same steps.

    python -m benchmarks.brax_beside
    python -m benchmarks.brax_beside --robots ant --algorithms ppo

Both train in the robot as it is (no randomization), with the settings of our preset as
far as the other has them: environments, unroll, minibatches, epochs, network sizes,
learning rate, discount, reward scale. brax gets the robot by `BraxEnv`, and what its
release still asks of jax and jax no longer has is put in its place here. The policies'
modes are tested in the same 100 episodes. ``steps_per_s`` is of the training's second
half, when everything is compiled. A cell is a line of ``brax_beside.jsonl``; a run that
was stopped goes on.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, at_least_one, commits_of
from benchmarks._page import Section, each_of, table
from train._command import main

WAYS = ("ours", "brax")
ALGORITHMS = ("sac", "ppo")
EPISODES = 100
_FILE = "brax_beside.jsonl"


@dataclasses.dataclass(frozen=True)
class Cell:
    """A training.

    Attributes:
        robot: built-in; ``algorithm``: sac or ppo; ``way``: ours or brax's.
        seed: of everything random.
        env_steps: control steps; the preset's where None.
    """

    robot: str
    algorithm: str
    way: str
    seed: int
    env_steps: int | None = None

    @property
    def key(self) -> str:
        """One line that says it all, for files."""
        words = [self.robot, self.algorithm, self.way, f"seed {self.seed}"]
        return ", ".join(words + [f"{self.env_steps} steps"] * bool(self.env_steps))


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Trains by brax's algorithms and by ours."""

    robots: tuple[str, ...] = ("cartpole",)
    """Built-in robots."""
    algorithms: tuple[str, ...] = ALGORITHMS
    """sac, ppo."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds."""
    env_steps: int | None = None
    """Control steps of each training; those of our preset where not given."""
    out: Path = dataclasses.field(default=RESULTS / _FILE, kw_only=True)
    """Where a line for each is added."""


def run(config: Config) -> None:
    """Runs the cells that are not there yet."""
    from easi_jax.errors import UserError, nearest
    from envs import REGISTRY
    from train._robots import check_seeds

    check_seeds(config.seeds)
    at_least_one(config, "env_steps")
    for given, known in (
        (config.robots, tuple(REGISTRY)),
        (config.algorithms, ALGORITHMS),
    ):
        for name in given:
            if name not in known:
                raise UserError(f'"{name}": {", ".join(known)}{nearest(name, known)}')
    every = [
        Cell(robot, algorithm, way, seed, config.env_steps)
        for robot in config.robots
        for algorithm in config.algorithms
        for seed in config.seeds
        for way in WAYS
    ]
    run_cells(
        *(every, config, solve),
        lambda r: f"return {r['return']:.1f}, {r['steps_per_s']:.0f} steps/s",
    )


def solve(cell: Cell) -> dict[str, Any]:
    """Trains and tests.

    Returns:
        ``return`` of the policy's mode, mean of `EPISODES` episodes of the robot as it
        is; ``steps`` asked for, which both round up; ``steps_per_s``; ``seconds`` in
        all, compiling included.
    """
    from easi_jax.baselines.policies import quiet
    from easi_jax.rl.presets import training_preset
    from envs import make

    env = make(cell.robot)
    settings = quiet(training_preset(env, cell.algorithm))
    if cell.env_steps is not None:
        settings = dataclasses.replace(settings, env_steps=cell.env_steps)
    return tried({"ours": ours, "brax": by_brax}[cell.way], env, settings, cell.seed)


def tried(
    train: Callable[[Any, Any, int], "Trained"], env: Any, settings: Any, seed: int
) -> dict[str, Any]:
    """What a training leads to; see `solve`."""
    import jax
    import numpy as np

    from easi_jax.rl.evaluate import evaluate

    begun = time.monotonic()
    act, policy, speed, steps = train(env, settings, seed)
    keys = jax.random.split(jax.random.key(10_000 + seed), EPISODES)
    returns = jax.jit(lambda p, k: evaluate(env, env.model(), p, act, k))(policy, keys)
    return {
        "return": float(np.nanmean(np.asarray(returns))),
        "steps": int(steps),
        "steps_per_s": speed,
        "seconds": time.monotonic() - begun,
    }


Trained = tuple[Callable[..., Any], Any, float, int]


def ours(env: Any, settings: Any, seed: int) -> Trained:
    """A training of ours: ``act``, the policy, steps a second, steps."""
    import jax
    import jax.numpy as jnp

    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys
    from easi_jax.rl.networks import act

    pipe = Pipeline(env, PipelineConfig(training=settings))
    nominal = jnp.asarray(env.space.nominal, jnp.float32)
    dist = pipe.spread(pipe.point(nominal), 1)
    half = max(1, settings.iterations // 2)
    step = jax.jit(
        lambda s, n: pipe.train_chunk(s, dist, nominal, n)[0], static_argnums=1
    )
    state = jax.jit(lambda k: pipe.train_init(k, dist))(seed_keys([seed]))
    state = jax.block_until_ready(step(state, half))
    # An odd step is not timed: both halves are one program.
    if settings.iterations % 2:
        state = jax.block_until_ready(step(state, 1))
    begun = time.monotonic()
    state = jax.block_until_ready(step(state, half))
    speed = half * settings.steps_per_iteration / (time.monotonic() - begun)
    policy = jax.tree.map(lambda x: x[0], pipe.policies(state))
    return act, policy, speed, settings.env_steps


def by_brax(env: Any, settings: Any, seed: int) -> Trained:
    """A training of brax's, with our settings where it has them."""
    from brax.training.agents.ppo import networks as ppo_networks
    from brax.training.agents.ppo import train as ppo
    from brax.training.agents.sac import networks as sac_networks
    from brax.training.agents.sac import train as sac

    from easi_jax.rl.brax_env import BraxEnv
    from easi_jax.rl.config import SacConfig

    seen: list[dict[str, Any]] = []
    common: dict[str, Any] = {
        "environment": BraxEnv(env),
        "num_timesteps": settings.env_steps,
        "episode_length": env.episode_length,
        "num_envs": settings.num_envs,
        "learning_rate": settings.learning_rate,
        "discounting": settings.discount,
        "reward_scaling": settings.reward_scaling,
        "normalize_observations": settings.normalize_observations,
        "seed": seed,
        "max_devices_per_host": 1,
        "num_evals": 3,
        "num_eval_envs": 8,
        "deterministic_eval": True,
        "progress_fn": lambda _, told: seen.append(dict(told)),
    }
    with _as_jax_was():
        if isinstance(settings, SacConfig):

            def q(*sizes: Any, **more: Any) -> Any:
                more |= {"hidden_layer_sizes": settings.hidden}
                more |= {"q_network_layer_norm": settings.critic_layer_norm}
                return sac_networks.make_sac_networks(*sizes, **more)

            make, params, _ = sac.train(
                **common,
                batch_size=settings.batch_size,
                tau=settings.tau,
                min_replay_size=settings.random_steps,
                max_replay_size=settings.capacity,
                grad_updates_per_step=settings.updates_per_step,
                network_factory=q,
            )
        else:

            def actor(*sizes: Any, **more: Any) -> Any:
                hidden = settings.hidden
                return ppo_networks.make_ppo_networks(
                    *sizes,
                    policy_hidden_layer_sizes=hidden,
                    value_hidden_layer_sizes=hidden,
                    **more,
                )

            make, params, _ = ppo.train(
                **common,
                unroll_length=settings.unroll,
                batch_size=settings.num_envs // settings.minibatches,
                num_minibatches=settings.minibatches,
                num_updates_per_batch=settings.epochs,
                entropy_cost=settings.entropy_cost,
                clipping_epsilon=settings.clipping,
                gae_lambda=settings.gae_lambda,
                max_grad_norm=settings.max_gradient,
                vf_loss_coefficient=settings.value_cost,
                network_factory=actor,
            )

    def act(params: Any, obs: Any, key: Any, deterministic: bool = True) -> Any:
        return make(params, deterministic=deterministic)(obs, key)[0]

    speeds = [told["training/sps"] for told in seen if "training/sps" in told]
    return act, params, float(speeds[-1]), settings.env_steps


@contextmanager
def _as_jax_was() -> Iterator[None]:
    """With the function of jax that brax 0.14.2 calls and this jax no longer has."""
    import jax
    import jax.numpy as jnp

    def replicated(tree: Any, devices: Any) -> Any:
        return jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(devices)), tree)

    lacks = not hasattr(jax, "device_put_replicated")
    if lacks:
        jax.device_put_replicated = replicated  # type: ignore[attr-defined]
    try:
        yield
    finally:
        if lacks:
            del jax.device_put_replicated


def _paragraphs(rows: list[dict[str, Any]]) -> list[str]:
    groups: dict[tuple[str, str, int], dict[str, list[dict[str, Any]]]] = {}
    for r in sorted(rows, key=lambda r: r["seed"]):
        group = groups.setdefault((r["robot"], r["algorithm"], r["steps"]), {})
        group.setdefault(r["way"], []).append(r)
    lines = []
    for (robot, algorithm, steps), by in groups.items():
        for way, some in by.items():
            lines.append(
                {
                    "what": f"{robot}, {algorithm}",
                    "way": way,
                    "steps": f"{steps:,}",
                    "returns": [r["return"] for r in some],
                    "speed": mean(r["steps_per_s"] for r in some),
                    "on": some[0]["versions"]["runtime"]["device_kind"],
                }
            )
    columns = {
        "robot and algorithm": "{what}",
        "by": "{way}",
        "control steps": "{steps}",
        "return (every seed)": lambda r: (
            f"{mean(r['returns']):.1f} ({each_of(r['returns'], 1)})"
        ),
        "steps a second": lambda r: f"{r['speed']:,.0f}",
        "on": "{on}",
    }
    return [
        "`python -m benchmarks.brax_beside`: brax's PPO and SAC through `BraxEnv`, "
        "with the settings of our preset as far as brax has them (its learning rate "
        f"does not fall), in the robot as it is, commits {commits_of(rows)}. Steps a "
        "second are of the second half of a training.",
        table(lines, columns),
    ]


SECTIONS = (Section("## Training beside brax's", _FILE, "brax_beside", _paragraphs),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.brax_beside")

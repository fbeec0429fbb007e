"""Cells of the paper's tables: one method, robot, target and seed each."""

import dataclasses
import fcntl
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

EPISODES = 100


@dataclasses.dataclass(frozen=True)
class Cell:
    """What is run once, whichever tables show it.

    Attributes:
        method: a name in `METHODS`.
        robot: built-in robot.
        target: the machine: nominal but for ``NAME*FACTOR``; empty: nominal.
        seed: of everything random.
        trajectories: demonstrations.
        env_steps: control steps of a training; the robot's own where None.
        start: where a search starts, factors on the nominal values; UDR's range where
            None.
        settings: of the search, ``NAME=VALUE``.
        policy: whether a policy is trained and tested, or only parameters are sought.
    """

    method: str
    robot: str
    target: str
    seed: int
    trajectories: int = 200
    env_steps: int | None = None
    start: tuple[float, float] | None = None
    settings: tuple[str, ...] = ()
    policy: bool = True

    @property
    def key(self) -> str:
        """One line that says it all, for files."""
        words = [self.method, self.robot, self.target or "nominal", f"seed {self.seed}"]
        if self.trajectories != 200:
            words.append(f"{self.trajectories} trajectories")
        if self.env_steps is not None:
            words.append(f"{self.env_steps} steps")
        if self.start is not None:
            words.append(f"from {self.start[0]:g} to {self.start[1]:g}")
        words += self.settings
        if not self.policy:
            words.append("no policy")
        return ", ".join(words)


def identifiers() -> dict[str, Callable[[Cell], Any]]:
    """Methods that find a distribution over parameters."""
    from easi_jax.methods import Dropo, Easi, PairedCmaEs, RandomSearch, SimOpt
    from train._robots import search_config

    def easi(preset: str, refine: bool) -> Callable[[Cell], Any]:
        return lambda cell: Easi(search_config(preset, cell.settings), refine)

    return {
        "EASI paper": easi("paper", False),
        "EASI default": easi("default", True),
        "EASI default, not refined": easi("default", False),
        "SimOpt": lambda _: SimOpt(),
        "CMA-ES": lambda _: PairedCmaEs(),
        "DROPO": lambda _: Dropo(),
        "random search": lambda _: RandomSearch(),
    }


def learners() -> dict[str, Callable[[Cell], Any]]:
    """Methods that end with a policy."""
    from easi_jax.methods import FineTune, Garat, Oracle

    return {
        "Oracle": lambda _: Oracle(),
        "FineTune": lambda cell: FineTune(random_steps=_random(cell.robot)),
        "FineTune, no random actions": lambda _: FineTune(random_steps=0),
        "GARAT": lambda _: Garat(),
    }


METHODS = (
    *("UDR", "Oracle", "FineTune", "FineTune, no random actions", "GARAT"),
    *("EASI paper", "EASI default", "EASI default, not refined"),
    *("SimOpt", "CMA-ES", "DROPO", "random search"),
)


def _random(robot: str) -> int:
    """Random actions of the reference's FineTune; PPO has no buffer to fill."""
    from easi_jax.rl.config import SacConfig
    from easi_jax.rl.presets import training_preset
    from envs import make

    return 10_000 if isinstance(training_preset(make(robot)), SacConfig) else 0


def solve(cell: Cell, folder: Path) -> dict[str, Any]:
    """Runs a cell; UDR trainings are kept in ``folder`` for all that need them.

    Returns:
        ``return`` in the target (mean of `EPISODES` episodes) where there is a policy;
        ``log_ratio`` of each parameter to the truth and unit-coordinate ``std`` where a
        distribution was found; what was ``simulated`` and ``measured``, ``seconds``.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax import distribution
    from easi_jax.methods import Budget, Practice, Task
    from easi_jax.methods.policies import Learned, quiet, trained
    from easi_jax.pipeline import (
        Pipeline,
        PipelineConfig,
        seed_keys,
        stage_keys,
        target_parameters,
    )
    from easi_jax.rl.evaluate import evaluate
    from easi_jax.rl.networks import act
    from easi_jax.rollout import policy_rollout
    from envs import make
    from train._robots import load_udr, training_config

    env = make(cell.robot)
    training = quiet(training_config(env, cell.env_steps))
    changes = (cell.target,) if cell.target else ()
    theta = target_parameters(env.space, changes)
    target = jnp.asarray(theta, jnp.float32)
    udr = load_udr(udr_run(cell, folder))
    state, policy = jax.tree.map(lambda x: x[0], (udr["states"], udr["policies"]))
    pipe = Pipeline(
        env,
        PipelineConfig(training=training, trajectories=cell.trajectories),
        start=cell.start,
    )
    keys = stage_keys(seed_keys([cell.seed]))
    demos = jax.tree.map(
        lambda x: x[0],
        jax.jit(pipe.demonstrate)(udr["policies"], target, keys["demonstrate"]),
    )
    k_search, k_final = keys["search"][0], keys["final"][0]
    row: dict[str, Any] = {"simulated": 0, "measured": 0}
    begun = time.monotonic()
    learned = policy

    def train(space: Any, dist: Any, key: Any) -> Any:
        return trained(
            env, training, lambda d, k: distribution.draw(space, d, k), dist, key
        )

    if cell.method in identifiers():

        def record(policy: Any, resets: Any) -> Any:
            def one(key: Any) -> Any:
                return policy_rollout(
                    env,
                    env.model(target),
                    lambda obs, k: act(policy, obs, k, True),
                    key,
                    env.episode_length,
                )

            return jax.jit(jax.vmap(one))(resets)

        task = Task(
            machine=pipe.machine,
            noise=jnp.zeros(2 * env.mj_model.nv),
            env=env,
            act=lambda policy, obs, key: act(policy, obs, key),
            act_best=lambda policy, obs, key: act(policy, obs, key, True),
            policy=policy,
            record=record,
            train=train,
        )
        method = identifiers()[cell.method](cell)
        found = jax.block_until_ready(method.fit(task, demos, Budget(), k_search))
        row["identify_s"] = time.monotonic() - begun
        row |= {"simulated": found.simulated, "measured": found.measured}
        si = np.asarray(found.space.to_si(found.distribution.mean))
        row["log_ratio"] = np.log(np.maximum(si, 1e-30) / theta).tolist()
        row["std"] = np.sqrt(
            np.diag(distribution.covariance(found.distribution))
        ).tolist()
        if cell.policy:
            learned = train(found.space, found.distribution, k_final)
    elif cell.method in learners():
        k = keys["oracle"][0] if cell.method == "Oracle" else k_final
        nominal = jnp.asarray(env.space.nominal, jnp.float32)
        practice = Practice(env, nominal, env, target, training, state, policy)
        got: Learned = learners()[cell.method](cell).fit(practice, demos, k)
        row |= {"simulated": got.simulated, "measured": got.measured}
        learned = got.policy
    if cell.policy:
        jax.block_until_ready(learned)
        row["seconds"] = time.monotonic() - begun
        resets = jax.random.split(keys["evaluate"][0], EPISODES)
        returns = jax.jit(lambda p, k: evaluate(env, env.model(target), p, act, k))
        values = np.asarray(returns(learned, resets))
        row["return"] = float(np.nanmean(values))
        row["lost"] = int(np.isnan(values).sum())
    return row


def udr_run(cell: Cell, folder: Path) -> Path:
    """The run folder of a cell's UDR training, trained where it is not there yet."""
    from train import udr

    steps = "" if cell.env_steps is None else f"_{cell.env_steps}"
    out = folder / f"udr_{cell.robot}{steps}_{cell.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    # Another process may be at it: its result will do.
    with (folder / f"{out.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if (out / "results.json").exists():
            return out
        udr.run(
            udr.Config(
                robot=cell.robot,
                out=out,
                seeds=(cell.seed,),
                env_steps=cell.env_steps,
                resume=True,
            )
        )
    return out

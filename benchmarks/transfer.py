"""Return in targets with one parameter changed: UDR, EASI, Oracle, equal budgets.

    python -m benchmarks.transfer
    python -m benchmarks.transfer --robot ant --seeds 0 1 2

UDR's range stays centered on the nominal robot while one parameter of the target is
multiplied, as in the paper's Fig. 6: the drive's stiffness of Cartpole, the thighs' of
Go2, Ant's torso, Ballbalance's ball. One UDR training serves all targets. Each target
is written when it is done; those not run are absent. ``--joint`` adds a search that
also trains the policy. Curves by training step, as in Fig. 5, are in the report of
``train.easi --oracle``.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS
from train._command import main, say


@dataclasses.dataclass(frozen=True)
class Config:
    """Trains and tests UDR, EASI and Oracle policies, paired by seed."""

    robot: str = "cartpole"
    """Built-in robot."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Seeds, paired over methods."""
    factors: tuple[float, ...] = (0.25, 0.5, 2.0, 4.0)
    """Targets: factors on the robot's parameter that the paper changes."""
    env_steps: int | None = None
    """Control steps of each training; the preset where not given."""
    joint: int = 0
    """Policy updates per generation; 0 as in the paper."""
    generations: int = 50
    """Generations of the search."""
    population: int = 300
    """Individuals in a generation."""
    trajectories: int = 200
    """Demonstration trajectories."""
    episodes: int = 100
    """Episodes of each evaluation."""
    folder: Path = RESULTS
    """Where results are written."""


def run(config: Config) -> None:
    """Runs the targets one after the other."""
    import jax

    from easi_jax.pipeline.stages import target_parameters
    from envs import open_env

    env = open_env(config.robot)
    changed = env.default_target[0].partition("*")[0]
    trial = _Trial(config, env)
    begin = time.monotonic()
    states = jax.block_until_ready(trial.rough())
    say(f"UDR trained in {time.monotonic() - begin:.0f} s")
    for factor in config.factors:
        begin = time.monotonic()
        theta = target_parameters(env.space, (f"{changed}*{factor}",))
        scores, found = trial.target(theta, states)
        _write(
            config,
            factor,
            scores,
            changed=changed,
            target=dict(zip(env.space.names, theta.tolist(), strict=True)),
            changed_found=found[:, env.space.names.index(changed)].tolist(),
            seconds=time.monotonic() - begin,
        )


class _Trial:
    """The programs that all targets share, each compiled once."""

    def __init__(self, config: Config, env: Any) -> None:
        import jax

        from easi_jax.devices.runtime import fast_loops
        from easi_jax.pipeline.stages import (
            Pipeline,
            PipelineConfig,
            seed_keys,
            stage_keys,
        )
        from easi_jax.search.config import preset
        from train._robots import training_config

        search = preset(
            "default",
            policy_updates_per_generation=config.joint,
            generations=config.generations,
            population=config.population,
        )
        training = training_config(env, config.env_steps)
        settings = PipelineConfig(
            search=search,
            training=dataclasses.replace(training, evaluate_every=0),
            trajectories=config.trajectories,
            eval_episodes=config.episodes,
            refine=True,
        )
        self.pipe = pipe = Pipeline(env, settings)
        self.keys = stage_keys(seed_keys(list(config.seeds)))
        self.joint, self.count = bool(config.joint), len(config.seeds)

        def trained(rounds: int) -> Any:
            return jax.jit(lambda s, dist, at: pipe.train_chunk(s, dist, at, rounds)[0])

        self.train = trained(training.iterations)
        self.shorter = trained(pipe.final_iterations()) if self.joint else self.train
        self.start = jax.jit(pipe.train_init)
        self.search = jax.jit(
            lambda k, demos, policies, training: pipe.search_chunk(
                pipe.search_init(k, demos, policies, training),
                demos,
                policies,
                search.generations,
            ),
            compiler_options=fast_loops(),
        )
        self.estimate = jax.jit(pipe.estimate)
        self.demonstrate = jax.jit(pipe.demonstrate)
        self.returns = jax.jit(lambda *a: pipe.play(*a)[0])

    def rough(self) -> Any:
        """Trained under UDR."""
        import jax.numpy as jnp

        nominal = jnp.asarray(self.pipe.real.space.nominal, jnp.float32)
        wide = self.pipe.spread(self.pipe.udr(), self.count)
        return self.train(self.start(self.keys["udr"], wide), wide, nominal)

    def target(self, theta: Any, states: Any) -> tuple[dict[str, Any], Any]:
        """Returns of each method, ``(seeds,)``, in the target ``theta (n,)``, and the
        parameters that were found, ``(seeds, n)`` SI; ``states`` are of `rough`."""
        import jax
        import jax.numpy as jnp
        import numpy as np

        pipe, keys, target = self.pipe, self.keys, jnp.asarray(theta, jnp.float32)
        udr = pipe.policies(states)
        demos = self.demonstrate(udr, target, keys["demonstrate"])
        learner = states if self.joint else ()
        found, _ = self.search(keys["search"], demos, udr, learner)
        result = self.estimate(found, demos)
        first = pipe.final_init(keys["final"], result.distribution, found)
        easi = self.shorter(first, result.distribution, target)
        truth = pipe.spread(pipe.point(target), self.count)
        oracle = self.train(self.start(keys["oracle"], truth), truth, target)
        methods = {
            "UDR": udr,
            "EASI": pipe.policies(easi),
            "Oracle": pipe.policies(oracle),
        }
        scores = {
            m: np.asarray(self.returns(p, target, keys["evaluate"])).mean(1)
            for m, p in methods.items()
        }
        mean = result.distribution.mean
        return scores, np.asarray(jax.vmap(pipe.space.to_si)(mean))


def _write(config: Config, factor: float, scores: dict[str, Any], **more: Any) -> None:
    """Writes what one target gave."""
    import numpy as np

    from benchmarks._common import command_of, show_returns, write_result

    count = len(config.seeds)
    returns = {
        m: dict(zip(map(str, config.seeds), v.tolist(), strict=True))
        for m, v in scores.items()
    }
    gap = scores["Oracle"] - scores["UDR"]
    won = scores["EASI"] - scores["UDR"]
    error = gap.std(ddof=1) / np.sqrt(count) if count > 1 else float("nan")
    share = float(won.mean() / gap.mean())
    draws = np.random.default_rng(0).integers(0, count, (4000, count))
    boot = won[draws].mean(1) / gap[draws].mean(1)
    label = "kp" if config.robot == "cartpole" else config.robot
    joint = f"_joint{config.joint}" * bool(config.joint)
    path = write_result(
        f"transfer_{label}_x{factor:g}{joint}",
        command_of(
            "benchmarks.transfer", dataclasses.replace(config, factors=(factor,))
        ),
        {k: v for k, v in dataclasses.asdict(config).items() if k != "folder"},
        folder=config.folder,
        robot=config.robot,
        returns=returns,
        oracle_minus_udr={"mean": float(gap.mean()), "standard_error": float(error)},
        share_of_gap=share,
        share_95=np.percentile(boot, [2.5, 97.5]).tolist(),
        goal=0.9,
        goal_applies=bool(gap.mean() > 2 * error),
        **more,
    )
    title = f"{more['changed']} x {factor:g}; EASI closes {share:.2f} of the gap"
    show_returns(title, returns)
    say(f"written: {path}")


if __name__ == "__main__":
    main(Config, run, name="benchmarks.transfer")

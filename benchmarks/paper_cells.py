"""Cells of the paper's tables: one method, robot, target and seed each."""

import dataclasses
import fcntl
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.rival_cells import AFTER_GAP

EPISODES = 100
# Control steps that a search may simulate: what EASI takes at most, its finish
# included; where not given, that of the paper's 50 generations.
BUDGETS = {"cartpole": 60_000_000}


@dataclasses.dataclass(frozen=True)
class Machine:
    """What a cell calls a robot.

    Attributes:
        robot: built-in.
        algorithm: of all its trainings; its preset's where None.
        options: of the robot, ``NAME=VALUE``.
    """

    robot: str
    algorithm: str | None = None
    options: tuple[str, ...] = ()


# Built-in robots with another controller than their presets'. The paper's Go2 imitates:
# its reward is the command alone, and it is taught a trot at 0.4 to 1.6 m/s.
IMITATING = "go2-imitating"
CONTROLLED = {
    IMITATING: Machine("go2", "ess_infogail", ("rewarded=command", "forward=0.4:1.6"))
}
# Their trainings go on from UDR's networks, as GARAT's does.
WARM = ("Oracle, warm start", "EASI default, warm start")


@dataclasses.dataclass(frozen=True)
class Cell:
    """What is run once, whichever tables show it.

    Attributes:
        method: a name in `METHODS`.
        robot: built-in robot, or a name in `CONTROLLED`.
        target: the machine: nominal but for ``NAME*FACTOR``; empty: nominal.
        seed: of everything random.
        trajectories: demonstrations.
        env_steps: control steps of a training; the robot's own where None.
        start: where a search starts, factors on the nominal values; UDR's range where
            None.
        settings: of the search, ``NAME=VALUE``.
        policy: whether a policy is trained and tested, or only parameters are sought.
        curves: keep how parameters and returns went on the way.
        options: of the robot, ``NAME=VALUE``.
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
    curves: bool = False
    options: tuple[str, ...] = ()

    @property
    def machine(self) -> Machine:
        """The robot and what controls it."""
        own = CONTROLLED.get(self.robot, Machine(self.robot))
        return dataclasses.replace(own, options=(*own.options, *self.options))

    def env(self) -> Any:
        """The robot as an environment."""
        from envs import open_env

        return open_env(self.machine.robot, None, self.machine.options)

    def training(self, env: Any, folder: Path) -> Any:
        """Settings of its trainings; what these imitate is made in ``folder`` where it
        is not there yet."""
        from train._robots import training_config

        shown = self.shown(folder)
        imitated = {} if shown is None else {"demonstrations": shown}
        return training_config(env, self.env_steps, self.machine.algorithm, imitated)

    def shown(self, folder: Path) -> Path | None:
        """The log of what its policies imitate, if they do."""
        from benchmarks.demonstrated import demonstrated

        if self.machine.algorithm is None:
            return None
        return demonstrated(folder, ("trot",), self.env_steps)[0]

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
        words += [*self.settings, *self.options]
        if not self.policy:
            words.append("no policy")
        if self.curves:
            words.append("curves")
        return ", ".join(words)


def identifiers() -> dict[str, Callable[[Cell], Any]]:
    """Methods that find a distribution over parameters."""
    from easi_jax.baselines import (
        Dropo,
        Easi,
        MujocoSysid,
        NeuralPosterior,
        PairedCmaEs,
        RandomSearch,
        SimOpt,
    )
    from train._robots import search_config

    def easi(preset: str, refine: bool) -> Callable[[Cell], Any]:
        return lambda cell: Easi(
            search_config(preset, cell.settings, cell.machine.robot), refine
        )

    return {
        "EASI paper": easi("paper", False),
        "EASI default": easi("default", True),
        WARM[1]: easi("default", True),
        "EASI default, not refined": easi("default", False),
        "SimOpt": lambda _: SimOpt(),
        "CMA-ES": lambda _: PairedCmaEs(),
        "DROPO": lambda _: Dropo(),
        "random search": lambda _: RandomSearch(),
        "mujoco.sysid": lambda _: MujocoSysid(),
        "NPE": lambda _: NeuralPosterior(),
    }


def learners() -> dict[str, Callable[[Cell], Any]]:
    """Methods that end with a policy."""
    from easi_jax.baselines import FineTune, Garat, Oracle

    return {
        "Oracle": lambda _: Oracle(),
        WARM[0]: lambda _: Oracle(warm_start=True),
        "FineTune": lambda cell: FineTune(random_steps=_random(cell.machine.robot)),
        "FineTune, no random actions": lambda _: FineTune(random_steps=0),
        "GARAT": lambda _: Garat(),
    }


# What changed figures of a method since its first rows. A row says how many of these
# its method had (``recipe``); one that lacks some is stale.
_FINISH = (
    "the least-squares finish fits unknown starts, and the initial range counts in its "
    "mean",
)
_DATA = ("rivals get all pieces of the demonstrations",)
_BUDGET = "searches may simulate what EASI does with its finish"
_CHANGES = {
    "EASI paper": (
        "the discriminator sees the robot's observations and a fresh measured batch at "
        "each step, RMSprop's epsilon is outside the root, and demonstrations cross "
        "resets as simulations do",
    ),
    **dict.fromkeys(
        ("one program", "separate programs"),
        ("the final training goes on from the first policy's networks",),
    ),
    "EASI default": _FINISH,
    WARM[1]: _FINISH,
    AFTER_GAP: _FINISH,
    **dict.fromkeys(("CMA-ES", "DROPO", "random search", "mujoco.sysid", "NPE"), _DATA),
}
_BUDGETED = ("CMA-ES", "DROPO", "random search", "mujoco.sysid", "NPE", "SimOpt")


def changes(method: str, robot: str) -> tuple[str, ...]:
    """What changed figures of a method on a robot, in order."""
    more = (_BUDGET,) if method in _BUDGETED and robot in BUDGETS else ()
    return _CHANGES.get(method, ()) + more


def recipe(method: str, robot: str) -> int:
    """How many changes of its figures a method has behind it."""
    return len(changes(method, robot))


def is_stale(row: Mapping[str, Any]) -> bool:
    """Whether a row was made before its method changed."""
    return row.get("recipe", 0) < recipe(row["method"], row["robot"])


METHODS = (
    *("UDR", "Oracle", "FineTune", "FineTune, no random actions", "GARAT"),
    *("EASI paper", "EASI default", *WARM, "EASI default, not refined"),
    *("SimOpt", "CMA-ES", "DROPO", "random search"),
    *("mujoco.sysid", "NPE", AFTER_GAP),
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
        distribution was found, and without a policy ``error``, the ratios' RMS along
        the directions that the demonstrations determine, and ``start_error``, that of
        the middle of where the search starts; what was ``simulated`` and
        ``measured``, ``seconds``; the device that ``udr`` was trained on.
        With ``cell.curves``: ``curve`` (control steps, returns in the target) of the
        last training, ``trace`` (mean, below, above) of each parameter by generation,
        as ratios to the truth.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.io.files import read_json
    from easi_jax.rl.evaluate import evaluate
    from easi_jax.rl.networks import act

    bench = _Bench.open(cell, folder)
    begun = time.monotonic()
    policy = bench.policy
    row: dict[str, Any] = {"simulated": 0, "measured": 0}
    row["udr"] = read_json(bench.run / "versions.json")["runtime"]["device_kind"]
    if cell.method in identifiers():
        policy, found = bench.identified(begun)
        row |= found
    elif cell.method in learners():
        policy, found = bench.learned()
        row |= found
    elif cell.curves:
        row["curve"] = bench.first_curve()
    if cell.policy:
        jax.block_until_ready(policy)
        row["seconds"] = time.monotonic() - begun
        env = bench.env
        returns = jax.jit(
            lambda p, k: evaluate(env, env.model(bench.target), p, act, k)
        )
        resets = jax.random.split(bench.keys["evaluate"], EPISODES)
        values = np.asarray(returns(policy, resets))
        row["return"] = float(jnp.nanmean(values))
        row["lost"] = int(np.isnan(values).sum())
    return row


@dataclasses.dataclass(frozen=True)
class _Bench:
    """What every cell starts from: a policy that does not transfer, and its logs.

    Attributes:
        pipe: stages for the robot, the search starting as the cell says.
        target: parameters of the machine, SI.
        run: folder of the UDR training; ``state`` and ``policy`` are its end.
        demos: trajectories ``(B, T, 1, ...)``.
        keys: one for each stage.
    """

    cell: Cell
    env: Any
    pipe: Any
    training: Any
    target: Any
    run: Path
    state: Any
    policy: Any
    demos: Any
    keys: Any

    @classmethod
    def open(cls, cell: Cell, folder: Path) -> "_Bench":
        """Trains the UDR policy where it is not there yet, and records it."""
        import jax
        import jax.numpy as jnp

        from easi_jax.baselines.policies import quiet
        from easi_jax.pipeline.stages import (
            Pipeline,
            PipelineConfig,
            seed_keys,
            stage_keys,
            target_parameters,
        )
        from train._robots import load_udr

        env = cell.env()
        training = cell.training(env, folder)
        training = training if cell.curves else quiet(training)
        changes = (cell.target,) if cell.target else ()
        target = jnp.asarray(target_parameters(env.space, changes), jnp.float32)
        run = udr_run(cell, folder)
        udr = load_udr(run)
        pipe = Pipeline(
            env,
            PipelineConfig(training=training, trajectories=cell.trajectories),
            start=cell.start,
        )
        keys = stage_keys(seed_keys([cell.seed]))
        demos = jax.jit(pipe.demonstrate)(udr["policies"], target, keys["demonstrate"])
        state, policy, demos, keys = jax.tree.map(
            lambda x: x[0], (udr["states"], udr["policies"], demos, keys)
        )
        return cls(cell, env, pipe, training, target, run, state, policy, demos, keys)

    def identified(self, begun: float) -> tuple[Any, dict[str, Any]]:
        """A policy trained under the distribution that the method finds (UDR's where
        none is asked for), and what was found."""
        import jax
        import numpy as np

        from easi_jax.baselines import Budget, Easi
        from easi_jax.baselines.policies import watched
        from easi_jax.model import distribution

        cell, curve = self.cell, []

        def train(space: Any, dist: Any, key: Any) -> Any:
            learned, returns = watched(
                self.env,
                self.training,
                lambda d, k: distribution.draw(space, d, k),
                dist,
                distribution.point(space, self.target),
                key,
                self.state if cell.method in WARM else None,
            )
            curve.append(returns)
            return learned

        task = self._task(train)
        method = identifiers()[cell.method](cell)
        demos = self.demos
        if isinstance(method, Easi) and method.search.source == "policy":
            since = time.monotonic()
            demos = jax.block_until_ready(self._recorded_as(method.search))
            begun += time.monotonic() - since  # as others' demonstrations, untimed
        budget = Budget(BUDGETS.get(cell.robot, Budget.simulated))
        found = jax.block_until_ready(
            method.fit(task, demos, budget, self.keys["search"])
        )
        truth = np.asarray(self.target, float)
        off = self._off(found.space.to_si(found.distribution.mean))
        spread = np.sqrt(np.diag(distribution.covariance(found.distribution)))
        row = {
            "identify_s": time.monotonic() - begun,
            "simulated": found.simulated,
            "measured": found.measured,
            "unreached": list(found.unreached),
            "parameters": list(found.space.names),
            "log_ratio": off.tolist(),
            "std": spread.tolist(),
        }
        if isinstance(method, Easi):
            row["discriminator_updates"] = method.search.discriminator_updates
        if cell.curves and found.trace is not None:
            row["trace"] = _trace(found, truth)
        if not cell.policy:
            known = self._determined()
            begun = self._off(found.space.to_si(np.full(found.space.size, 0.5)))
            row |= {"error": known.error(off), "start_error": known.error(begun)}
            return self.policy, row
        learned = train(found.space, found.distribution, self.keys["final"])
        if cell.curves:
            row["curve"] = self._curve(curve[-1])
        return learned, row

    def _recorded_as(self, search: Any) -> Any:
        """The demonstrations as a search whose simulations run the controller has
        them."""
        import jax

        from easi_jax.pipeline.stages import Pipeline

        config = dataclasses.replace(self.pipe.config, search=search)
        pipe = Pipeline(self.env, config, start=self.cell.start)
        policy, key = jax.tree.map(
            lambda x: x[None], (self.policy, self.keys["demonstrate"])
        )
        demos = jax.jit(pipe.demonstrate)(policy, self.target, key)
        return jax.tree.map(lambda x: x[0], demos)

    def learned(self) -> tuple[Any, dict[str, Any]]:
        """The policy of a method that ends with one."""
        import jax.numpy as jnp

        from easi_jax.baselines import Budget, Practice
        from easi_jax.baselines.policies import watched

        cell, env = self.cell, self.env
        ideal = cell.method in ("Oracle", WARM[0])
        key = self.keys["oracle" if ideal else "final"]
        if cell.method == "Oracle" and cell.curves:
            # The same training, watched.
            policy, returns = watched(
                env, self.training, lambda x, _: x, self.target, self.target, key
            )
            measured = self.training.env_steps
            return policy, {"measured": measured, "curve": self._curve(returns)}
        nominal = jnp.asarray(env.space.nominal, jnp.float32)
        practice = Practice(
            env, nominal, env, self.target, self.training, self.state, self.policy
        )
        method = learners()[cell.method](cell)
        got = method.fit(practice, self.demos, Budget(), key)
        return got.policy, {"simulated": got.simulated, "measured": got.measured}

    def first_curve(self) -> list[list[float]]:
        """Returns of the UDR training on its way, in the nominal robot."""
        from train._stages import training_curve

        steps, returns = training_curve(self.run, "train", [self.cell.seed])
        return [list(steps), [round(r[0], 2) for r in returns]]

    def _curve(self, returns: Any) -> list[list[float]]:
        import numpy as np

        seen = np.flatnonzero(np.isfinite(returns))
        steps = (seen + 1) * self.training.steps_per_iteration
        return [steps.tolist(), np.asarray(returns)[seen].round(2).tolist()]

    def _task(self, train: Any) -> Any:
        import jax
        import jax.numpy as jnp

        from easi_jax.baselines import Task
        from easi_jax.rl.networks import act
        from easi_jax.simulation.rollout import policy_rollout

        env = self.env

        def record(policy: Any, resets: Any) -> Any:
            def one(key: Any) -> Any:
                return policy_rollout(
                    env,
                    env.model(self.target),
                    lambda obs, k: act(policy, obs, k, True),
                    key,
                    env.episode_length,
                )

            return jax.jit(jax.vmap(one))(resets)

        return Task(
            simulator=self.pipe.simulator,
            noise=jnp.zeros(2 * env.mj_model.nv),
            env=env,
            act=lambda policy, obs, key: act(policy, obs, key),
            act_best=lambda policy, obs, key: act(policy, obs, key, True),
            policy=self.policy,
            record=record,
            train=train,
        )

    def _off(self, si: Any) -> Any:
        """Log ratios to the truth, or shares of the range for linear parameters;
        nothing is less than a thousandth of the truth."""
        import numpy as np

        space = self.env.space
        least = np.where(space.log, 1e-3 * self.target, -np.inf)
        unit = space.to_unit(np.maximum(si, least))
        return np.asarray(unit - space.to_unit(self.target), float) * space.log_width

    def _determined(self) -> Any:
        """What the demonstrations can say, at the truth."""
        import jax
        import jax.numpy as jnp
        import numpy as np

        from easi_jax.estimation.identifiability import identifiability
        from easi_jax.estimation.normal_equations import PairedFit
        from easi_jax.estimation.pieces import effective_noise

        simulator, space = self.env.simulator, self.env.space

        @jax.jit
        def hessian(demos: Any) -> Any:
            pieces = self.pipe.pieces(demos)
            zero = jnp.zeros(2 * self.env.mj_model.nv)
            noise = effective_noise(simulator, pieces, zero)
            fit = PairedFit(simulator, space, pieces, noise, free_starts=False)
            return fit.information(space.to_unit(self.target))

        return identifiability(space, np.asarray(hessian(self.demos)))


def _trace(found: Any, truth: Any) -> list[list[list[float]]]:
    """Mean, and one standard deviation below and above, over the truth,
    ``(3, G, n)``."""
    import numpy as np

    mean, std = found.trace
    sides = [np.asarray(found.space.to_si(mean + k * std)) for k in (0.0, -1.0, 1.0)]
    return (np.stack(sides) / truth).round(4).tolist()


def udr_run(cell: Cell, folder: Path) -> Path:
    """The run folder of a cell's UDR training, trained where it is not there yet.

    Raises:
        UserError: nothing can be written there.
    """
    from train import udr

    steps = "" if cell.env_steps is None else f"_{cell.env_steps}"
    words = "_".join(["udr", cell.robot, *cell.options]) + steps
    out = folder / f"{words}_{cell.seed}"
    # Another process may be at it: its result will do.
    with _opened(folder / f"{out.name}.lock") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if (out / "results.json").exists():
            return out
        udr.run(
            udr.Config(
                robot=cell.machine.robot,
                option=cell.machine.options,
                algorithm=cell.machine.algorithm,
                demonstrations=cell.shown(folder),
                out=out,
                seeds=(cell.seed,),
                env_steps=cell.env_steps,
                resume=True,
            )
        )
    return out


def _opened(path: Path) -> Any:
    """A file to lock."""
    from easi_jax.errors import UserError
    from easi_jax.io.files import os_reason

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("w")
    except OSError as error:
        raise UserError(
            f"cannot write {path}: {os_reason(error)}; name another --folder"
        ) from error

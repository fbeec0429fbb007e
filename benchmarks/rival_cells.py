"""Cells of the rivals' comparison: one robot, setting, method and seed each."""

import dataclasses
import time
from typing import Any

AFTER_GAP = "EASI after train.gap"
METHODS = (
    *("EASI", "CMA-ES", "DROPO", "SimOpt"),
    *("random search", "mujoco.sysid", "NPE"),
    AFTER_GAP,
)
ROBOTS = ("cartpole", "arm6", "go2")
SETTINGS = ("clean", "paired", "unpaired", "stochastic", "effect")

_SPREAD = 1.5  # factor, at most, between a truth and the nominal values
_LATE = 0.03  # s that commands are late where the target has an effect
# Control steps that may be simulated: what EASI takes at most, its finish included.
BUDGETS = {"cartpole": 40_000_000, "arm6": 40_000_000, "go2": 6_000_000}
_PIECE = 25  # control steps of a piece
_REGION = 0.9


@dataclasses.dataclass(frozen=True)
class Cell:
    """What is run once.

    Attributes:
        robot, setting, method: names in `ROBOTS`, `SETTINGS`, `METHODS`.
        seed: of the truth, the recording and the method.
        trajectories: recorded, of 200 control steps.
        budget: control steps that may be simulated.
    """

    robot: str
    setting: str
    method: str
    seed: int
    trajectories: int
    budget: int

    @property
    def key(self) -> str:
        """One line that says it all, for files."""
        return (
            f"{self.method}, {self.robot}, {self.setting}, seed {self.seed}, "
            f"{self.trajectories} trajectories, {self.budget} steps"
        )

    @property
    def possible(self) -> bool:
        """SimOpt needs an environment and the controller, train.gap a reason."""
        if self.method == AFTER_GAP:
            return self.setting == "effect"
        return self.method != "SimOpt" or (
            self.robot == "cartpole" and self.setting != "unpaired"
        )


def method_of(cell: Cell, xml: str) -> Any:
    """The method; where only single transitions are known, with pieces of one step."""
    from benchmarks.gap_first import GapFirst
    from easi_jax.baselines import (
        Dropo,
        Easi,
        MujocoSysid,
        NeuralPosterior,
        PairedCmaEs,
        RandomSearch,
        SimOpt,
    )

    steps = 1 if cell.setting == "unpaired" else _PIECE
    known = {
        "EASI": lambda: Easi(refine=True),
        "CMA-ES": lambda: PairedCmaEs(horizon=steps),
        "DROPO": lambda: Dropo(),
        "SimOpt": lambda: SimOpt(),
        "random search": lambda: RandomSearch(horizon=steps),
        "mujoco.sysid": lambda: MujocoSysid(horizon=steps),
        "NPE": lambda: NeuralPosterior(horizon=steps),
        AFTER_GAP: lambda: GapFirst(xml),
    }
    return known[cell.method]()


def solve(cell: Cell) -> dict[str, Any]:
    """Runs a cell.

    Returns:
        ``error``: RMS of the log ratio to the truth along the ``rank`` directions that
        the data determine (`easi_jax.estimation.normal_equations`), None without any;
        ``bound``: that of Cramer and Rao; ``start_error``: that of the middle of where
        searches start;
        ``covered``: whether the truth is in the found 90 % region of these directions;
        ``log_ratio`` and unit-coordinate ``std`` of each parameter; ``seconds``;
        control steps ``simulated`` and, of the real machine beyond the recording,
        ``measured``; what train.gap has ``named``, where it came first.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.rigs import RIGS
    from easi_jax.baselines import Budget
    from easi_jax.model.distribution import covariance

    rig = RIGS[cell.robot]()
    if cell.setting == "clean":
        rig = dataclasses.replace(rig, noise=np.zeros_like(rig.noise))
    space = rig.simulator.space
    k_truth, k_record, k_noise, k_order, k_fit = jax.random.split(
        jax.random.key(cell.seed), 5
    )
    away = jax.random.uniform(k_truth, (space.size,), minval=-1.0, maxval=1.0)
    theta = jnp.asarray(space.nominal, jnp.float32) * _SPREAD**away
    real = rig.late(_LATE) if cell.setting == "effect" else rig.simulator
    explore = 1.0 if cell.setting in ("stochastic", "effect") else 0.0
    task = rig.task(real, theta, explore)
    demos = recorded(
        rig, cell, real, theta, explore, task.noise, (k_record, k_noise, k_order)
    )
    information = fisher(task, demos, space.to_unit(theta))
    begun = time.monotonic()
    method = method_of(cell, rig.xml)
    found = method.fit(task, demos, Budget(cell.budget), k_fit)
    found = jax.block_until_ready(found)
    seconds = time.monotonic() - begun
    mean, cov = np.asarray(found.distribution.mean), covariance(found.distribution)
    truth = np.asarray(found.space.to_unit(theta))
    start = score(space, information, np.full(space.size, 0.5), cov, truth)
    return {
        **score(found.space, information, mean, cov, truth),
        "start_error": start["error"],
        "log_ratio": ((mean - truth) * found.space.log_width).tolist(),
        "std": np.sqrt(np.diag(cov)).tolist(),
        "parameters": list(space.names),
        "seconds": seconds,
        "simulated": found.simulated,
        "measured": found.measured,
        "unreached": list(found.unreached),
        **({"named": list(method.told)} if cell.method == AFTER_GAP else {}),
    }


def recorded(
    rig: Any,
    cell: Cell,
    real: Any,
    theta: Any,
    explore: float,
    noise: Any,
    keys: Any,
) -> Any:
    """What the sensors recorded, ``(B, T, 1, ...)``.

    ``unpaired``: single transitions in any order, ``(B T, 1, 1, ...)``. A state, the
    command and the next state still belong together; what came before and after, and
    which controller it was, is not known.
    """
    import jax

    from easi_jax.simulation.rollout import measured

    def record(theta: Any, k_record: Any, k_noise: Any) -> Any:
        clean = rig.record(real, theta, k_record, cell.trajectories, explore)
        return measured(clean, noise, k_noise, real.configuration)

    demos = jax.jit(record)(theta, *keys[:2])
    if cell.setting != "unpaired":
        return demos
    count = demos.weight.size
    order = jax.random.permutation(keys[2], count)
    return jax.tree.map(lambda x: x.reshape(count, 1, *x.shape[2:])[order], demos)


def fisher(task: Any, demos: Any, truth: Any) -> Any:
    """Information of the recording at the true parameters, ``(n, n)``, as the model
    without any effect has it."""
    import jax
    import numpy as np

    from easi_jax.data.segments import windows
    from easi_jax.estimation.normal_equations import PairedFit
    from easi_jax.estimation.pieces import effective_noise

    steps = min(_PIECE, demos.weight.shape[1])
    pieces = windows(demos, steps, steps)

    def information(truth: Any, pieces: Any) -> Any:
        noise = effective_noise(task.simulator, pieces, task.noise)
        fit = PairedFit(task.simulator, task.space, pieces, noise, task.mesh)
        return fit.information(truth)

    return np.asarray(jax.jit(information)(truth, pieces))


def score(
    space: Any, information: Any, mean: Any, cov: Any, truth: Any
) -> dict[str, Any]:
    """``error``, ``bound``, ``covered`` and ``rank``, along what the data determine.

    Args:
        mean, cov, truth: unit coordinates, ``(n,)``, ``(n, n)``, ``(n,)``.
    """
    import numpy as np
    from scipy.stats import chi2

    from easi_jax.estimation.identifiability import identifiability

    known = identifiability(space, information)
    if not known.rank:
        return {"error": None, "bound": None, "covered": None, "rank": 0}
    hidden = known.null.shape[1]
    # The rest of an orthonormal basis that begins with what is undetermined.
    whole = np.linalg.qr(np.hstack([known.null, np.eye(space.size)]))[0]
    seen = whole[:, hidden:].T * known.scale
    off = seen @ (np.asarray(mean, float) - truth)
    values, vectors = np.linalg.eigh(seen @ np.asarray(cov, float) @ seen.T)
    far = (vectors.T @ off) ** 2 / np.maximum(values, 1e-14)
    least = np.trace(seen @ known.covariance @ seen.T)
    return {
        "error": float(np.sqrt(np.mean(off**2))),
        "bound": float(np.sqrt(least / known.rank)),
        "covered": bool(far.sum() <= chi2.ppf(_REGION, known.rank)),
        "rank": known.rank,
    }

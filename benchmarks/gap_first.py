"""What an owner does whose model may lack something: ``train.gap``, then EASI."""

import subprocess
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._common import ROOT
from easi_jax.baselines import Budget, Easi, Identified, Task
from easi_jax.data.recording import Run
from easi_jax.data.segments import Segments
from easi_jax.io.logs.reader import write_log
from easi_jax.io.models.effects_file import parsed_effects
from easi_jax.io.models.parameter_file import write_parameter_file
from easi_jax.io.strict_yaml import read_yaml
from easi_jax.model.distribution import covariance, gaussian
from easi_jax.model.found_effects import FoundEffects
from easi_jax.model.joint_space import Configuration
from easi_jax.model.parameters import ParameterSpace
from easi_jax.simulation.simulator import Simulator
from easi_jax.simulation.with_effects import simulator_with


@dataclass(frozen=True)
class GapFirst:
    """``train.gap`` names what the model lacks, and EASI searches with it.

    The command itself, on the recording as logs, with the parameters that are searched
    as those it may refit.
    """

    xml: str
    """The model, MJCF."""
    time_limit: float = 14400.0
    """Of train.gap [s]."""
    told: list[str] = field(default_factory=list, compare=False)
    """What it named last, with the fitted numbers."""

    def fit(
        self, task: Task, demonstrations: Segments, budget: Budget, key: jax.Array
    ) -> Identified:
        """EASI's result, in the coordinates of the task's own parameters."""
        effects = self.named(task, demonstrations)
        self.told[:] = [
            f"{e.effect}@{e.at}: {k} {v:.3g}"
            for e in effects.entries
            for k, v in e.columns.items()
        ]
        simulator = simulator_with(task.simulator, effects)
        found = Easi(refine=True).fit(
            replace(task, simulator=simulator), demonstrations, budget, key
        )
        return own(found, task.space)

    def named(self, task: Task, demonstrations: Segments) -> FoundEffects:
        """What ``train.gap`` found."""
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            model, log = place / "model.xml", place / "log.csv"
            parameters, out = place / "parameters.yaml", place / "gap"
            model.write_text(self.xml)
            write_parameter_file(parameters, task.space)
            rows = runs(task.simulator, demonstrations)
            write_log(log, task.simulator.mj_model, rows)
            words = ["--model", model, "--data", log, "--parameters", parameters]
            done = subprocess.run(
                [sys.executable, "-m", "train.gap", *map(str, words), "--out", out],
                cwd=ROOT,
                timeout=self.time_limit,
                capture_output=True,
                text=True,
            )
            if done.returncode:
                last = done.stderr.strip().splitlines()[-1:] or ["no message"]
                raise RuntimeError(f"train.gap failed: {last[0]}")
            found = out / "effects.yaml"
            return parsed_effects(read_yaml(found), str(found))


def runs(machine: Simulator, demonstrations: Segments) -> list[Run]:
    """Trajectories ``(B, T, 1, ...)`` as runs of a log."""
    d = jax.tree.map(lambda x: np.asarray(x, float), demonstrations)
    shape = Configuration.of(machine.mj_model)
    found = []
    for i in range(d.weight.shape[0]):
        steps = int(d.weight[i].sum())
        last = slice(steps - 1, steps)
        ctrl = d.ctrl[i, :steps, 0]
        found.append(
            Run(
                name=f"{i:03d}",
                source="recording",
                dt=machine.dt,
                time=machine.dt * np.arange(steps + 1),
                qpos=np.concatenate([d.qpos[i, :steps], d.next_qpos[i, last, 0]]),
                qvel=np.concatenate([d.qvel[i, :steps], d.next_qvel[i, last, 0]]),
                qvel_measured=True,
                ctrl=np.concatenate([ctrl, ctrl[-1:]]),  # of the last row: held
                configuration=shape,
            )
        )
    return found


def own(found: Identified, space: ParameterSpace) -> Identified:
    """The part of a result that is about the parameters of ``space``, which come first
    in its own, in the unit coordinates of ``space``."""
    mean = jnp.asarray(found.distribution.mean)

    def unit(u: jax.Array) -> jax.Array:
        return space.to_unit(found.space.to_si(u)[: space.size])

    slope = np.asarray(jax.jacfwd(unit)(mean))
    cov = slope @ covariance(found.distribution) @ slope.T
    return Identified(
        gaussian(space, unit(mean), cov), space, found.simulated, found.measured
    )

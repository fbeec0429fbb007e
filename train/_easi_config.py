"""Options of ``train.easi``."""

import dataclasses
from pathlib import Path

from train._options import (
    BaseOptions,
    ChainOptions,
    EngineOptions,
    RunOptions,
    SearchOptions,
    TargetOptions,
)


@dataclasses.dataclass(frozen=True)
class _Sources:
    """Where the motion comes from."""

    udr: Path = Path("results/udr")
    """Run folder of train.udr: its policy records the demonstrations."""
    env: Path | None = None
    """The Python file of your own environment, where train.udr was run with one."""
    out: Path = Path("results/easi")
    """Folder of the run."""
    data: tuple[Path, ...] = ()
    """Measured logs (CSV, NPZ or Parquet) in place of a pseudo-real target."""
    held_out: tuple[Path, ...] = ()
    """Logs kept out of the search, to test the result on; not given: whole runs with a
    quarter of the rows, of a single run 30 % in three blocks."""
    model: Path | None = None
    """MuJoCo model (MJCF) of the machine that the logs are of."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
    parameters: Path | None = None
    """Parameter file (YAML): what may vary in the model, and in which range."""
    mapping: Path | None = None
    """Mapping file (YAML) for logs with foreign column names."""
    robot: str | None = None
    """Built-in robot that the logs are of, in place of --model and --parameters."""
    policy: str | None = None
    """What controlled the robot that the logs are of, where nobody measured where its
    base was: a run folder with policies, a policy.onnx of train.export, or commands (it
    is sent what the log was sent, from --model or --robot). It is simulated under its
    controller, and short pieces of what it measures are compared (docs/method.md)."""
    policy_seed: int | None = None
    """Seed of the run folder's policy; its first where not given."""
    observed: tuple[str, ...] = ()
    """What the policy was asked for while the logs were recorded, NAME=NUMBER for
    entries of its observation: command.forward=1.4 command.sideways=0 command.turn=0
    for go2."""
    stand: tuple[Path, ...] = ()
    """With --policy: logs of the same robot's joints in a stand, its base held. What
    they say of the parameters is known when the walk is fitted."""
    sampled: bool = False
    """The policy drew its actions at random; not given: it acted by its mode."""


@dataclasses.dataclass(frozen=True)
class Config(
    RunOptions,
    EngineOptions,
    ChainOptions,
    SearchOptions,
    TargetOptions,
    BaseOptions,
    _Sources,
):
    """Finds the distribution of physical parameters under which simulation looks like
    the measured motion (EASI), and trains the final policy under it.

    With a built-in robot, the policy of ``train.udr`` records demonstrations in a
    pseudo-real target, the search never sees the target's parameters, and the final
    policy is tested there against the first (and, with --oracle, against a policy
    trained in the target itself). With --data, logs of a real machine take the
    target's place: give --model and --parameters for a machine of your own. No policy
    is trained then: train.udr --found does that under the result.
    """

    effects: Path | None = None
    """Effects that the model lacks (effects.yaml of train.gap): the model gets them,
    and their parameters are searched with the others; not given: those of the UDR run.
    """
    horizon: float | None = None
    """Length of a compared piece [s]; not given: one control step for clean
    demonstrations, 0.16 s for noisy ones, for logs as short as their noise allows. Of
    logs the held-out error is reported over it, too (0.2 s where not given)."""
    oracle: bool = False
    """Train the Oracle too: a policy trained in the target itself."""
    seeds: tuple[int, ...] = ()
    """Seeds; not given: those of the UDR run (0 for logs)."""
    chunk: int | None = None
    """Training iterations between checkpoints; about 50,000 control steps where not
    given."""
    search_chunk: int = 10
    """Generations between checkpoints."""

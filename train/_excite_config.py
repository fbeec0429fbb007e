"""Options of ``train.excite``."""

import dataclasses
from pathlib import Path
from typing import Literal

from train._options import BaseOptions, EngineOptions, OwnEffectsOptions


@dataclasses.dataclass(frozen=True)
class Config(EngineOptions, OwnEffectsOptions, BaseOptions):
    """Writes commands to play on the machine, so that its log says the most.

    Multisines, chirps, pulses and steps of several sizes are simulated in the model,
    and in the model with mass and friction 20 % wrong either way, and scaled down
    until every joint (play aside) stays inside its range less a margin, every command
    inside its ctrlrange and every force inside its forcerange. Each test is then judged
    by how far apart its data would set the effects that train.gap knows, in units of
    sensor noise, with the model's own parameters refitted. The best is written to
    commands.csv, with the positions that the model predicts: look at them before you
    play it. excite.json holds the limits, what was tried and what to expect.

    What is assumed: that the machine starts at rest in the pose of the first row, that
    nothing stands in its way (only joints are checked, not collisions), and that it
    is no farther from the model than the 20 %. Stay at the emergency stop.

    Motors that cannot hold the machine still by constant commands (an arm against
    gravity) get a test to be added to your own controller: its columns are then
    called feedforward.ACTUATOR, not ctrl.ACTUATOR. Log what is sent in all.
    """

    model: str = ""
    """Required: MuJoCo model (MJCF), or the name of a built-in robot."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
    out: Path = Path("results/excite")
    """Folder for commands.csv and excite.json; or a file NAME.csv, with NAME.json
    beside it."""
    duration: float = 20.0
    """Length [s], 1 s of rest at either end included."""
    rate: float | None = None
    """Rows per second; not given: that of --data, of the built-in robot, or 100."""
    gap: Path | None = None
    """Results of train.gap for this model: only what those data could not tell apart
    counts."""
    only: tuple[str, ...] = ()
    """Only these effects count, such as coulomb_friction; not given: all."""
    effects: Path | None = None
    """Effects that the machine has and the model lacks (effects.yaml of train.gap):
    commands are tried with them; those that MJCF has no word for are named and left
    out."""
    data: tuple[Path, ...] = ()
    """Earlier logs; sensor noise, control rate and the size of effects come from
    them."""
    noise: tuple[str, ...] = ()
    """Sensor noise [rad, m], as 0.001 for all joints or JOINT=0.001; not given: that
    of --data, or 0.001."""
    horizon: float = 0.2
    """Length of the predictions that train.gap will make [s]."""
    margin: float = 0.05
    """Share of a joint's range that is left free at both ends."""
    travel: tuple[str, ...] = ()
    """How far a driven joint without a range may go from its start [rad, m], as 1.5
    or JOINT=1.5; not given: 3.14 rad, 0.5 m."""
    max_speed: tuple[str, ...] = ()
    """Largest speed [rad/s, m/s], as 2 for all joints or JOINT=2; not given: none."""
    amplitude: tuple[str, ...] = ()
    """Largest change of a command, in its own units, as 0.5 or ACTUATOR=0.5; not
    given: what the limits leave."""
    play: Literal["auto", "open-loop", "feed-forward"] = "auto"
    """Whether the commands are all that is sent, or are added to your controller's;
    auto: the first where the model then stays put."""
    parameters: Path | None = None
    """What train.gap may refit in the model; not given: as there."""
    mapping: Path | None = None
    """Mapping file (YAML) for --data with foreign column names."""
    seed: int = 0
    """Of the random parts; the same seed gives the same commands."""
    overwrite: bool = False
    """Replace earlier results in --out."""

"""``python -m train.parameters``: a first parameter file for a model."""

import dataclasses
from pathlib import Path
from typing import Any

from train._command import main, say, show_table
from train._options import BaseOptions, EngineOptions

_HORIZON = 0.2  # s, of the pieces that say what logs determine


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(EngineOptions, BaseOptions):
    """Proposes what may vary in a model: a parameter file for train.easi to start from.

    Damping, friction and inertia of joints, gains and limits of drives, masses, ground
    friction. Places that look alike are tied to one parameter by a pattern of names
    (legs, sides; never joints of one chain): --no-tie leaves them apart. With --data it
    also says what these logs can determine. Read the file, take out what you have
    measured, and correct the ranges you know better.
    """

    model: Path
    """MuJoCo model (MJCF) of the machine."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
    out: Path = Path("parameters.yaml")
    """Parameter file to write."""
    data: tuple[Path, ...] = ()
    """Measured logs (CSV, NPZ or Parquet)."""
    mapping: Path | None = None
    """Mapping file (YAML) for logs with foreign column names."""
    tie: bool = True
    """One parameter for places that look alike."""
    overwrite: bool = False
    """Replace the file if it is there."""


def run(config: Config) -> None:
    """Writes the file and shows what is in it."""
    from easi_jax.errors import UserError
    from easi_jax.io.files import atomic_write
    from easi_jax.io.report.numbers import shown_unit
    from easi_jax.model.parameter_proposal import as_text, propose
    from train._log_problem import held_of, load_model

    if config.out.exists() and not config.overwrite:
        raise UserError(
            f"{config.out} is there already: name another file with --out, or replace "
            "it with --overwrite"
        )
    m = load_model(
        config.model, config.allow_assets, held_of(config), bool(config.data)
    )
    proposals = propose(m, config.tie)
    verdicts: dict[str, str] = {}
    notes: list[str] = []
    head = [f"Proposed by python -m train.parameters for {config.model.name}."]
    if config.data:
        verdicts, notes = _verdicts(proposals, _information(config, m, proposals))
        names = ", ".join(p.name for p in config.data)
        head.append(f"What {names} can determine at best is said beside each name.")
    if any(p.tied for p in proposals):
        head.append(
            "Addresses with * tie the places that are named below them: write an"
        )
        head.append("entry for each place, or run again with --no-tie, to part them.")
    atomic_write(config.out, as_text(proposals, head, verdicts))
    rows = [
        (
            p.parameter.name,
            p.parameter.addresses[0],
            f"{p.parameter.nominal:.4g}",
            f"{p.parameter.initial[0]:.3g} .. {p.parameter.initial[1]:.3g}",
            shown_unit(p.parameter.unit),
            *([verdicts[p.parameter.name]] if verdicts else []),
        )
        for p in proposals
    ]
    columns = ["name", "address", "nominal", "start", "unit"]
    if verdicts:
        columns.append("these logs")
    show_table(f"What may vary in {config.model.name}", columns, rows)
    for note in notes:
        say(f"note: {note}")
    say(f"written: {config.out}")


def _verdicts(
    proposals: list[Any], information: Any
) -> tuple[dict[str, str], list[str]]:
    """What the logs can determine of each parameter, and what people should know.

    Motion alone never shows the common scale of masses and forces. So the heaviest
    mass counts as weighed, and the verdict is on the others.
    """
    import numpy as np

    from easi_jax.estimation.identifiability import describe, identifiability
    from easi_jax.model.parameter_proposal import space_of

    space = space_of(proposals)
    notes, keep = [], list(range(space.size))
    masses = [i for i in keep if space.addresses[i][0].endswith(".mass")]
    scale_open = any(
        len(d) > 1 and max(abs(v - 1) for v in d.values()) < 0.05
        for d in identifiability(space, information).undetermined
    )
    verdicts = {}
    if scale_open and masses:
        heaviest = max(masses, key=lambda i: space.nominal[i])
        name = space.names[heaviest]
        keep.remove(heaviest)
        verdicts[name] = "weigh it"
        notes.append(
            "all masses and forces times one common factor change nothing in motion: "
            f"weigh {name} and take it out of the file; the rest is judged as if it "
            "were known"
        )
    found = identifiability(
        space.select([space.names[i] for i in keep]), information[np.ix_(keep, keep)]
    )
    for name, sure, std in zip(found.names, found.determined, found.std, strict=True):
        verdicts[name] = f"known to {100 * std:.2g} %" if sure else "not determined"
    notes += [describe(d) for d in found.undetermined]
    return verdicts, notes


def _information(config: Config, m: Any, proposals: list[Any]) -> Any:
    """Fisher information of the logs, near the middle of the proposed ranges."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.data.cleaning import to_common_step
    from easi_jax.data.noise import pooled_noise
    from easi_jax.data.segments import to_device
    from easi_jax.data.sensor_channels import moving_sensors
    from easi_jax.estimation.from_runs import spread_of_starts
    from easi_jax.estimation.normal_equations import PairedFit
    from easi_jax.estimation.pieces import effective_noise, segments_from_runs
    from easi_jax.io.logs.reader import read_logs
    from easi_jax.model.parameter_proposal import space_of
    from easi_jax.simulation.logged import Logged
    from easi_jax.simulation.simulator import Simulator

    log = read_logs(list(config.data), m, config.mapping, config.unmeasured)
    noise = pooled_noise(log.runs)
    runs, notes = to_common_step(log.runs)
    for note in (*log.notes, *notes):
        say(f"note: {note}")
    space = space_of(proposals)
    simulator = Simulator(m, space, runs[0].dt, logged=Logged.of(runs))
    sensors, sensed = moving_sensors(m, runs, simulator.engine)
    for note in (*simulator.notes, *sensed):
        say(f"note: {note}")
    if sensors:
        simulator = simulator.sensing(sensors)
    noise = np.concatenate([noise, sensors.noise(runs)[0]])
    steps = max(1, round(_HORIZON / simulator.dt))
    given = simulator, runs, steps, steps
    pieces = to_device(segments_from_runs(*given, sensors=sensors))
    noise = effective_noise(simulator, pieces, jnp.asarray(noise, jnp.float32))
    start = spread_of_starts(m, runs, noise[: 2 * m.nv], np.ones(m.nv, bool))
    unit = space.to_unit(jnp.asarray(space.nominal))
    unit = jnp.where(jnp.isfinite(unit), unit, 0.5)
    say("Fisher information of the logs ...")

    @jax.jit
    def information(unit: Any) -> Any:
        paired = PairedFit(simulator, space, pieces, noise, start=start)
        return paired.information(unit)

    return np.asarray(information(unit))


if __name__ == "__main__":
    main(Config, run, name="train.parameters")

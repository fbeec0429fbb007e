"""The real cart-pole, identified parameters alone: open-loop error before and after.

    python -m benchmarks.real_cartpole --data ../shared/data/quanser_cartpole

Fits on ``chirp_plus_*`` by ``train.easi --data`` and reports on ``chirp_minus_*`` and
on the swing-ups, which nothing is ever fitted to: RMS over all steps of all 0.5 s
windows, one every 0.25 s, from the measured position and fitted velocity.

The slider's first reading of every recording is off by 1 to 47 mm from where the rows
after it lead (``first_row_jump`` in the result), and the velocity fitted to it with it.
The measure takes that window in; a second one, ``without_first_row``, starts at the
second row of each recording and is the same otherwise.

``fitted_to_itself`` is what these parameters can reach at best on ``chirp_minus``: they
are fitted to it by the very measure. It is no result, but the end of the scale.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

from train._command import main, say, show_table

HORIZON, EVERY = 0.5, 0.25  # s
GOALS = {"slider": 7.5e-3, "pole": 0.033}  # m, rad, on chirp_minus
SETS = {
    "chirp_plus": "chirp_plus_*.csv",
    "chirp_minus": "chirp_minus_*.csv",
    "swingup": "swingup_0?.csv",
}
HERE = Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Config:
    """Identifies the real cart-pole and measures its prediction error."""

    data: Path = Path("../shared/data/quanser_cartpole")
    """Folder of the recordings and their model.xml."""
    out: Path = Path("results/real_cartpole")
    """Run folder of the identification."""
    results: Path = HERE / "results"
    """Folder that the figures go to."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the search."""
    generations: int = 30
    """Generations of the search."""
    resume: bool = False
    """Go on with the run in --out."""
    overwrite: bool = False
    """Delete the run in --out first."""


def run(config: Config) -> None:
    """Identifies, evaluates, writes the JSON."""
    from easi_jax.errors import UserError

    files = {name: sorted(config.data.glob(p)) for name, p in SETS.items()}
    model = config.data / "model.xml"
    if not model.is_file() or not all(files.values()):
        raise UserError(f"{config.data} does not hold the recordings; give --data")
    import time

    from benchmarks._common import write_result
    from easi_jax.io.files import read_json
    from easi_jax.io.models.parameter_file import read_parameter_file
    from train import _from_logs, easi
    from train._log_problem import load_model

    start = time.monotonic()
    _from_logs.run(
        easi.Config(
            model=model,
            parameters=HERE / "quanser_cartpole.yaml",
            data=tuple(files["chirp_plus"]),
            held_out=tuple(files["chirp_minus"]),
            horizon=HORIZON,
            generations=config.generations,
            seeds=config.seeds,
            out=config.out,
            resume=config.resume,
            overwrite=config.overwrite,
        )
    )
    seconds = time.monotonic() - start
    found = read_json(config.out / "distribution.json")
    mj_model = load_model(model)
    space = read_parameter_file(HERE / "quanser_cartpole.yaml", mj_model)
    errors = evaluate(mj_model, space, files, found["seeds"])
    shown, verdicts = [], {}
    for measure, sets in errors["measures"].items():
        for name, row in sets.items():
            median = row["identified_median"]
            shown += [
                (measure, name, joint, f"{row['nominal'][joint]:.4f}", f"{x:.4f}")
                for joint, x in median.items()
            ]
        verdicts[measure] = judge(sets)
    best = found["seeds"][str(found["best_seed"])]
    path = write_result(
        "real_cartpole",
        "python -m benchmarks.real_cartpole --data DATA",
        {"seeds": config.seeds, "generations": config.generations},
        config.results,
        measure="RMS over all steps of all 0.5 s windows, every 0.25 s",
        parameters={
            p["name"]: {
                "nominal": p["nominal"],
                "mean": best["mean"][i],
                "std": best["std"][i],
                "unit": p["unit"],
                "flag": best["flags"][i],
            }
            for i, p in enumerate(found["parameters"])
        },
        best_seed=found["best_seed"],
        undetermined=[d["meaning"] for d in best["undetermined"]],
        goals={"chirp_minus": GOALS, "swingup": "below the nominal model's"},
        verdicts=verdicts,
        **errors,
        seconds=round(seconds, 1),
    )
    title = "Open-loop error over 0.5 s (m, rad), median over seeds"
    show_table(
        title, ("measure", "recordings", "joint", "nominal", "identified"), shown
    )
    for measure, verdict in verdicts.items():
        say(f"{measure}: {verdict}")
    say(f"written: {path}")


def evaluate(
    mj_model: Any, space: Any, files: dict[str, list[Path]], seeds: dict[str, Any]
) -> dict[str, Any]:
    """Errors of the nominal and each seed's model, per measure, set and joint."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.data.cleaning import rows_of
    from easi_jax.data.segments import to_device
    from easi_jax.estimation.pieces import segments_from_runs
    from easi_jax.io.logs.reader import read_logs
    from easi_jax.simulation import open_loop
    from easi_jax.simulation.simulator import Simulator

    def position_errors(simulator: Simulator, model: Any, pieces: Any) -> Any:
        error = open_loop.errors(simulator, model, pieces)[..., : mj_model.nv]
        return jnp.sqrt(jnp.mean(error**2, axis=(0, 1)))

    logs = {name: read_logs(paths, mj_model).runs for name, paths in files.items()}
    simulator = Simulator(mj_model, space, logs["chirp_plus"][0].dt)
    steps, every = round(HORIZON / simulator.dt), round(EVERY / simulator.dt)
    error = jax.jit(
        jax.vmap(
            lambda theta, s: position_errors(simulator, simulator.model(theta), s),
            (0, None),
        )
    )
    means = [s["mean"] for s in seeds.values()]
    theta = jnp.asarray([space.nominal.tolist(), *means], jnp.float32)
    joints = [n.removeprefix("qpos.") for n in simulator.state_names[: mj_model.nv]]
    measures: dict[str, Any] = {}
    for measure, first in (("all_windows", 0), ("without_first_row", 1)):
        measures[measure] = {}
        for name, runs in logs.items():
            cut = [rows_of(run, first, len(run)) for run in runs]
            none = np.zeros(mj_model.nv, bool)  # all velocities from the positions
            pieces = segments_from_runs(simulator, cut, steps, every, none)
            pieces = to_device(pieces)
            nominal, *rest = np.asarray(error(theta, pieces), float)
            middle = np.median(rest, axis=0)
            measures[measure][name] = {
                "windows": pieces.count,
                "nominal": dict(zip(joints, nominal.tolist(), strict=True)),
                "identified_median": dict(zip(joints, middle.tolist(), strict=True)),
                "identified": {
                    s: dict(zip(joints, x.tolist(), strict=True))
                    for s, x in zip(seeds, rest, strict=True)
                },
            }
            if name == "chirp_minus":
                best = _fitted_to_itself(simulator, space, pieces, theta[1])
                value = np.asarray(error(best[None], pieces), float)[0]
                measures[measure][name]["fitted_to_itself"] = dict(
                    zip(joints, value.tolist(), strict=True)
                )
    jumps = {
        run.name: float(
            abs(
                run.qpos[0, 0]
                - 3 * run.qpos[1, 0]
                + 3 * run.qpos[2, 0]
                - run.qpos[3, 0]
            )
        )
        for runs in logs.values()
        for run in runs
    }
    return {"measures": measures, "first_row_jump": jumps}


def _fitted_to_itself(simulator: Any, space: Any, pieces: Any, start: Any) -> Any:
    """Parameters (SI) that fit ``pieces`` best, their starts as measured."""
    import jax
    import jax.numpy as jnp

    from easi_jax.estimation.levenberg_marquardt import refine
    from easi_jax.estimation.normal_equations import PairedFit

    scale = [*GOALS.values()]
    misfit = jnp.asarray([*scale, *(jnp.inf for _ in scale)])
    still = jnp.full(2 * len(scale), 1e-6)
    paired = PairedFit(simulator, space, pieces, still, misfit=misfit)
    fit = jax.jit(lambda unit: refine(paired, unit, robust=0).unit)
    return space.to_si(fit(space.clip(space.to_unit(start))))


def judge(sets: dict[str, Any]) -> str:
    """Which goals are met, in one sentence."""
    missed = [
        f"chirp_minus {joint} {sets['chirp_minus']['identified_median'][joint]:.4f} "
        f"(goal {goal:g})"
        for joint, goal in GOALS.items()
        if sets["chirp_minus"]["identified_median"][joint] > goal
    ]
    swing = sets["swingup"]
    missed += [
        f"swingup {joint} {swing['identified_median'][joint]:.4f} "
        f"(nominal {swing['nominal'][joint]:.4f})"
        for joint in GOALS
        if swing["identified_median"][joint] >= swing["nominal"][joint]
    ]
    return f"missed: {'; '.join(missed)}" if missed else "all goals met"


if __name__ == "__main__":
    main(Config, run, name="benchmarks.real_cartpole", args=sys.argv[1:])

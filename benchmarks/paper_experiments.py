"""The experiments of the paper as cells; `benchmarks.paper` runs them."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks import paper_twin
from benchmarks._cells import Share
from benchmarks._common import at_least_one
from benchmarks.paper_cells import IMITATING, METHODS, Cell
from benchmarks.paper_runtime import WAYS
from benchmarks.rival_cells import AFTER_GAP

RESULTS = Path(__file__).parent / "results" / "paper.jsonl"

# As in the paper: what is changed in the target, and by how much.
CHANGED = {
    "cartpole": "cart_kp",
    "ant": "torso_mass",
    "ballbalance": "ball_mass",
    "go2": "thigh_kp",
    IMITATING: "thigh_kp",
}
MUST = METHODS[:7]
WHOLE = ("status", "all")
# Robots of experiments that are not of all; the first is taken for any other.
OF_SOME = {
    "table2": ("cartpole",),
    "fig7": ("go2", IMITATING),
    "appendix_a": ("go2",),
    "runtime": tuple(x for x in CHANGED if x != IMITATING),
}
ON_HARDWARE = ("UDR", "EASI paper", "EASI default", AFTER_GAP)
SEARCHES = ("EASI paper", "EASI default, not refined")
# Where searches start: as UDR trains, for a target with one value halved; then, for one
# at its nominal values, too low and too high, as factors on these. The paper's low
# start reaches down to 0, which no model can have.
STARTS = (None, (0.05, 1.0), (1.0, 2.0))


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Runs the cells of one of the paper's tables or figures."""

    experiment: Annotated[str, tyro.conf.Positional]
    """fig4, fig5, fig6, fig7, table1, table2, table3, table4, table5, appendix_a (go2),
    runtime; table2 is of cartpole's and fig7 of go2's twin, simulations in place of
    hardware. Or status: what stands of all of them; all: run
    what is missing or stale, the experiment that takes least first."""
    robot: str = ""
    """cartpole, ant, ballbalance, go2, or go2-imitating: Go2 with the paper's
    controller, Ess-InfoGAIL, whose demonstrations are made first (--folder). Where not
    given, or where the experiment is of others, the first that it is of; for status and
    all every one."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds, paired over methods."""
    methods: tuple[str, ...] = ()
    """Methods; those of the experiment where not given. For status and all, the ones
    among those."""
    env_steps: int | None = None
    """Control steps of each training; the robot's preset where not given."""
    workers: int = 1
    """For all: cells that run at once, each on a core of its own."""
    minutes: float | None = None
    """For all: run only cells that are expected to end within this time."""
    folder: Path = Path("results/paper")
    """Where UDR trainings are kept."""
    out: Path = dataclasses.field(default=RESULTS, kw_only=True)
    """Where a line for each cell is added."""


def cells(config: Config) -> list[Cell]:
    """The cells of an experiment, in the order in which they are run.

    Raises:
        UserError: no such experiment, robot or method, or a number that makes no
            sense.
    """
    from easi_jax.errors import UserError, nearest
    from train._robots import check_seeds

    check_seeds(config.seeds)
    at_least_one(config, "env_steps")
    if config.experiment not in EXPERIMENTS:
        known = ", ".join((*EXPERIMENTS, *WHOLE))
        hint = nearest(config.experiment, (*EXPERIMENTS, *WHOLE))
        raise UserError(f'experiment "{config.experiment}": {known}{hint}')
    if config.robot not in ("", *CHANGED):
        hint = nearest(config.robot, CHANGED)
        raise UserError(f"--robot {config.robot}: {', '.join(CHANGED)}{hint}")
    known = robots(config.experiment)
    robot = config.robot if config.robot in known else known[0]
    config = dataclasses.replace(config, robot=robot)
    for m in config.methods:
        if m not in METHODS:
            raise UserError(f'--methods "{m}": unknown{nearest(m, METHODS)}')
    found = []
    for seed in config.seeds:
        for c in EXPERIMENTS[config.experiment](config, seed):
            if c.method == AFTER_GAP and c.target != paper_twin.TWIN:
                raise UserError(f"{AFTER_GAP}: of table2 and fig7, where logs are all")
            found.append(dataclasses.replace(c, env_steps=config.env_steps))
    return found


def robots(experiment: str) -> tuple[str, ...]:
    """Robots that an experiment is of."""
    return OF_SOME.get(experiment, tuple(CHANGED))


def _returns(config: Config, seed: int, factors: tuple[float, ...]) -> list[Cell]:
    what = CHANGED[config.robot]
    return [
        Cell(m, config.robot, f"{what}*{x:g}", seed)
        for x in factors
        for m in config.methods or MUST
    ]


def _table1(config: Config, seed: int) -> list[Cell]:
    return _returns(config, seed, (0.25, 0.5))


def _fig6(config: Config, seed: int) -> list[Cell]:
    methods = config.methods or ("UDR", "EASI default", "Oracle")
    config = dataclasses.replace(config, methods=methods)
    return _returns(config, seed, (0.25, 0.5, 2.0, 4.0))


def _table2(config: Config, seed: int) -> list[Cell]:
    """In the paper on a real Cartpole; here in a twin (`benchmarks.twin`)."""
    return [
        Cell(m, config.robot, "twin", seed, trajectories=50)
        for m in config.methods or ON_HARDWARE
    ]


def _fig7(config: Config, seed: int) -> list[Cell]:
    """In the paper on a real Go2; here in a twin (`benchmarks.twin`)."""
    methods = config.methods or ON_HARDWARE
    return [Cell(m, config.robot, "twin", seed, trajectories=1) for m in methods]


def _table3(config: Config, seed: int) -> list[Cell]:
    target = _halved(config)
    found = [Cell("UDR", config.robot, target, seed)]
    for m in config.methods or ("EASI default",):
        for count in (1, 50, 100, 200):
            found.append(Cell(m, config.robot, target, seed, count))
    return found


def _fig4(config: Config, seed: int) -> list[Cell]:
    return _traced(config, seed, _halved(config), ())


def _appendix_a(config: Config, seed: int) -> list[Cell]:
    return _traced(config, seed, "FR_thigh_kp*0.5", ("parameters=full",))


def _halved(config: Config) -> str:
    """A target away from the nominal one, around which searches may start."""
    return f"{CHANGED[config.robot]}*0.5"


def _traced(
    config: Config, seed: int, target: str, options: tuple[str, ...]
) -> list[Cell]:
    return [
        Cell(
            *(m, config.robot, "" if start else target, seed),
            start=start,
            policy=False,
            curves=True,
            options=options,
        )
        for start in STARTS
        for m in config.methods or SEARCHES
    ]


def _fig5(config: Config, seed: int) -> list[Cell]:
    methods = config.methods or ("UDR", "EASI default", "EASI paper", "Oracle")
    return [Cell(m, config.robot, "", seed, curves=True) for m in methods]


def _runtime(config: Config, seed: int) -> list[Cell]:
    if config.methods:
        from easi_jax.errors import UserError

        raise UserError("runtime is of the default chain: leave --methods out")
    return [Cell(way, config.robot, _halved(config), seed) for way in WAYS]


def _swept(config: Config, seed: int, name: str, values: tuple) -> list[Cell]:
    return [
        Cell(
            *(m, config.robot, _halved(config), seed),
            settings=(f"{name}={x:g}",),
            policy=False,
        )
        for x in values
        for m in config.methods or SEARCHES
    ]


def _table4(config: Config, seed: int) -> list[Cell]:
    return _swept(config, seed, "elite_ratio", (0.1, 0.3, 0.5, 0.7, 0.9))


def _table5(config: Config, seed: int) -> list[Cell]:
    return _swept(config, seed, "discriminator_updates", (2, 5, 10, 15, 20))


EXPERIMENTS = {
    "fig4": _fig4,
    "fig5": _fig5,
    "fig6": _fig6,
    "fig7": _fig7,
    "table1": _table1,
    "table2": _table2,
    "table3": _table3,
    "table4": _table4,
    "table5": _table5,
    "appendix_a": _appendix_a,
    "runtime": _runtime,
}

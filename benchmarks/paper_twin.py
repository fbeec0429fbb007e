"""Cells of Table 2 and Fig. 7, with twins in place of the paper's real robots.

A twin (`benchmarks.twin`) is a richer simulation and NOT hardware: no figure made here
is a measurement on a real machine, and captions must say so.

The UDR policy acts in the twin and is logged; EASI searches from these logs; a policy
is trained under what it found; both act in the twin. ``EASI default`` is what
``python -m train.easi --data LOG`` does with logs of a real machine; before ``EASI
after train.gap``, that names what the model lacks in the same logs, and search and
training have it. ``EASI paper`` is the reference's recipe, which needs the controller:
it rolls it out in the simulation.
"""

import dataclasses
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper_cells import Cell, recipe, udr_run
from benchmarks.rival_cells import AFTER_GAP

TWIN = "twin"
COMMAND = 1.4  # m/s, of the Go2's logs
LOGGED = 2000  # control steps of them: 40 s
TRIES = 20  # starts of the Go2 for its logs, if it falls
_FOUND = "gap/effects.yaml"  # in a cell's folder
_PRESETS = {"EASI paper": "paper", "EASI default": "default", AFTER_GAP: "default"}


@dataclasses.dataclass(frozen=True)
class Transferred:
    """What a cell comes to before it is tested.

    Attributes:
        twin: the machine.
        first: UDR's policy, which was logged; ``logs`` of it.
        policy: the method's own.
        found: see `identified`; None for UDR.
        place: folder of what was found.
    """

    twin: Any
    first: Any
    logs: list[Any]
    policy: Any
    found: dict[str, Any] | None
    place: Path


def solve(cell: Cell, folder: Path) -> dict[str, Any]:
    """Runs a cell; trainings go on where they were stopped.

    Returns:
        What `balancing` or `tracking` (and `spectra`) say of the policy in the twin;
        ``logged`` control steps; for EASI ``mean`` (SI) and unit-coordinate ``std`` of
        the parameters, ``identify_s`` and, by commands alone, ``held_out`` open-loop
        errors; ``effects``, ``gap`` and more of train.gap, where it ran; ``seconds`` of
        this process.

    Raises:
        UserError: a method without a cell here.
    """
    from benchmarks.twin_measures import balancing, spectra, tracking

    begun = time.monotonic()
    got = transferred(cell, folder)
    row: dict[str, Any] = {
        "stands_for": "hardware, which it is not: a simulation in MuJoCo C",
        "logged": int(sum(log.steps.sum() for log in got.logs)),
    }
    found = got.found or {}
    row |= {k: v for k, v in found.items() if k not in ("unit_mean", "unit_cov")}
    seed = 2 * cell.seed + 1  # other starts than those that were logged
    if cell.robot == "cartpole":
        row |= balancing(got.twin, got.policy, seed)
    else:
        row |= tracking(got.twin, got.policy, seed)
        walking = with_effects(walker(), got.place) if found else walker()
        row["spectrum"] = spectra(
            *(walking, got.first, seed, LOGGED, got.logs, found.get("mean"))
        )
    return row | {"seconds": time.monotonic() - begun}


def transferred(cell: Cell, folder: Path) -> Transferred:
    """The policy of a cell's method, trained where it is not there yet.

    Raises:
        UserError: a method without a cell here.
    """
    import jax

    from benchmarks.twin import GAPS, Twin
    from easi_jax.errors import UserError
    from train._robots import load_udr

    if cell.method not in ("UDR", *_PRESETS):
        raise UserError(f"no {cell.method} in a twin: UDR, {', '.join(_PRESETS)}")
    env = cell.env()
    twin = Twin(env, GAPS[cell.machine.robot])
    udr = load_udr(udr_run(cell, folder))
    first = jax.tree.map(lambda x: x[0], udr["policies"])
    logs = record(twin, first, cell)
    # What an earlier recipe of the method has left there is not gone on with.
    made = recipe(cell.method, cell.robot)
    place = folder / re.sub(r"\W+", "_", f"{cell.key}, recipe {made}")
    policy, found = first, None
    if cell.method != "UDR":
        place.mkdir(parents=True, exist_ok=True)
        found = identified(cell, place, env, first, twin, logs)
        policy = trained(cell, folder, place, with_effects(env, place), found)
    return Transferred(twin, first, logs, policy, found, place)


# -- logs --------------------------------------------------------------------


def record(twin: Any, policy: Any, cell: Cell) -> list[Any]:
    """What is logged of the policy in the twin, as the paper has it.

    Cartpole: trajectories with the policy's own randomness, as all demonstrations here.
    Go2: one walk at `COMMAND` by the policy's mode; where it falls it is set up again
    until the time is full, as people would, at most `TRIES` times.
    """
    from benchmarks.twin_runs import play

    env, seed = twin.env, 2 * cell.seed
    if cell.robot == "cartpole":
        return [play(twin, policy, seed, cell.trajectories, env.episode_length, False)]
    return walked(twin, policy, seed)


def walked(twin: Any, policy: Any, seed: int) -> list[Any]:
    """Walks of a Go2 at `COMMAND` until `LOGGED` steps are full; see `record`."""
    from benchmarks.twin_runs import commanded, play

    start, logs, left = commanded(twin.env, [COMMAND]), [], LOGGED
    for k in range(TRIES):
        log = play(twin, policy, seed + 1000 * k, 1, left, True, start)
        logs.append(log)
        left -= int(log.steps[0])
        if left <= 0:
            break
    return logs


def walker() -> Any:
    """The paper's real Go2 as it is searched: 7 parameters, always at `COMMAND`."""
    from envs import make
    from envs.go2 import Commands

    none = (0.0, 0.0)
    only = Commands(forward=(COMMAND, COMMAND), sideways=none, turn=none, still=0.0)
    return make("go2", parameters="real", commands=only)


# -- identification ----------------------------------------------------------


def identified(
    cell: Cell, place: Path, env: Any, policy: Any, twin: Any, logs: list[Any]
) -> dict[str, Any]:
    """What EASI finds in the logs; kept in ``place/found.json``.

    Returns:
        ``names``; ``mean`` in SI, ``std``, ``unit_mean``, ``unit_cov`` in unit
        coordinates of the preset's space; ``identify_s``; ``held_out`` where known.
    """
    from benchmarks.twin_measures import rounded
    from easi_jax.io.files import atomic_write, read_json, to_json

    path = place / "found.json"
    if path.exists():
        return read_json(path)
    begun = time.monotonic()
    searched = env if cell.robot == "cartpole" else walker()
    by = _by_command if _PRESETS[cell.method] == "default" else by_controller
    found = by(cell, place, searched, policy, twin, logs)
    std = np.sqrt(np.diag(found["unit_cov"]))
    searched = with_effects(searched, place)
    found |= {
        "names": searched.space.names,
        "mean": rounded(found["mean"]),
        "std": rounded(std),
        "identify_s": time.monotonic() - begun,
    }
    atomic_write(path, to_json(found))
    return read_json(path)


def _by_command(
    cell: Cell, place: Path, env: Any, policy: Any, twin: Any, logs: list[Any]
) -> dict[str, Any]:
    """``train.easi --data``, as for logs of a real machine; `AFTER_GAP`: with what
    ``train.gap`` found."""
    from benchmarks.twin_measures import rounded
    from easi_jax.io.files import read_json
    from easi_jax.io.logs.reader import write_log
    from easi_jax.io.models.parameter_file import write_parameter_file
    from train import easi

    del policy  # logs come without it
    runs = [run for log in logs for run in log.runs(twin)]
    runs = [dataclasses.replace(run, name=str(i)) for i, run in enumerate(runs)]
    write_log(place / "log.csv", env.mj_model, [r for r in runs if len(r) > 1])
    write_parameter_file(place / "parameters.yaml", env.space)
    out, told = place / "easi", {}
    given: dict[str, Any] = {
        "data": (place / "log.csv",),
        "parameters": place / "parameters.yaml",
        "resume": True,
    }
    if cell.method == AFTER_GAP:
        _named(cell.machine.robot, place)
        known = read_json(place / "gap" / "gap.json")
        told = {k: known[k] for k in ("effects", "refitted", "gap", "verdict")}
    easi.run(
        easi.Config(
            robot=cell.machine.robot,
            effects=place / _FOUND if told else None,
            set=cell.settings,
            seeds=(cell.seed,),
            out=out,
            **given,
        )
    )
    distribution = read_json(out / "distribution.json")
    result, held = distribution["seeds"][str(cell.seed)], distribution["held_out"]
    return told | {
        "mean": result["mean"],
        "unit_mean": result["unit_mean"],
        "unit_cov": result["unit_covariance"],
        "held_out": {
            "channels": held["channels"],
            "before": rounded(held["before"]),
            "after": rounded(held["after"][str(cell.seed)]),
            "noise_floor": rounded(held["noise_floor"]),
        },
    }


def _named(robot: str, place: Path) -> None:
    """``train.gap``, by itself: it compiles its loops otherwise than the rest.

    Raises:
        RuntimeError: it failed; it has said why.
    """
    from benchmarks.gap_first import GapFirst

    words = ["--model", robot, "--data", place / "log.csv", "--resume"]
    words += ["--parameters", place / "parameters.yaml", "--out", place / "gap"]
    command = [sys.executable, "-m", "train.gap", *map(str, words)]
    done = subprocess.run(command, timeout=GapFirst.time_limit)
    if done.returncode:
        raise RuntimeError(f"train.gap failed with {done.returncode}")


def with_effects(env: Any, place: Path) -> Any:
    """The environment with what ``train.gap`` found in ``place``, if it ran there."""
    from easi_jax.io.models.effects_file import parsed_effects
    from easi_jax.io.strict_yaml import read_yaml
    from easi_jax.simulation.with_effects import env_with

    path = place / _FOUND
    if not path.exists():
        return env
    return env_with(env, parsed_effects(read_yaml(path), str(path)))


def by_controller(
    cell: Cell, place: Path, env: Any, policy: Any, twin: Any, logs: list[Any]
) -> dict[str, Any]:
    """The reference's recipe: the controller runs in the simulation too."""
    import jax
    import jax.numpy as jnp

    from easi_jax.baselines import Budget, Easi, Task
    from easi_jax.data.segments import join
    from easi_jax.model import distribution
    from easi_jax.pipeline.stages import seed_keys, stage_keys
    from easi_jax.rl.networks import act
    from train._robots import search_config

    del place, twin
    deterministic = cell.robot != "cartpole"  # as they were logged
    pieces = [jax.tree.map(_flat, log.segments()) for log in logs]
    demos = jax.tree.map(lambda x: jnp.asarray(x)[None], join(pieces))
    task = Task(
        simulator=env.simulator,
        noise=jnp.zeros(2 * env.mj_model.nv),
        env=env,
        act=lambda policy, obs, key: act(policy, obs, key, deterministic),
        policy=policy,
    )
    key = stage_keys(seed_keys([cell.seed]))["search"][0]
    # A log holds positions and speeds, and not what the controller saw.
    unseen = {"observation_inputs": False, "mask_resets": True}
    config = search_config("paper", cell.settings, cell.machine.robot, **unseen)
    found = Easi(config).fit(task, demos, Budget(), key)
    dist = found.distribution
    return {
        "mean": np.asarray(found.space.to_si(dist.mean)),
        "unit_mean": np.asarray(dist.mean),
        "unit_cov": distribution.covariance(dist),
    }


def _flat(x: Any) -> Any:
    return x.reshape(-1, *x.shape[2:])


# -- training ----------------------------------------------------------------


def trained(
    cell: Cell, folder: Path, place: Path, env: Any, found: dict[str, Any]
) -> Any:
    """The policy of a whole training under what was found, in chunks."""
    import jax
    import jax.numpy as jnp

    from easi_jax.baselines.policies import quiet
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.model import distribution
    from easi_jax.pipeline.stages import Pipeline, PipelineConfig, seed_keys, stage_keys
    from train._robots import search_config, training_chunk
    from train._stages import jit_chunks, run_stage

    training = quiet(cell.training(env, folder))
    search = search_config(_PRESETS[cell.method], cell.settings, cell.machine.robot)
    pipe = Pipeline(env, PipelineConfig(search=search, training=training))
    mean, cov = whole(pipe.space, found)
    dist = pipe.spread(distribution.gaussian(pipe.space, mean, cov), 1)
    nominal = jnp.asarray(env.space.nominal, jnp.float32)
    step = jit_chunks(lambda s, d, theta, n: pipe.train_chunk(s, d, theta, n))
    key = stage_keys(seed_keys([cell.seed]))["final"]
    with RunFolder.open(
        place / "training",
        {"cell": dataclasses.asdict(cell), "mean": mean.tolist()},
        command="benchmarks.paper",
        resume=True,
    ) as run:
        states = run_stage(
            run,
            "final",
            training.iterations,
            training_chunk(None, training),
            lambda: pipe.train_init(key, dist),
            lambda states, n: step(states, dist, nominal, n),
            lambda *_: [],  # `quiet` leaves no curve
        )
    return jax.tree.map(lambda x: x[0], pipe.policies(states))


def whole(space: Any, found: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of what was found, over all of the robot's parameters.

    Those that were not searched (the Go2's ground friction) keep the middle and the
    spread that UDR has, so that nothing else differs from UDR's training.
    """
    at = [space.names.index(name) for name in found["names"]]
    mean, cov = np.full(space.size, 0.5), np.eye(space.size) / 12
    mean[at], cov[np.ix_(at, at)] = found["unit_mean"], found["unit_cov"]
    return mean, cov

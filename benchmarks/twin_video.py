"""A Go2 before and after EASI in its twin, side by side, at the same command.

    python -m benchmarks.twin_video --robot go2-imitating --out docs/go2_twin.gif
    python -m benchmarks.twin_video --out docs/go2_twin.svg

The policies are those of ``python -m benchmarks.paper fig7``; what is not there yet is
trained first, in the same folder. The twin (`benchmarks.twin`) is a richer simulation
and NOT hardware: captions must say so.
"""

import dataclasses
from pathlib import Path
from typing import Any

from train._command import main, say


@dataclasses.dataclass(frozen=True)
class Config:
    """Draws how policies walk in the twin."""

    robot: str = "go2"
    """go2, or go2-imitating: with the paper's controller."""
    methods: tuple[str, ...] = ("UDR", "EASI default")
    """Whose policies, from left to right, as benchmarks.paper fig7 has them."""
    seed: int = 0
    """Of the cells, and of the start."""
    command: float = 1.4
    """Speed forward that is asked for [m/s]."""
    seconds: float = 6.0
    """How long they walk; a picture ends where the first of them falls."""
    env_steps: int | None = None
    """Control steps of each training; the robot's preset where not given."""
    folder: Path = Path("results/paper")
    """Where trainings are kept."""
    out: Path = Path("results/go2_twin.gif")
    """A video, .gif or .mp4 (with ffmpeg), or a strip of frames, .svg."""


def run(config: Config) -> None:
    """Trains what is missing, walks, draws."""
    from benchmarks._common import at_least_one
    from benchmarks.paper_cells import Cell
    from benchmarks.paper_experiments import ON_HARDWARE, robots
    from benchmarks.paper_twin import transferred
    from easi_jax.errors import UserError, nearest
    from easi_jax.io.report.video import check_video, side_by_side
    from train._robots import check_seeds

    check_seeds((config.seed,))
    at_least_one(config, "env_steps")
    check_video(config.out)
    known = robots("fig7")
    if config.robot not in known:
        hint = nearest(config.robot, known)
        raise UserError(f"--robot {config.robot}: {', '.join(known)}{hint}")
    if not 0 < config.seconds <= 60:
        raise UserError(f"--seconds {config.seconds:g}: above 0, at most 60")
    for method in config.methods or ("",):
        if method not in ON_HARDWARE:
            hint = nearest(method, ON_HARDWARE)
            raise UserError(f'--methods "{method}": {", ".join(ON_HARDWARE)}{hint}')
    motions, told = [], []
    for method in config.methods:
        cell = Cell(method, config.robot, "twin", config.seed, 1, config.env_steps)
        got = transferred(cell, config.folder)
        motion, speed = walk(got, config)
        motions.append((method, motion))
        told.append(f"{method} {speed:.2f} m/s, {got.twin.env.dt * len(motion):.1f} s")
    env = got.twin.env
    side_by_side(
        *(config.out, env.mj_model, env.dt, motions), lambda text: say(f"note: {text}")
    )
    say(f"at {config.command:g} m/s in a simulation, no hardware: {'; '.join(told)}")
    say(f"written: {config.out}")


def walk(got: Any, config: Config) -> tuple[Any, float]:
    """True positions ``(T, nq)`` of one walk up to its fall, and its mean speed along
    the way that it begins with [m/s]."""
    from benchmarks.twin_runs import commanded, play

    env = got.twin.env
    steps = max(2, round(config.seconds / env.dt))
    start = commanded(env, [config.command])
    seed = 2 * config.seed + 1  # another start than the one that was logged
    walked = play(got.twin, got.policy, seed, 1, steps, True, start)
    motion = walked.true_qpos[0, : int(walked.steps[0]) + 1]
    moved = motion[-1, :2] - motion[0, :2]
    return motion, float((moved**2).sum() ** 0.5 / (env.dt * (len(motion) - 1)))


if __name__ == "__main__":
    main(Config, run, name="benchmarks.twin_video")

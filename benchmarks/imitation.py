"""Does a Go2 that imitates walk as its demonstrations do?

    python -m benchmarks.imitation

Trains by the commands of a user, in ``--folder``: demonstrations of a trot
(``train.demonstrate``), a policy that imitates them (``train.udr --algorithm
ess_infogail``) and one that PPO trains by hand-made rewards, with the same steps. Then
plays each at the demonstrated speeds. ``three skills`` are trot, pace and bound at
once, 1, 0.22 and 0.05 of the episodes of the first, with labels on one step in 200.

The paper's experiments with this controller are ``python -m benchmarks.paper fig7
--robot go2-imitating``, and its others.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of, markdown_table
from benchmarks._page import Section, those
from benchmarks.demonstrated import demonstrated, ran
from train._command import main

SPEEDS = (0.4, 0.8, 1.2, 1.6)  # m/s
ESS, PPO, THREE = "Ess-InfoGAIL", "PPO, hand-made rewards", "three skills"
METHODS = (ESS, PPO, THREE)
GAITS = ("trot", "pace", "bound")
LABELLED = 0.005
NOISE = 0.1  # of actions, that of the demonstrations
EPISODES = 10  # of each speed
_FORWARD = "forward=0.4:1.6"


@dataclasses.dataclass(frozen=True)
class Cell:
    """A method and a seed."""

    method: str
    seed: int

    @property
    def key(self) -> str:
        """Both, for files."""
        return f"{self.method}, {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Trains Go2 by imitation and by hand-made rewards, and compares."""

    folder: Path = Path("results/imitation")
    """Where runs are kept; those that are there are not made again."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of trainings."""
    env_steps: int = 5_000_000
    """Control steps of each training."""
    out: Path = dataclasses.field(default=RESULTS / "imitation.jsonl", kw_only=True)
    """Where a line for each is added."""


def run(config: Config) -> None:
    """Runs the cells."""
    cells = [Cell(m, s) for s in config.seeds for m in METHODS]
    run_cells(cells, config, lambda cell: solve(cell, config), told)


def told(row: dict[str, Any]) -> str:
    """A line on a cell."""
    if "nmi" in row:
        return f"NMI {row['nmi']:.2f}, prior off by {row['prior']:.2f}"
    return f"told apart {row['told_apart']:.2f}, {row['seconds']:.0f} s"


def solve(cell: Cell, config: Config) -> dict[str, Any]:
    """Trains what is missing, plays, measures."""
    if cell.method == THREE:
        return _three(cell, config)
    shown, shown_s = demonstrated(config.folder, ("trot",), config.env_steps)
    words = ["--robot", "go2", "--fixed", "--option", _FORWARD]
    if cell.method == ESS:
        words += [*_IMITATES, shown]
    name = "ess" if cell.method == ESS else "ppo"
    out = config.folder / f"{name}_{config.env_steps}_{cell.seed}"
    words += ["--seeds", cell.seed, "--env-steps", config.env_steps]
    seconds = ran("train.udr", out, *words)
    return measured(out, shown) | {"seconds": seconds, "demonstrated_s": shown_s}


_IMITATES = ["rewarded=command", "--algorithm", "ess_infogail", "--demonstrations"]


# -- what is measured ------------------------------------------------------------------


def played(env: Any, policy: Any, noise: float, seed: int) -> Any:
    """Rows of `EPISODES` episodes of each speed, ``(speeds, episodes, T, ...)``."""
    import jax
    import jax.numpy as jnp

    from easi_jax.rl.networks import noisy
    from easi_jax.simulation.rollout import policy_rollout
    from envs.go2 import Commanded

    def one(key: Any, speed: Any) -> Any:
        at = Commanded(env, speed)
        return policy_rollout(at, model, acts, key, env.episode_length)

    model, acts = env.model(), noisy(policy, noise)
    keys = jax.random.split(jax.random.key(seed), EPISODES)
    every = jax.vmap(jax.vmap(one, (0, None)), (None, 0))
    return jax.device_get(jax.jit(every)(keys, jnp.array(SPEEDS)))


def windows_and_episodes(env: Any, rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Windows of all steps that count, and the episode of each."""
    import jax
    import jax.numpy as jnp

    from easi_jax.rl.demonstrations import style_of, windows_of

    style = jax.jit(jax.vmap(jax.vmap(jax.vmap(style_of(env)))))
    motion = np.asarray(style(jnp.asarray(rows.qpos), jnp.asarray(rows.qvel)))
    motion = motion.reshape(-1, *motion.shape[2:])
    alive = rows.weight.reshape(len(motion), -1).sum(1).astype(int)
    found = [
        windows_of(m[:n], m[:n], 2) for m, n in zip(motion, alive, strict=True) if n > 1
    ]
    return np.concatenate(found), np.repeat(
        np.arange(len(found)), list(map(len, found))
    )


def measured(run: Path, shown: Path) -> dict[str, Any]:
    """How a run's policy walks beside the demonstrations in ``shown``.

    Returns:
        ``speeds``: of each its ``error`` [m/s], ``rate`` and ``duty`` as ratios to the
        demonstrations', ``phase`` (largest difference, in strides) and ``fallen``;
        ``told_apart`` by a fresh classifier.
    """
    import jax

    from easi_jax.io.logs.reader import read_logs
    from easi_jax.rl.demonstrations import read_demonstrations
    from easi_jax.rl.imitation_measures import told_apart
    from envs.go2_gait import gait_of, mean_gait, phase_distance
    from train._robots import load_policies

    saved = load_policies(run)
    env = saved["env"]
    policy = jax.tree.map(lambda x: x[0], saved["policies"])
    quiet, noisy = played(env, policy, 0.0, 1), played(env, policy, NOISE, 2)
    runs = read_logs(shown, env.mj_model).runs
    speeds = []
    for k, speed in enumerate(SPEEDS):
        stood = quiet.qpos[k][quiet.weight[k].all(-1)]
        theirs = mean_gait(
            [gait_of(r.qpos, r.dt) for r in runs if f":{speed:g}-" in r.name]
        )
        row = {"speed": speed, "fallen": EPISODES - len(stood)}
        if len(stood):
            own = mean_gait([gait_of(q, env.dt) for q in stood])
            row |= {
                "error": own.speed - speed,
                "rate": own.rate / theirs.rate,
                "duty": float(own.duty.mean() / theirs.duty.mean()),
                "phase": phase_distance(own.phase, theirs.phase),
            }
        speeds.append(row)
    given = read_demonstrations(shown, env)
    own, episodes = windows_and_episodes(env, noisy)
    apart = [
        told_apart(given.windows, own, given.episodes, episodes, seed)
        for seed in range(3)
    ]
    return {"speeds": speeds, "told_apart": float(np.median(apart)), "each": apart}


def _three(cell: Cell, config: Config) -> dict[str, Any]:
    """Trot, pace and bound by one policy: is each skill its gait?"""
    import jax

    from easi_jax.rl import imitation_measures as measures
    from easi_jax.rl.demonstrations import read_demonstrations
    from train._robots import load_udr

    shown, shown_s = demonstrated(config.folder, GAITS, config.env_steps)
    out = config.folder / f"three_{config.env_steps}_{cell.seed}"
    seconds = ran(
        *("train.udr", out, "--robot", "go2", "--fixed", "--option", _FORWARD),
        *(*_IMITATES, shown, "--labelled", LABELLED),
        *("--seeds", cell.seed, "--env-steps", config.env_steps),
    )
    saved = load_udr(out)
    env, trainer = saved["env"], saved["trainer"]
    state = jax.tree.map(lambda x: x[0], saved["states"])
    given = read_demonstrations(shown, env)
    k = len(given.skills)
    classifier = measures.Classifier(given.windows, given.labels, k, cell.seed)
    episodes, skills = [], []
    for skill in range(k):
        rows = played(env, trainer.policy_of(state, skill), 0.0, 1)
        windows, names = windows_and_episodes(env, rows)
        episodes += [windows[names == n] for n in np.unique(names)]
        skills += [skill] * len(np.unique(names))
    confusion = measures.confusion_of(classifier, episodes, np.array(skills), k)
    share = np.bincount(given.labels, minlength=k) / len(given.labels)
    prior = np.asarray(trainer.prior(state), float)
    return {
        "skills": list(given.skills),
        "nmi": measures.mutual_information(confusion),
        "ent": measures.skill_entropy(confusion),
        "confusion": confusion.tolist(),
        "prior": measures.prior_distance(prior, share),
        "found_prior": prior.tolist(),
        "true_prior": share.tolist(),
        "seconds": seconds,
        "demonstrated_s": shown_s,
    }


# -- the page --------------------------------------------------------------------------


def _walks(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        (
            *(r["method"], r["seed"]),
            *(_each(r, name) for name in ("error", "rate", "duty")),
            _each(r, "phase"),
            f"{r['told_apart']:.0%}",
            sum(s["fallen"] for s in r["speeds"]),
            f"{r['seconds'] / 60:.0f}",
        )
        for r in rows
    ]
    speeds = ", ".join(f"{v:g}" for v in SPEEDS)
    return [
        f"`python -m benchmarks.imitation` (commits {commits_of(rows)}): a trot at "
        f"{speeds} m/s, {EPISODES} episodes each, those that fell aside. Rates and "
        "duties are ratios to the demonstrations'; a fresh classifier tells pairs of "
        "frames from demonstrated ones, both with the demonstrations' noise, split by "
        "episode (50 % is best, the goal is 75 at most).",
        markdown_table(
            (
                *("method", "seed", "speed error [m/s]", "stride rate", "duty"),
                *("phase difference [strides]", "told apart", "falls of 40"),
                "minutes of training",
            ),
            lines,
        ),
    ]


def _each(row: dict[str, Any], name: str) -> str:
    """A number of each speed; ``-`` where every episode fell."""
    form = "+.2f" if name == "error" else ".2f"
    return ", ".join(format(s[name], form) if name in s else "-" for s in row["speeds"])


def _skills(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        (
            *(r["seed"], f"{r['nmi']:.2f}", f"{r['ent']:.2f}", f"{r['prior']:.2f}"),
            ", ".join(f"{p:.2f}" for p in r["found_prior"]),
            ", ".join(f"{p:.2f}" for p in r["true_prior"]),
            f"{r['seconds'] / 60:.0f}",
        )
        for r in rows
    ]
    return [
        f"Three skills ({', '.join(rows[0]['skills'])}), labels on one step in "
        f"{round(1 / LABELLED)} (commits {commits_of(rows)}):",
        markdown_table(
            (
                *("seed", "NMI", "ENT [nat]", "prior off by (total variation)"),
                *("prior found", "share of demonstrations", "minutes of training"),
            ),
            lines,
        ),
    ]


SECTIONS = (
    Section(
        "## A Go2 that imitates",
        "imitation.jsonl",
        "imitation",
        _walks,
        those(lambda r: "speeds" in r),
    ),
    Section("", "imitation.jsonl", "imitation", _skills, those(lambda r: "nmi" in r)),
)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.imitation")

"""Ess-InfoGAIL on its authors' own kind of toy: a point that draws circles.

    python -m benchmarks.circles

A point is moved by its displacement, 60 steps from the origin; demonstrations are
circles of four radii, of which one has as many as a second, the others 22 and 5 % of
it, and one window in 200 has a label. Each cell trains one policy and plays every
skill; a classifier that was taught on labelled demonstrations says which circle was
drawn. Cells are a form (`default`, `paper`), what is left out of it, and a seed.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks._cells import Share, run_cells
from benchmarks._common import RESULTS, commits_of, markdown_table
from benchmarks._page import Section
from train._command import main

RADII = (0.5, 0.8, 1.2, 2.0)  # m
# Of the demonstrations: thirds of the modes keep 1, 0.224 and 0.05 of theirs.
SHARES = (1.0, 1.0, 0.224, 0.05)
STEPS = 60  # of an episode
EPISODES = 100  # of a mode that keeps all of its own
LABELLED = 0.005  # share of windows with a label
_STEP = 0.15  # m, displacement at action 1
_PACE = 0.7  # of it, that demonstrations move by
_NOISE = 0.1  # of actions, standard deviation
_REPEATS = 20  # episodes of a skill
FORMS = ("default", "paper")
LEFT_OUT = ("nothing", "labels", "learned prior", "information terms")
ENV_STEPS = 1_000_000


Episode = tuple[np.ndarray, np.ndarray, np.ndarray]


class Point(NamedTuple):
    """Position [m] and last displacement [m], ``(2,)`` each."""

    qpos: Any
    qvel: Any


class Circles:
    """A point, moved by its action: an environment without physics or task."""

    name = "circles"
    obs_size = 4
    action_size = 2
    episode_length = STEPS
    dt = 1.0

    def reset(self, model: Any, key: Any) -> Any:
        """Near the origin, at rest."""
        import jax
        import jax.numpy as jnp

        from easi_jax.simulation.env import start

        del model
        at = 0.01 * jax.random.normal(key, (2,))
        point = Point(at, jnp.zeros(2))
        return start(point, self.style(*point))

    def step(self, model: Any, state: Any, action: Any) -> Any:
        """One displacement."""
        import jax.numpy as jnp

        from easi_jax.simulation.env import advance

        del model
        by = _STEP * jnp.clip(action, -1.0, 1.0)
        point = Point(state.physics.qpos + by, by)
        zero = jnp.zeros(())
        obs = self.style(*point)
        return advance(state, point, obs, zero, zero, self.episode_length)

    def control(self, state: Any, action: Any) -> Any:
        """The action."""
        del state
        return action

    def style(self, qpos: Any, qvel: Any) -> Any:
        """Position and displacement, ``(4,)``."""
        import jax.numpy as jnp

        return jnp.concatenate([qpos, qvel / _STEP])


def circle(radius: float, rng: np.random.Generator | None) -> Episode:
    """Positions, displacements and actions of a demonstration, ``(STEPS, 2)`` each: a
    circle through the origin, to the left, with noise that is steered against; without
    any where ``rng`` is None."""

    def noise() -> np.ndarray:
        return np.zeros(2) if rng is None else rng.standard_normal(2)

    center = np.array([0.0, radius])
    at, last = 0.01 * noise(), np.zeros(2)
    rows = []
    for _ in range(STEPS):
        out = (at - center) / max(float(np.linalg.norm(at - center)), 1e-6)
        along = np.array([-out[1], out[0]])
        # Chords lie inside: what a step of this length along the tangent adds.
        off = np.linalg.norm(at - center + _PACE * _STEP * along) - radius
        action = _PACE * along - off / _STEP * out
        action = np.clip(action + _NOISE * noise(), -1.0, 1.0)
        rows.append((at, last, action))
        last = _STEP * action
        at = at + last
    qpos, qvel, ctrl = (np.array(x) for x in zip(*rows, strict=True))
    return qpos, qvel, ctrl


def demonstrations(
    seed: int, shares: tuple[float, ...] = SHARES, frames: int = 1
) -> Any:
    """`Demonstrations` of all radii, ``shares`` of `EPISODES` each."""
    from easi_jax.rl.demonstrations import demonstrations_of

    rng = np.random.default_rng([5, seed])
    episodes, labels = [], []
    for k, (radius, share) in enumerate(zip(RADII, shares, strict=True)):
        for _ in range(round(share * EPISODES)):
            episodes.append(circle(radius, rng))
            labels.append(k)
    skills = tuple(f"radius {radius:g} m" for radius in RADII)
    return demonstrations_of(Circles(), episodes, labels, skills, frames)


@dataclasses.dataclass(frozen=True)
class Cell:
    """A form, what is left out of it, and a seed."""

    form: str
    left_out: str
    seed: int

    @property
    def key(self) -> str:
        """All of it, for files."""
        return f"{self.form}, without {self.left_out}, {self.seed}"


@dataclasses.dataclass(frozen=True)
class Config(Share):
    """Trains Ess-InfoGAIL on circles, with all terms and without some."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Of demonstrations and trainings."""
    out: Path = dataclasses.field(default=RESULTS / "circles.jsonl", kw_only=True)
    """Where a line for each is added."""


def run(config: Config) -> None:
    """Runs the cells."""
    cells = [
        Cell(form, left_out, seed)
        for seed in config.seeds
        for form in FORMS
        for left_out in LEFT_OUT
    ]
    run_cells(cells, config, solve, told)


def told(row: dict[str, Any]) -> str:
    """A line on a cell."""
    return (
        f"NMI {row['nmi']:.2f}, ENT {row['ent']:.2f}, prior off by {row['prior']:.2f}, "
        f"{row['seconds']:.0f} s"
    )


def shown(cell: Cell) -> Any:
    """Demonstrations of a cell, with the labels that it has."""
    share = 0.0 if cell.left_out == "labels" else LABELLED
    return demonstrations(cell.seed).labelled(share, cell.seed)


def settings(
    form: str, left_out: str, demonstrations: Any, env_steps: int = ENV_STEPS
) -> Any:
    """Training settings of a cell."""
    from easi_jax.rl.config import EssInfoGailConfig, PaperEssInfoGailConfig

    shared: dict[str, Any] = {
        "env_steps": env_steps,
        "demonstrations": demonstrations,
        "skills": len(RADII),
        "continuous": True,
        "frames": 1,
        "num_envs": 64,
        "unroll": STEPS,
    }
    if form == "paper":
        shared.pop("continuous")
        base = PaperEssInfoGailConfig(**shared)
    else:
        # At a constant rate where the training ends is a matter of luck: the policy
        # and the discriminator run after each other.
        base = EssInfoGailConfig(**shared, task_reward=0.0, learning_rate_decay=0.05)
    if left_out == "learned prior":
        return dataclasses.replace(base, prior="fixed", prior_cost=0.0)
    if left_out == "information terms":
        none = dict.fromkeys(("conditional_cost", "marginal_cost", "prior_cost"), 0.0)
        return dataclasses.replace(base, **none)
    return base


def solve(cell: Cell, env_steps: int = ENV_STEPS) -> dict[str, Any]:
    """Trains and plays; ``nmi``, ``ent``, ``prior`` (total variation) and more."""
    import jax
    import jax.numpy as jnp

    from easi_jax.rl import imitation_measures as measures
    from easi_jax.rl.ess_infogail import EssInfoGail

    begun = time.monotonic()
    env = Circles()
    given = shown(cell)
    trainer = EssInfoGail(
        *(env, settings(cell.form, cell.left_out, given, env_steps)),
        *(lambda theta: theta, lambda dist, key: dist),
    )
    state, info = jax.jit(lambda key: trainer.train(key, jnp.zeros(())))(
        jax.random.key(cell.seed)
    )
    classifier, right = judge_of_circles(cell.seed)
    episodes, skills = played(trainer, state, cell.seed)
    confusion = measures.confusion_of(classifier, episodes, skills, len(RADII))
    prior = np.asarray(trainer.prior(state), float)
    true = np.array(SHARES) / sum(SHARES)
    return {
        "nmi": measures.mutual_information(confusion),
        "ent": measures.skill_entropy(confusion),
        "confusion": confusion.tolist(),
        "prior": measures.prior_distance(prior, true, cell.left_out != "labels"),
        "found_prior": prior.tolist(),
        "off_path": off_path(episodes, [RADII[k] for k in skills]),
        "classifier_right": right,
        "judge_right": float(np.asarray(info["judge_right"])[-20:].mean()),
        "seconds": time.monotonic() - begun,
    }


def off_path(episodes: list[np.ndarray], radii: list[float]) -> float:
    """Mean distance [m] of episodes, windows ``(T, features)``, from the place that a
    demonstration without noise of their radius has at the same time."""
    paths = {r: circle(r, None)[0] for r in set(radii)}
    off = [
        np.linalg.norm(e[:, :2] - paths[r][: len(e)], axis=1)
        for e, r in zip(episodes, radii, strict=True)
    ]
    return float(np.mean(np.concatenate(off)))


def judge_of_circles(seed: int) -> tuple[Any, float]:
    """A classifier of windows into radii, and the share of held-out episodes that it
    has right."""
    from easi_jax.rl import imitation_measures as measures

    even = demonstrations(1000 + seed, (0.5,) * len(RADII))
    held = even.episodes % 5 == 0
    classifier = measures.Classifier(
        even.windows[~held], even.labels[~held], len(RADII), seed
    )
    names = np.unique(even.episodes[held])
    episodes = [even.windows[even.episodes == k] for k in names]
    labels = np.array([even.labels[even.episodes == k][0] for k in names])
    found = measures.confusion_of(classifier, episodes, labels, len(RADII))
    return classifier, float(np.trace(found) / found.sum())


def played(
    trainer: Any, state: Any, seed: int, skills: int = len(RADII)
) -> tuple[list[np.ndarray], np.ndarray]:
    """Windows of `_REPEATS` episodes of each skill, by the policy's mode."""
    import jax

    from easi_jax.rl.demonstrations import windows_of
    from easi_jax.rl.networks import act

    env = Circles()

    def episode(policy: Any, key: Any) -> Any:
        def step(state: Any, _: Any) -> Any:
            action = act(policy, state.obs, deterministic=True)
            row = env.style(*state.physics), action
            return env.step(None, state, action), row

        first = env.reset(None, key)
        motion, actions = jax.lax.scan(step, first, length=STEPS)[1]
        return windows_of(motion, actions, 1)

    episodes, given = [], []
    for skill in range(skills):
        policy = trainer.policy_of(state, skill)
        keys = jax.random.split(jax.random.key(100 + seed), _REPEATS)
        windows = jax.jit(jax.vmap(lambda k, p=policy: episode(p, k)))(keys)
        episodes += list(np.asarray(windows))
        given += [skill] * _REPEATS
    return episodes, np.array(given)


# -- the page --------------------------------------------------------------------------


def _shown(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for form in FORMS:
        for left_out in LEFT_OUT:
            mine = [r for r in rows if (r["form"], r["left_out"]) == (form, left_out)]
            if not mine:
                continue
            each = [
                ", ".join(f"{r[name]:.2f}" for r in mine)
                for name in ("nmi", "ent", "prior", "off_path")
            ]
            seconds = np.median([r["seconds"] for r in mine])
            lines.append((form, left_out, len(mine), *each, f"{seconds:.0f}"))
    share = np.array(SHARES) / sum(SHARES)
    return [
        f"`python -m benchmarks.circles` (commits {commits_of(rows)}): a point draws "
        f"circles of {len(RADII)} radii, {', '.join(f'{s:.0%}' for s in share)} of the "
        f"demonstrations, labels on {LABELLED:.1%} of the steps. A seed each; the "
        "prior is off by a total variation (best order where nothing is labelled), the "
        "path by its mean distance from a demonstration at the same time.",
        markdown_table(
            (
                *("form", "without", "seeds", "NMI (best 1)", "ENT (best 0) [nat]"),
                *("prior off by", "path off by [m]", "seconds, one core"),
            ),
            lines,
        ),
    ]


SECTIONS = (Section("### Its toy: circles", "circles.jsonl", "circles", _shown),)


if __name__ == "__main__":
    main(Config, run, name="benchmarks.circles")

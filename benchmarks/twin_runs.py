"""Policies in a twin (`benchmarks.twin`, no hardware), and what is recorded there."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.twin import Twin
from easi_jax.data.recording import Run
from easi_jax.data.segments import Segments
from easi_jax.model.joint_space import Configuration
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.simulation.env import EnvState


@dataclass(frozen=True, eq=False)
class Recording:
    """``B`` episodes of up to ``T`` control steps; after its end an episode stands.

    Attributes:
        qpos, qvel: measured before the first step and after each, ``(B, T + 1, nq)``,
            ``(B, T + 1, nv)``.
        true_qpos, true_qvel: the same without sensors between.
        ctrl: commands, ``(B, T, nu)``.
        reward: of each step in the twin's true state, 0 beyond the end, ``(B, T)``.
        alive: True where the step counts, ``(B, T)``.
        dt: control step [s].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray
    ctrl: np.ndarray
    reward: np.ndarray
    alive: np.ndarray
    dt: float

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted, ``(B,)``."""
        return self.reward.sum(1)

    @property
    def steps(self) -> np.ndarray:
        """Control steps of each episode, ``(B,)``."""
        return self.alive.sum(1).astype(int)

    @property
    def fallen(self) -> np.ndarray:
        """Whether an episode ended before its time, ``(B,)``."""
        return self.steps < self.alive.shape[1]

    def segments(self) -> Segments:
        """Measured trajectories of single steps ``(B, T, 1, ...)``."""
        return Segments(
            qpos=jnp.asarray(self.qpos[:, :-1], jnp.float32),
            qvel=jnp.asarray(self.qvel[:, :-1], jnp.float32),
            ctrl=jnp.asarray(self.ctrl[:, :, None], jnp.float32),
            next_qpos=jnp.asarray(self.qpos[:, 1:, None], jnp.float32),
            next_qvel=jnp.asarray(self.qvel[:, 1:, None], jnp.float32),
            weight=jnp.asarray(self.alive, jnp.float32),
        )

    def runs(self, twin: Twin) -> list[Run]:
        """Each episode as a run of a log, for `easi_jax.io.logs.reader.write_log`."""
        found = []
        for i, steps in enumerate(self.steps):
            rows = slice(0, steps + 1)
            ctrl = self.ctrl[i, :steps]
            found.append(
                Run(
                    name=str(i),
                    source="twin",
                    dt=self.dt,
                    time=self.dt * np.arange(steps + 1),
                    qpos=self.qpos[i, rows],
                    qvel=self.qvel[i, rows],
                    qvel_measured=True,
                    ctrl=np.concatenate([ctrl, ctrl[-1:]]),  # of the last row: held
                    configuration=Configuration.of(twin.model),
                )
            )
        return found


def play(
    twin: Twin,
    policy: PolicyParams,
    seed: int,
    episodes: int,
    steps: int,
    deterministic: bool = True,
    start: Callable[[jax.Array], EnvState] | None = None,
) -> Recording:
    """Episodes of a policy in the twin.

    The policy sees the environment's own observation of the measured state; reward and
    end are the environment's own, of the true one.

    Args:
        seed: of starts, actions and sensors; the same for every policy.
        start: ``start(keys) -> states``, one for each of ``keys (episodes,)``; the
            environment's reset where not given.
    """
    env = twin.env
    begin = start or jax.vmap(lambda key: env.reset(env.model(), key))
    k_reset, k_act = jax.random.split(jax.random.key(seed))
    true = jax.jit(begin)(jax.random.split(k_reset, episodes))
    starts = zip(*map(np.asarray, (true.physics.qpos, true.physics.qvel)), strict=True)
    bodies = [twin.start(qpos, qvel) for qpos, qvel in starts]
    rngs = np.random.default_rng(seed).spawn(episodes)
    decide, arrive, look = _functions(env, deterministic)

    def states() -> _Rows:
        read = [twin.read(b, rng) for b, rng in zip(bodies, rngs, strict=True)]
        exact = [(b.data.qpos.copy(), b.data.qvel.copy()) for b in bodies]
        columns = [*zip(*read, strict=True), *zip(*exact, strict=True)]
        return _Rows(*map(np.stack, columns))

    row = states()
    seen = look(true, row.qpos, row.qvel)
    rows, alive = [row], np.ones(episodes, bool)
    done = []
    for key in jax.random.split(k_act, steps):
        action, ctrl = decide(policy, seen, key)
        for i in np.flatnonzero(alive):
            twin.advance(bodies[i], np.asarray(ctrl)[i])
        row = states()
        true = arrive(true, action, row.true_qpos, row.true_qvel)
        seen = arrive(seen, action, row.qpos, row.qvel)
        done.append((np.asarray(ctrl), np.where(alive, true.reward, 0.0), alive))
        rows.append(row)
        alive = alive & (np.asarray(true.terminated) == 0)
    measured = _Rows(*(np.stack(x, 1) for x in zip(*rows, strict=True)))
    ctrl, reward, counts = (np.stack(x, 1) for x in zip(*done, strict=True))
    return Recording(*measured, ctrl, reward, counts, env.dt)


def commanded(env: Any, forward: Any) -> Callable[[jax.Array], EnvState]:
    """Starts of the Go2 with these commands [m/s], one for each key."""

    def one(key: jax.Array, command: jax.Array) -> EnvState:
        state = env.reset(env.model(), key)
        return env.begun(state, jnp.array([1.0, 0.0, 0.0]) * command)

    return lambda keys: jax.vmap(one)(keys, jnp.asarray(forward, jnp.float32))


class _Rows(NamedTuple):
    qpos: np.ndarray
    qvel: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray


def _functions(env: Any, deterministic: bool) -> tuple[Any, Any, Any]:
    """What is computed at a row, over all episodes: commands, what a step led to, and
    what is seen of a first state."""

    @jax.jit
    def decide(policy: PolicyParams, seen: EnvState, key: jax.Array) -> Any:
        action = act(policy, seen.obs, key, deterministic)
        return action, jax.vmap(env.control)(seen, action)

    @jax.jit
    @jax.vmap
    def arrive(state: EnvState, action: Any, qpos: Any, qvel: Any) -> EnvState:
        """``env.step`` with the twin's state in place of a simulated one."""
        told = copy.copy(env)
        physics = env.simulator.start(qpos, qvel)
        told.simulator = SimpleNamespace(step=lambda *_: physics)
        return told.step(env.model(), state, action)

    @jax.jit
    @jax.vmap
    def look(state: EnvState, qpos: Any, qvel: Any) -> EnvState:
        physics = env.simulator.start(qpos, qvel)
        memory = () if state.memory == () else (state.memory,)
        return replace(state, physics=physics, obs=env.observe(physics, *memory))

    return decide, arrive, look

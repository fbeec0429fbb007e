"""What Table 2 and Fig. 7 measure, in twins (`benchmarks.twin`), not on hardware."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import welch

from benchmarks.twin_runs import commanded, play
from easi_jax.rl.networks import act
from easi_jax.simulation.rollout import policy_rollout
from envs.frames import matrix

EPISODES = 100  # of Table 2
COMMANDS = (0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6)  # m/s; training has up to 1 m/s
TRACKED = (4, 500, 100)  # episodes a command, their steps, steps until speed counts
JOINTS = ("hip", "thigh", "calf")
_WELCH = 200  # control steps of a piece: 0.25 Hz apart
_HIGHEST = 10.0  # Hz


def balancing(twin: Any, policy: Any, seed: int) -> dict[str, Any]:
    """Table 2's errors over `EPISODES` episodes of the policy's mode in the twin.

    Returns:
        ``angle_error`` [0.01 rad] and ``speed`` [0.1 m/s], mean sizes of the pole's
        angle and the cart's velocity over all steps, up to the fall where there is one;
        ``return``; ``fallen`` episodes.
    """
    got = play(twin, policy, seed, EPISODES, twin.env.episode_length)
    angle, speed = np.abs(got.true_qpos[:, 1:, 1]), np.abs(got.true_qvel[:, 1:, 0])
    return {
        "angle_error": float(angle[got.alive].mean() / 1e-2),
        "speed": float(speed[got.alive].mean() / 1e-1),
        "return": float(got.returns.mean()),
        "fallen": int(got.fallen.sum()),
    }


def tracking(twin: Any, policy: Any, seed: int) -> dict[str, Any]:
    """Fig. 7b: speed over forward commands, of the policy's mode in the twin.

    Returns:
        ``commands`` [m/s]; ``speed`` mean and ``speed_std`` over the episodes that did
        not fall, None where all did; ``fallen`` of each command's; ``tracking_error``,
        RMS over all that stood [m/s]; ``return`` of all episodes.
    """
    episodes, steps, settled = TRACKED
    commands = np.repeat(COMMANDS, episodes)
    start = commanded(twin.env, commands)
    got = play(twin, policy, seed, len(commands), steps, True, start)
    rotation = np.asarray(
        jax.vmap(jax.vmap(matrix))(jnp.asarray(got.true_qpos[..., 3:7]))
    )
    forward = np.einsum("btw,btw->bt", rotation[..., 0], got.true_qvel[..., :3])
    speed = forward[:, settled:].mean(1).reshape(-1, episodes)
    stood = ~got.fallen.reshape(-1, episodes)
    error = (speed - np.reshape(commands, speed.shape))[stood]
    each = [v[s] for v, s in zip(speed, stood, strict=True)]
    return {
        "commands": COMMANDS,
        "speed": [rounded(v.mean()) if len(v) else None for v in each],
        "speed_std": [rounded(v.std()) if len(v) else None for v in each],
        "fallen": (~stood).sum(1).tolist(),
        "tracking_error": rounded(np.sqrt(np.mean(error**2))) if error.size else None,
        "return": float(got.returns.mean()),
    }


def spectra(
    env: Any, policy: Any, seed: int, steps: int, logs: list[Any], theta: Any = None
) -> dict[str, Any]:
    """Fig. 7a: joint motion of one policy in the twin and in the simulation.

    Args:
        env: the simulation, with the command that the policy had in the twin.
        steps: how long it walks there.
        logs: its recordings in the twin, one walk each.
        theta: parameters of the simulation: EASI's mean after identification; nominal
            before, where not given.

    Returns:
        ``frequency`` [Hz]; for ``twin`` and ``simulation`` the amplitude density
        [rad / sqrt(Hz)] of each kind of joint, over four legs; ``distance_db``, RMS of
        their ratio; None where one fell too soon.
    """
    theta = env.space.nominal if theta is None else theta
    walked = jax.jit(
        lambda policy, theta, key: policy_rollout(
            env,
            env.model(theta),
            lambda obs, k: act(policy, obs, k, True),
            key,
            steps,
        )
    )(policy, jnp.asarray(theta, jnp.float32), jax.random.key(seed))
    frequency, twin = spectrum([log.qpos[0, : log.steps[0], 7:] for log in logs])
    alone = np.asarray(walked.qpos)[: int(walked.weight.sum()), 7:]
    _, simulated = spectrum([alone])
    distance = None
    if twin is not None and simulated is not None:
        ratio = 20 * np.log10(simulated / twin)
        distance = rounded(np.sqrt(np.mean(ratio**2)))

    def told(s: Any) -> Any:
        return None if s is None else dict(zip(JOINTS, rounded(s), strict=True))

    return {
        "frequency": rounded(frequency),
        "twin": told(twin),
        "simulation": told(simulated),
        "distance_db": distance,
    }


def spectrum(joints: list[Any]) -> tuple[Any, Any]:
    """Amplitude density by frequency and kind of joint (Welch, Hann windows of 4 s).

    Args:
        joints: angles of walks at 50 Hz, ``(T, 12)`` each; the first two seconds, and
            walks with nothing beyond one window after them, are left out.

    Returns:
        Frequencies ``(F,)`` [Hz]; ``(3, F)`` [rad / sqrt(Hz)], None without a walk.
    """
    frequency = np.fft.rfftfreq(_WELCH, 0.02)
    kept = (frequency > 0) & (frequency <= _HIGHEST)
    long = [q[100:] for q in joints if len(q) >= 100 + _WELCH]
    if not long:
        return frequency[kept], None
    power = [welch(q, 50.0, nperseg=_WELCH, axis=0)[1] for q in long]
    mean = np.average(power, axis=0, weights=[len(q) for q in long])
    kinds = mean[kept].reshape(-1, 4, len(JOINTS)).mean(1)
    return frequency[kept], np.sqrt(kinds.T)


def rounded(x: Any) -> Any:
    """Numbers, in lists of lists, with four digits."""
    if np.ndim(x):
        return [rounded(v) for v in x]
    return float(f"{float(x):.4g}")

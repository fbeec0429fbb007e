"""Logs as demonstrations: labels, windows, what is imitated, what is refused."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.errors import UserError
from easi_jax.io.logs.reader import write_log
from easi_jax.model.joint_space import Configuration
from easi_jax.rl.demonstrations import (
    demonstrations_of,
    read_demonstrations,
    style_of,
    windows_of,
)
from envs import make


@pytest.fixture(scope="module")
def cartpole() -> Any:
    return make("cartpole")


def runs_of(env: Any, names: list[str], rows: int = 120, dt: float = 0.0) -> list[Run]:
    rng, m = np.random.default_rng(0), env.mj_model
    dt = dt or env.dt
    time = dt * np.arange(rows)
    found = []
    for name in names:
        phase = rng.uniform(0, 6, m.nq)
        found.append(
            Run(
                name=name,
                source="",
                dt=dt,
                time=time,
                qpos=0.1 * np.sin(3 * time[:, None] + phase),
                qvel=0.3 * np.cos(3 * time[:, None] + phase),
                qvel_measured=True,
                ctrl=rng.standard_normal((rows, m.nu)),
                configuration=Configuration.of(m),
            )
        )
    return found


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_names_of_runs_are_labels(cartpole: Any, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"log.{ending}"
    runs = runs_of(cartpole, ["slow:1", "fast:1", "10:05:03", "slow:2/b"])
    write_log(path, cartpole.mj_model, runs)
    given = read_demonstrations(path, cartpole)
    assert given.skills == ("fast", "slow")
    assert [int(given.labels[given.episodes == k][0]) for k in range(4)] == [
        1,
        0,
        -1,
        1,
    ]
    q, v = runs[1].qpos, runs[1].qvel
    motion = np.concatenate([q, v], 1)
    np.testing.assert_allclose(
        given.windows[given.episodes == 1],
        np.concatenate([motion[:-1], motion[1:]], 1),
        atol=1e-5,
    )


def test_windows_of_state_and_command(cartpole: Any) -> None:
    (run,) = runs_of(cartpole, ["a"], 300)
    given = demonstrations_of(cartpole, [(run.qpos, run.qvel, run.ctrl)], [0], frames=1)
    np.testing.assert_allclose(given.windows[:, -1], run.ctrl[:-1, 0], atol=1e-6)
    assert given.windows.shape == (299, 2 * cartpole.mj_model.nq + 1)
    np.testing.assert_allclose(given.scaled(given.windows).std(0), 1.0, atol=1e-3)
    assert windows_of(jnp.ones((4, 2)), jnp.ones((4, 1)), 2).shape == (3, 4)


def test_a_share_of_labels_and_of_windows(cartpole: Any) -> None:
    runs = runs_of(cartpole, ["a", "b"], 401)
    given = demonstrations_of(
        cartpole, [(r.qpos, r.qvel, r.ctrl) for r in runs], [0, 1], ("a", "b")
    )
    for share, count in ((0.0, 0), (0.001, 1), (0.05, 20), (1.0, 400)):
        labels = given.labelled(share).labels
        assert [int((labels == k).sum()) for k in (0, 1)] == [count, count]
    some = given.some(100)
    assert len(some.windows) == len(some.labels) == len(some.episodes) == 100
    assert given.some(10_000) is given
    with pytest.raises(UserError, match="labelled is 2"):
        given.labelled(2.0)


@pytest.mark.parametrize("robot", ["go2", "ant"])
def test_what_is_imitated_knows_no_place_or_heading(robot: str) -> None:
    env = make(robot)
    style, rng = style_of(env), np.random.default_rng(1)
    qpos = env.mj_model.qpos0 + 0.05 * rng.standard_normal(env.mj_model.nq)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    qvel = rng.standard_normal(env.mj_model.nv)
    turn = 1.1
    there, fast = qpos.copy(), qvel.copy()
    there[:2] += [3.0, -4.0]
    w, x, y, z = qpos[3:7]
    c, s = np.cos(turn / 2), np.sin(turn / 2)
    there[3:7] = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    fast[:2] = rotation @ qvel[:2]
    one, other = jax.jit(jax.vmap(style))(
        np.stack([qpos, there]), np.stack([qvel, fast])
    )
    np.testing.assert_allclose(one, other, atol=1e-5)
    lower = qpos.copy()
    lower[2] -= 0.1
    assert (
        float(jnp.abs(style(jnp.asarray(lower), jnp.asarray(qvel)) - one).max()) > 0.05
    )


def test_of_a_go2_speed_over_ground_is_not_imitated() -> None:
    env = make("go2")
    qpos, qvel = env.mj_model.key_qpos[0], np.zeros(18)
    still = env.style(jnp.asarray(qpos), jnp.asarray(qvel))
    qvel[:2] = 1.0
    np.testing.assert_array_equal(
        still, env.style(jnp.asarray(qpos), jnp.asarray(qvel))
    )
    assert still.shape == (42,)


def test_demonstrations_that_cannot_be_imitated(cartpole: Any, tmp_path: Path) -> None:
    m = cartpole.mj_model
    path = tmp_path / "log.npz"
    write_log(path, m, runs_of(cartpole, ["a"], 50))
    with pytest.raises(UserError, match="49 steps: imitation needs at least 200"):
        read_demonstrations(path, cartpole)
    write_log(path, m, runs_of(cartpole, ["a"], 300, dt=0.5 * cartpole.dt))
    with pytest.raises(UserError, match=r"log has a control step of .* record"):
        read_demonstrations(path, cartpole)
    write_log(path, m, runs_of(cartpole, ["a"], 300))
    with pytest.raises(UserError, match=r"no column qpos.*\d+ more\): ballb"):
        read_demonstrations(path, make("ballbalance"))
    (run,) = runs_of(cartpole, ["a"], 30)
    q, v, u = (np.tile(x, (20, 1)) for x in (run.qpos, run.qvel, run.ctrl))
    with pytest.raises(UserError, match="repeats a single cycle: 30 different"):
        demonstrations_of(cartpole, [(q, v, u)], [-1])
    given = demonstrations_of(
        cartpole,
        [(r.qpos, r.qvel, r.ctrl) for r in runs_of(cartpole, ["a"], 300)],
        [0],
        ("trot",),
    )
    with pytest.raises(UserError, match=r'labelled "trto".*did you mean "?trot'):
        given.skill("trto")

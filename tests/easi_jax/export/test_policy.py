"""Exported policies are the policy: every robot, 10,000 observations."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest

from benchmarks.export import (
    by_jax,
    by_onnx,
    drawn_policy,
    observations,
    onnx_session,
)
from easi_jax.errors import UserError
from easi_jax.export.policy import from_onnx, interface_of, to_onnx, to_stablehlo
from easi_jax.rl.networks import act
from easi_jax.simulation.env import start
from envs import REGISTRY, load, make

ROOT = Path(__file__).parents[3]


def ran(content: bytes, obs: np.ndarray) -> dict[str, np.ndarray]:
    return by_onnx(onnx_session(content), obs)


@pytest.mark.parametrize("name", REGISTRY)
def test_onnx_is_the_policy(name: str) -> None:
    env = make(name)
    policy = drawn_policy(env)
    obs = observations(env, policy)
    got = ran(to_onnx(policy, interface_of(env), env.action_map), obs)
    want = by_jax(env, policy, obs)
    assert got.keys() == want.keys()
    for key, value in want.items():
        np.testing.assert_allclose(got[key], value, atol=1e-5, err_msg=key)
    assert np.ptp(want["action"], axis=0).min() > 0.1, "the policy does something"


def test_onnx_is_read_back() -> None:
    """The policy's mode, and its interface."""
    env = make("go2")
    policy, told = drawn_policy(env), interface_of(env)
    read, said = from_onnx(to_onnx(policy, told, env.action_map), "policy.onnx")
    assert said == told
    obs = observations(env, policy)[:50]
    want, got = (act(p, obs, deterministic=True) for p in (policy, read))
    np.testing.assert_allclose(got, want, atol=1e-6)


@pytest.mark.parametrize("content", [b"", b"not a policy", "another"])
def test_what_is_no_policy_of_ours_is_refused(content: bytes | str) -> None:
    if content == "another":
        x = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
        same = onnx.helper.make_node("Identity", ["x"], ["y"])
        y = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
        graph = onnx.helper.make_graph([same], "other", [x], [y])
        content = onnx.helper.make_model(graph).SerializeToString()
    with pytest.raises(UserError, match=r"^p.onnx is not a policy that train.export"):
        from_onnx(content, "p.onnx")  # type: ignore[arg-type]


def test_stablehlo_is_the_policy() -> None:
    env = make("cartpole")
    policy = drawn_policy(env, hidden=(32,))
    obs = observations(env, policy)
    program, text = to_stablehlo(policy, interface_of(env), env.action_map)
    exported = jax.export.deserialize(bytearray(program))
    assert {"cpu", "cuda", "tpu"} <= set(exported.platforms)
    assert "stablehlo" in text
    for part in (obs[:1], obs):
        got, want = exported.call(part), by_jax(env, policy, part)
        for key, value in want.items():
            np.testing.assert_allclose(got[key], value, atol=1e-5, err_msg=key)


@pytest.mark.parametrize("name", [*REGISTRY, "examples/my_robot/env.py"])
def test_action_map_is_the_environments_own_control(name: str) -> None:
    env = load(ROOT / name) if name.endswith(".py") else make(name)
    rng = np.random.default_rng(0)
    for _ in range(3):
        obs = jnp.asarray(rng.uniform(-1.0, 1.4, env.obs_size), jnp.float32)
        # Ballbalance remembers the targets that it observes last.
        state = start(None, obs, obs[-env.action_size :])
        action = jnp.asarray(rng.uniform(-1.3, 1.3, env.action_size), jnp.float32)
        ctrl = env.control(state, action)
        np.testing.assert_allclose(env.action_map(obs, action), ctrl, atol=1e-6)
    assert len(interface_of(env).ctrl) == len(ctrl) == env.mj_model.nu


@pytest.mark.parametrize("name", REGISTRY)
def test_every_observation_has_a_name_of_its_own(name: str) -> None:
    env = make(name)
    names = interface_of(env).observation
    assert len(set(names)) == env.obs_size
    assert not any(n.startswith("observation.") for n in names)


def test_named_joints_are_those_observed() -> None:
    """A joint that is turned moves the entry that bears its name, and no other."""
    for name in ("ant", "go2"):
        env = make(name)
        state = jax.jit(env.reset)(env.model(), jax.random.key(0))
        physics, memory, observe = state.physics, state.memory, jax.jit(env.observe)
        names = np.array(env.obs_names)
        before = np.asarray(observe(physics, memory))
        for j in range(1, env.mj_model.njnt):
            joint = env.mj_model.joint(j).name
            moved = physics.replace(qpos=physics.qpos.at[6 + j].add(0.01))
            change = np.asarray(observe(moved, memory)) != before
            assert names[change].tolist() == [f"{joint}.angle"]


def test_a_robot_without_an_action_map_exports_its_action() -> None:
    env = make("cartpole")
    policy = drawn_policy(env, hidden=(8,))
    got = ran(to_onnx(policy, interface_of(env)), observations(env, policy))
    assert list(got) == ["action"]


def test_the_example_loop_drives_a_robot(tmp_path: Path) -> None:
    """In a process that has neither jax nor this package."""
    env = make("cartpole")
    policy = drawn_policy(env, hidden=(16,))
    model = to_onnx(policy, interface_of(env), env.action_map)
    (tmp_path / "policy.onnx").write_bytes(model)
    onnx.checker.check_model(str(tmp_path / "policy.onnx"))
    (tmp_path / "robot.py").write_text(
        "import json, sys, time\n"
        "sent = open('sent.jsonl', 'w')\n"
        "def read():\n"
        "    return {'rate': 0.4, 'angle': 0.3, 'v': -0.2, 'x': 0.1, 'else': 1.0}\n"
        "def send(commands):\n"
        "    assert 'jax' not in sys.modules and 'easi_jax' not in sys.modules\n"
        "    print(json.dumps([time.monotonic(), commands]), file=sent, flush=True)\n"
    )
    loop = ROOT / "examples" / "onnx_policy" / "loop.py"
    subprocess.run(
        [sys.executable, str(loop), "policy.onnx", "robot.py", "6"],
        cwd=tmp_path,
        timeout=60,
        check=True,
    )
    rows = [json.loads(x) for x in (tmp_path / "sent.jsonl").read_text().splitlines()]
    obs = np.array([[0.1, -0.2, 0.3, 0.4]], np.float32)
    want = by_jax(env, policy, obs)["ctrl"][0]
    assert len(rows) == 6
    for _, commands in rows:
        assert list(commands) == ["cart"]
        np.testing.assert_allclose(commands["cart"], want[0], atol=1e-6)
    assert rows[-1][0] - rows[0][0] == pytest.approx(5 * env.dt, abs=0.05)

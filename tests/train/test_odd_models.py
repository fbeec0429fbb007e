"""Models that MJX cannot simulate: native MuJoCo runs them, or a line says why not."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.parity_models import feature_models
from easi_jax.io.logs.columns import log_columns
from easi_jax.io.logs.tables import write_table
from easi_jax.io.models.mjcf import read_mjcf
from tests.commands import command, read, refused
from train import easi, evaluate, parameters, udr

FEATURES = feature_models()
NUT = """<mujoco><extension><plugin plugin="mujoco.sdf.nut"><instance name="nut">
<config key="radius" value="0.26"/></instance></plugin></extension>
<asset><mesh name="nut"><plugin instance="nut"/></mesh></asset><worldbody>
<geom type="plane" size="1 1 1"/><body name="b" pos="0 0 0.3">
<joint name="f" type="slide" axis="0 0 1"/>
<geom type="sdf" mesh="nut"><plugin instance="nut"/></geom></body></worldbody></mujoco>
"""
# Of each: the model, and a number of it that may vary.
RUN = {
    "fluid": (FEATURES["fluid ellipsoid"], "body.upper.mass"),
    "flex": (FEATURES["flex cable"], "body.c_1.mass"),
    "plugin": (FEATURES["actuator plugin"], "body.upper.mass"),
    "sdf": (NUT, "body.b.mass"),
}
REFUSED = {
    "sleep": (FEATURES["flag sleep enabled"], "sleep"),
    "ipc": (FEATURES["flag ipc enabled"], "ipc"),
    "so3": (FEATURES["transmission so3"], "several commands"),
    "plugin": (
        FEATURES["actuator plugin"].replace("mujoco.pid", "acme.servo"),
        "acme.servo",
    ),
}
ENV = """import jax, jax.numpy as jnp
from pathlib import Path
from easi_jax.simulation.env import advance, start
from envs.robot import Robot, not_finite
from tests.tiny_robot.env import Tiny

def seen(p):
    return jnp.concatenate([p.qpos, p.qvel])

class Odd(Tiny):
    name = "odd"
    def __init__(self):
        Robot.__init__(self, {addresses!r}, Path({model!r}))
        m = self.mj_model
        self.obs_size, self.action_size = m.nq + m.nv, max(m.nu, 1)
        self.default_target = ()
    def reset(self, model, key):
        first = jnp.asarray(self.mj_model.qpos0)
        moving = 0.1 * jax.random.normal(key, (self.mj_model.nv,))
        physics = self.simulator.start(first, moving)
        return start(physics, seen(physics))
    def control(self, state, action):
        return action[: self.mj_model.nu]
    def step(self, model, state, action):
        p = self.advance_physics(model, state, action)
        reward = jnp.exp(-jnp.sum(p.qvel**2))
        failed = not_finite(p.qpos, p.qvel)
        return advance(state, p, seen(p), reward, failed, self.episode_length)

make = Odd
"""


def _files(folder: Path, text: str, address: str) -> tuple[str, ...]:
    """Options of a search in a log by MuJoCo C of 250 control steps."""
    model, table, log = (folder / n for n in ("m.xml", "p.yaml", "log.csv"))
    model.write_text(text)
    table.write_text(
        f"parameters:\n  - name: number\n    address: {address}\n"
        "    initial: [0.01, 1.0]\n    bounds: [0.00001, 1000.0]\n"
    )
    m = read_mjcf(model, tell=lambda _: None)
    d, columns = mujoco.MjData(m), log_columns(m)
    d.qvel[:] = 0.3
    rows = []
    for _ in range(250):
        rows.append([d.time, *d.qpos, *d.qvel, *d.ctrl])
        mujoco.mj_step(m, d, 4)
    names = ("time", *columns.qpos, *columns.qvel, *columns.ctrl)
    write_table(log, dict(zip(names, np.array(rows).T, strict=True)), None)
    return ("--model", str(model), "--parameters", str(table), "--data", str(log))


def _search(folder: Path, kind: str) -> None:
    out = folder / "out"
    small = ("--population", 8, "--generations", 2, "--set", "segments=8")
    command(easi, *_files(folder, *RUN[kind]), "--out", out, *small, "--no-refine")
    assert read(out / "engine.json")["engine"] == "mujoco"
    assert np.isfinite(read(out / "distribution.json")["seeds"]["0"]["mean"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUN)
def test_every_command_runs_what_mjx_lacks(kind: str, tmp_path: Path) -> None:
    _search(tmp_path, kind)
    model, found = tmp_path / "m.xml", tmp_path / "found.yaml"
    command(parameters, "--model", model, "--out", found)
    assert found.stat().st_size
    env, out = tmp_path / "env.py", tmp_path / "udr"
    addresses = {"number": RUN[kind][1]}
    env.write_text(ENV.format(model=str(model), addresses=addresses))
    command(udr, "--env", env, "--out", out, "--eval-episodes", 2)
    returns = tmp_path / "returns.json"
    command(
        *(evaluate, "--run", out, "--env", env, "--episodes", 2, "--out", returns),
    )
    assert np.isfinite(read(returns)["returns"]["0"]).all()


@pytest.mark.parametrize("kind", REFUSED)
def test_what_no_engine_simulates_is_one_line_in_every_command(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, named = REFUSED[kind]
    model, log, env = (tmp_path / n for n in ("m.xml", "log.csv", "env.py"))
    model.write_text(text)
    log.write_text("time\n0\n")
    env.write_text(ENV.format(model=str(model), addresses={}))
    out = ("--out", tmp_path / "out")
    table = ("--parameters", tmp_path / "p.yaml", "--data", log)
    assert named in refused(capsys, parameters, "--model", model, *out)
    assert named in refused(capsys, easi, "--model", model, *table, *out)
    assert named in refused(capsys, udr, "--env", env, *out)
    assert not (tmp_path / "out").exists()

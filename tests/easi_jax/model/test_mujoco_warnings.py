"""Warnings of MuJoCo go to whom they are meant for."""

from pathlib import Path

import mujoco
import numpy as np

from easi_jax.excite import play
from easi_jax.model.mujoco_warnings import warnings_to

_ROOT = Path(__file__).parents[3]


def test_handlers_nest() -> None:
    outer: list[str] = []
    inner: list[str] = []
    with warnings_to(outer.append):
        with warnings_to(inner.append), warnings_to():
            _warn()
        _warn()
    assert outer and not inner


def test_nobody_else_sets_the_handler() -> None:
    """What sets it to nothing afterwards floods the terminal of a command."""
    folders = ("easi_jax", "envs", "train", "benchmarks")
    sources = [p for f in folders for p in (_ROOT / f).rglob("*.py")]
    found = [p.name for p in sources if "set_mju_user_warning" in p.read_text()]
    assert found == ["mujoco_warnings.py"]


def test_a_motion_leaves_the_handler() -> None:
    xml = """<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body>
    </worldbody><actuator><motor joint="j"/></actuator></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    said: list[str] = []
    with warnings_to(said.append):
        play.play(m, np.zeros(1), np.zeros((5, 1)), 0.01)
        _warn()
    assert said


def _warn() -> None:
    xml = """<mujoco><option gravity="0 0 -1e200"/><worldbody><body><joint type="slide"
    axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    d = mujoco.MjData(m)
    d.qvel[:] = 1e30
    mujoco.mj_step(m, d)

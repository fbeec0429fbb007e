"""Files whose digests a run keeps."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from easi_jax.errors import UserError
from easi_jax.io.runs.folder import RunFolder
from train._inputs import files_of

_SCENE = '<mujoco><compiler meshdir="m"/><include file="{}"/></mujoco>'
_ROBOT = """<mujoco><asset><mesh name="s" file="tip.obj"/></asset><worldbody><body>
<joint name="j"/><geom type="mesh" mesh="s"/></body></worldbody></mujoco>"""


def test_all_that_is_read_is_told(tmp_path: Path) -> None:
    """What a model includes, its meshes, and results of earlier runs."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "m").mkdir()
    mesh, robot = tmp_path / "m" / "tip.obj", tmp_path / "parts" / "robot.xml"
    mesh.write_text("v 0 0 0")
    robot.write_text(_ROBOT)
    scene, udr = tmp_path / "scene.xml", tmp_path / "udr"
    scene.write_text(_SCENE.format("parts/robot.xml"))
    udr.mkdir()
    (udr / "results.json").write_text("{}")
    env, log, law = (tmp_path / name for name in ("env.py", "log.csv", "law.py"))
    config = SimpleNamespace(
        model=scene, allow_assets=(), data=(log,), effects_from=(law,), env=env
    )
    config.start_from, config.udr = udr, tmp_path  # logs need no run of train.udr
    own = [scene, env, log, law]
    assert {*files_of(config)} == {*own, mesh, robot, udr / "results.json"}


@pytest.mark.fault("a file that the model includes has changed before --resume")
def test_a_run_does_not_go_on_with_another_part_of_its_model(tmp_path: Path) -> None:
    robot, scene = tmp_path / "robot.xml", tmp_path / "scene.xml"
    robot.write_text(_ROBOT)
    scene.write_text(_SCENE.format("robot.xml"))
    config, out = SimpleNamespace(model=scene, allow_assets=()), tmp_path / "run"
    RunFolder.open(out, {}, files=files_of(config)).close()
    RunFolder.open(out, {}, files=files_of(config), resume=True).close()
    robot.write_text(_ROBOT.replace('"j"', '"k"'))
    with pytest.raises(UserError, match=r"robot\.xml has changed since"):
        RunFolder.open(out, {}, files=files_of(config), resume=True)

"""Frames, videos and strips of a robot's motion."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image, ImageSequence

from easi_jax.errors import UserError
from easi_jax.io.report.drawing import drawn
from easi_jax.io.report.video import render, strip, write_video
from envs.cartpole import Cartpole

MOTION = np.stack([np.linspace(-0.2, 0.2, 5), np.linspace(-0.5, 0.5, 5)], 1)


@pytest.fixture(scope="module", params=["MuJoCo", "drawn"])
def frames(cartpole: Cartpole, request: pytest.FixtureRequest) -> np.ndarray:
    told: list[str] = []
    if request.param == "drawn":
        return drawn(cartpole.mj_model, MOTION, 160, 120)
    frames = render(cartpole.mj_model, MOTION, 160, 120, tell=told.append)
    if told:
        pytest.skip(told[0])
    return frames


def test_frames_show_the_motion(frames: np.ndarray) -> None:
    assert frames.shape == (5, 120, 160, 3) and frames.dtype == np.uint8
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1


def test_the_ground_is_light(frames: np.ndarray) -> None:
    corners = frames[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    assert corners.min() > 230 and frames.min() < 150


def test_gif_holds_all_frames(frames: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.gif"
    write_video(path, frames, 20)
    with Image.open(path) as image:
        assert image.size == (160, 120) and len([*ImageSequence.Iterator(image)]) == 5
    assert [p.name for p in path.parent.iterdir()] == ["run.gif"]


def test_strip_holds_its_pictures(frames: np.ndarray) -> None:
    svg = strip(frames, 3)
    assert 'viewBox="0 0 480 120"' in svg and "data:image/jpeg;base64," in svg


def test_what_cannot_be_is_said(
    cartpole: Cartpole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = np.zeros((1, 4, 4, 3), np.uint8)
    with pytest.raises(UserError, match="ends in"):
        write_video(tmp_path / "run.avi", still, 10)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match="ffmpeg"):
        write_video(tmp_path / "run.mp4", still, 10)
    assert not list(tmp_path.iterdir())


def test_without_opengl_frames_are_drawn(
    cartpole: Cartpole, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    told: list[str] = []
    frames = render(cartpole.mj_model, MOTION, 160, 120, tell=told.append)
    np.testing.assert_array_equal(frames, drawn(cartpole.mj_model, MOTION, 160, 120))
    assert "EGL or OSMesa" in told[0] and "no_such_way" in told[0]


SHAPES = """<mujoco>
<asset>
  <mesh name="cone" vertex="0 0 .3  .2 .2 0  -.2 .2 0  -.2 -.2 0  .2 -.2 0"/>
</asset>
<worldbody>
  <camera name="above" pos="0 0 4" fovy="45"/>
  <geom type="plane" size="1 1 .1" rgba="1 1 1 1"/>
  <geom type="{kind}" pos="0 0 .5" size=".3 .2 .4" {more} rgba="1 0 0 1"/>
  <body><joint/><geom size=".01" group="4"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("kind", "area"),
    [
        ("sphere", np.pi * 0.3**2),
        ("ellipsoid", np.pi * 0.3 * 0.2),
        ("box", 4 * 0.3 * 0.2),
        ("capsule", np.pi * 0.3**2),
        ("cylinder", np.pi * 0.3**2),
        ("mesh", 0.4**2),
    ],
)
def test_shapes_cover_what_they_should(kind: str, area: float) -> None:
    """Seen from far above, in shares of the picture, by the pinhole's law."""
    more = 'mesh="cone"' if kind == "mesh" else ""
    m = mujoco.MjModel.from_xml_string(SHAPES.format(kind=kind, more=more))
    (frame,) = drawn(m, np.zeros((1, m.nq)), 200, 200)
    red = (frame[..., 0] > 120) & (frame[..., 1] < 60)
    # Where a shape is widest, from the eye.
    above = {"box": 0.9, "cylinder": 0.7, "capsule": 0.7, "mesh": 0.42}.get(kind, 0.5)
    wide = 2 * (4.0 - above) * np.tan(np.radians(22.5))
    assert red.mean() == pytest.approx(area / wide**2, rel=0.12)
    white = (frame.min(-1) > 225) & (frame.min(-1) < 249)
    floor = 4.0 / (8.0 * np.tan(np.radians(22.5))) ** 2
    assert white.mean() + red.mean() == pytest.approx(floor, rel=0.05)


def test_a_strip_breaks_into_rows() -> None:
    svg = strip(np.zeros((7, 4, 8, 3), np.uint8), 5)
    assert 'viewBox="0 0 24 8"' in svg

"""Frames, videos and strips of a robot's motion."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from easi_jax.errors import UserError
from easi_jax.io.report.video import render, strip, write_video
from envs.cartpole import Cartpole


@pytest.fixture(scope="module")
def frames(cartpole: Cartpole) -> np.ndarray:
    qpos = np.stack([np.linspace(-0.2, 0.2, 5), np.linspace(-0.5, 0.5, 5)], 1)
    try:
        return render(cartpole.mj_model, qpos, 160, 120)
    except UserError as error:
        pytest.skip(str(error))


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
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    with pytest.raises(UserError, match="EGL or OSMesa"):
        render(cartpole.mj_model, np.zeros((1, 2)))
    assert not list(tmp_path.iterdir())


def test_a_strip_breaks_into_rows() -> None:
    svg = strip(np.zeros((7, 4, 8, 3), np.uint8), 5)
    assert 'viewBox="0 0 24 8"' in svg

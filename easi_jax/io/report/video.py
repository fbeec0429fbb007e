"""Motion as pictures: frames by MuJoCo's renderer, GIF, MP4, a strip for reports."""

import base64
import contextlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from easi_jax.errors import UserError
from easi_jax.io.files import os_reason
from easi_jax.io.report.drawing import drawn

FRAMES = 6  # of a strip
_FPS = 25  # frames per second of a video, about
_ROW = 3
_INK = 40, 40, 40
_LIMIT = 300  # s
_WAYS = ("egl", "osmesa", "glfw")


def render(
    m: mujoco.MjModel,
    qpos: np.ndarray,
    width: int = 480,
    height: int = 320,
    limit: float = _LIMIT,
    tell: Callable[[str], None] = lambda _: None,
) -> np.ndarray:
    """Frames ``(T, height, width, 3)`` uint8 of positions ``qpos (T, nq)``.

    Through the model's first camera, or from outside where it has none. The way to
    OpenGL is ``MUJOCO_GL``'s, or the first of EGL, OSMesa and GLFW that works within
    ``limit`` seconds. Where none does, frames are plain drawings
    (`easi_jax.io.report.drawing`), and ``tell`` is told so.
    """
    ways = [os.environ["MUJOCO_GL"]] if os.environ.get("MUJOCO_GL") else _WAYS
    eye = m.camera(0).name if m.ncam else "-1"
    worker = Path(__file__).with_name("render_worker.py")
    reasons = []
    with tempfile.TemporaryDirectory() as folder:
        names = ("m.mjb", "q.npy", "frames.npy")
        files, size = [str(Path(folder) / n) for n in names], (str(width), str(height))
        mujoco.mj_saveModel(m, files[0])
        np.save(files[1], np.asarray(qpos, float))
        for way in ways:
            try:
                done = subprocess.run(
                    [sys.executable, "-I", str(worker), *files, *size, eye],
                    env={**os.environ, "MUJOCO_GL": way},
                    capture_output=True,
                    text=True,
                    timeout=limit,
                )
            except subprocess.TimeoutExpired:
                reasons.append(f"{way}: no picture within {limit:g} s")
                continue
            if done.returncode == 0:
                return np.load(files[2])
            last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            reasons.append(f"{way}: {last}")
    tell(
        "frames are plain drawings, for MuJoCo's renderer needs EGL or OSMesa (on "
        f"Debian: libegl1 or libosmesa6): {'; '.join(reasons)}"
    )
    return drawn(m, np.asarray(qpos, float), width, height)


def check_video(path: Path) -> None:
    """Raises UserError where `write_video` could not write ``path``: another ending
    than ``.gif``, ``.mp4`` and ``.svg``, or no ffmpeg for an MP4."""
    if path.suffix not in (".gif", ".mp4", ".svg"):
        raise UserError(f"{path}: a video ends in .gif or .mp4, a strip in .svg")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise UserError(f"{path}: an MP4 needs ffmpeg, which is not here; give .gif")


def write_video(path: Path, frames: np.ndarray, fps: float) -> None:
    """Writes ``frames (T, H, W, 3)`` as ``.gif``, as ``.mp4`` with ffmpeg, or a few of
    them as ``.svg`` (`strip`).

    Raises:
        UserError: see `check_video`; ffmpeg failed, or the file cannot be written;
            what was there before is kept.
    """
    check_video(path)
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _encode(path, part, frames, fps)
        part.replace(path)
    except OSError as error:
        raise UserError(
            f"cannot write {path}: {os_reason(error)}; free the disk or name another "
            "file"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _encode(path: Path, part: Path, frames: np.ndarray, fps: float) -> None:
    """Writes ``part``; ``path`` is named in messages."""
    if path.suffix == ".svg":
        part.write_text(strip(frames))
    elif path.suffix == ".gif":
        images = [Image.fromarray(f) for f in frames]
        images[0].save(
            part,
            save_all=True,
            append_images=images[1:],
            duration=max(20, round(1000 / fps)),
            loop=0,
        )
    else:
        height, width = frames.shape[1:3]
        wanted = ("-pix_fmt", "yuv420p")
        kind = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        try:
            done = subprocess.run(
                [
                    "ffmpeg",
                    "-y",
                    *kind,
                    "-r",
                    f"{fps:g}",
                    "-i",
                    "-",
                    *wanted,
                    str(part),
                ],
                input=np.ascontiguousarray(frames).tobytes(),
                capture_output=True,
                timeout=_LIMIT,
            )
        except subprocess.TimeoutExpired:
            raise UserError(f"{path}: ffmpeg took more than {_LIMIT} s") from None
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise UserError(f"{path}: ffmpeg failed: {said[-1] if said else ''}")


def side_by_side(
    path: Path,
    m: mujoco.MjModel,
    dt: float,
    motions: Sequence[tuple[str, np.ndarray]],
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Writes motions of one model beside each other, for as long as the shortest.

    Args:
        dt: time from row to row [s].
        motions: name and positions ``(T, nq)`` of each; a single one needs no name.

    Raises:
        UserError: see `write_video`.
    """
    skip = max(1, round(1 / (_FPS * dt)))
    rows = np.arange(0, min(len(motion) for _, motion in motions), skip)
    if path.suffix == ".svg":  # what a strip shows, for drawing takes time
        rows = rows[np.linspace(0, len(rows) - 1, FRAMES).round().astype(int)]
    parts = []
    for name, motion in motions:
        frames = render(m, motion[rows], tell=tell)
        parts.append(captioned(frames, name) if len(motions) > 1 else frames)
    write_video(path, np.concatenate(parts, 2), 1 / (skip * dt))


def captioned(frames: np.ndarray, text: str) -> np.ndarray:
    """``frames (T, H, W, 3)`` with a text at the top, on the left."""
    size = max(12, frames.shape[1] // 16)
    out = []
    for frame in frames:
        image = Image.fromarray(frame)
        ImageDraw.Draw(image).text(
            (size // 2, size // 2), text, fill=_INK, font=ImageFont.load_default(size)
        )
        out.append(np.asarray(image))
    return np.array(out, np.uint8)


def strip(frames: np.ndarray, count: int = FRAMES) -> str:
    """``count`` frames, three in a row, as SVG that holds its picture within itself."""
    chosen = frames[np.linspace(0, len(frames) - 1, count).round().astype(int)]
    rows = [chosen[i : i + _ROW] for i in range(0, count, _ROW)]
    blank = np.full_like(chosen[:1], 255)
    rows[-1] = np.concatenate([rows[-1], *[blank] * (min(_ROW, count) - len(rows[-1]))])
    wide = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    buffer = io.BytesIO()
    Image.fromarray(wide).save(buffer, "JPEG", quality=80)
    data = base64.b64encode(buffer.getvalue()).decode()
    height, width = wide.shape[:2]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">'
        f'<image width="{width}" height="{height}" '
        f'href="data:image/jpeg;base64,{data}"/></svg>'
    )

"""Draws positions of a model; a program of its own, run by `easi_jax.io.report.video`.

MuJoCo picks its way to OpenGL when it is imported, once and for all, and fails there
where it does not exist. Arguments: model (MJB), positions (NPY), frames to write (NPY),
width, height, camera (a name, or -1).
"""

import sys

import mujoco
import numpy as np


def draw(model: str, positions: str, out: str, width: str, height: str, eye: str):
    """Writes the frames ``(T, height, width, 3)``."""
    m = mujoco.MjModel.from_binary_path(model)
    d = mujoco.MjData(m)
    frames = []
    with mujoco.Renderer(m, int(height), int(width)) as renderer:
        for qpos in np.load(positions):
            d.qpos[:] = qpos
            mujoco.mj_forward(m, d)
            renderer.update_scene(d, -1 if eye == "-1" else eye)
            frames.append(renderer.render())
    np.save(out, np.array(frames, np.uint8))


if __name__ == "__main__":
    draw(*sys.argv[1:])

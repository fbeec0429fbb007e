"""Draws positions of a model; a program of its own, run by `easi_jax.io.report.video`.

MuJoCo picks its way to OpenGL when it is imported, once and for all, and fails there
where it does not exist. Arguments: model (MJB), positions (NPY), frames to write (NPY),
width, height, camera (a name, or -1).
"""

import sys

import mujoco
import numpy as np

# Shares of full brightness, chosen by eye: a page is white, and so is paper.
_BACKGROUND = 250  # of 255
_FLOOR = 0.97
_AMBIENT, _DIFFUSE = 0.65, 0.3  # of the light at the camera
_LAMPS = 0.3  # of what the model's own lamps give
_FINER = 2  # pixels drawn for one of the picture, each way: smooth edges


def lighten(m: mujoco.MjModel) -> None:
    """Light without a lamp's cone and a light floor, whatever the model's own are."""
    m.vis.headlight.active = 1
    m.vis.headlight.ambient[:] = _AMBIENT
    m.vis.headlight.diffuse[:] = _DIFFUSE
    m.light_diffuse[:] *= _LAMPS
    m.light_specular[:] = 0.0
    for plane in np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        material = m.geom_matid[plane]
        if material < 0:
            m.geom_rgba[plane, :3] = _FLOOR
            continue
        m.mat_rgba[material, :3] = _FLOOR
        m.mat_reflectance[material] = 0.0
        for texture in m.mat_texid[material][m.mat_texid[material] >= 0]:
            size = m.tex_height[texture] * m.tex_width[texture]
            begin = m.tex_adr[texture]
            data = m.tex_data[begin : begin + size * m.tex_nchannel[texture]]
            data[:] = 192 + data // 4  # its pattern shows what moves


def draw(model: str, positions: str, out: str, width: str, height: str, eye: str):
    """Writes the frames ``(T, height, width, 3)``."""
    m = mujoco.MjModel.from_binary_path(model)
    lighten(m)
    d = mujoco.MjData(m)
    size = _FINER * int(height), _FINER * int(width)
    m.vis.global_.offheight, m.vis.global_.offwidth = size
    m.vis.quality.offsamples = 0  # would mix the edges with MuJoCo's black ground
    frames = []
    with mujoco.Renderer(m, *size) as renderer:
        for qpos in np.load(positions):
            d.qpos[:] = qpos
            mujoco.mj_forward(m, d)
            renderer.update_scene(d, -1 if eye == "-1" else eye)
            frame = renderer.render().astype(float)
            renderer.enable_segmentation_rendering()
            frame[renderer.render()[..., 0] < 0] = _BACKGROUND
            renderer.disable_segmentation_rendering()
            blocks = frame.reshape(int(height), _FINER, int(width), _FINER, 3)
            frames.append(blocks.mean((1, 3)).round())
    np.save(out, np.array(frames, np.uint8))


if __name__ == "__main__":
    draw(*sys.argv[1:])

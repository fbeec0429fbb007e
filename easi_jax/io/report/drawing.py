"""Frames of a model without OpenGL: shaded faces, the nearest drawn last.

Plainer than MuJoCo's renderer: no shadows, textures or height fields, and faces that
cross each other are not cut.
"""

import math
from collections.abc import Iterator

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

_AROUND, _ALONG = 16, 6  # faces of what is round, about its axis and from pole to pole
_MOST = 2000  # faces of a mesh; of one with more its convex hull is drawn
_GROUPS = 3  # of geoms, that MuJoCo shows unless told otherwise
_NEAR = 0.01  # m in front of the eye
_TILES = 30  # of a floor, each way from what the eye looks at
_TILE = 12.0  # of them in the extent of the model
# Shares of full brightness, as `easi_jax.io.report.render_worker` has them.
_BACKGROUND, _FLOOR = 250 / 255, (0.97, 0.92)
_AMBIENT, _DIFFUSE = 0.65, 0.35
_DPI = 100
_SHAPES = mujoco.mjtGeom

Faces = np.ndarray  # corners of triangles or squares, ``(n, 3 or 4, 3)``


def drawn(m: mujoco.MjModel, qpos: np.ndarray, width: int, height: int) -> np.ndarray:
    """Frames ``(T, height, width, 3)`` uint8 of positions ``qpos (T, nq)``, through the
    model's first camera, or from outside where it has none."""
    d, shapes = mujoco.MjData(m), list(_shapes(m))
    frames = []
    for q in qpos:
        d.qpos[:] = q
        mujoco.mj_forward(m, d)
        frames.append(_frame(m, d, shapes, width, height))
    return np.array(frames, np.uint8)


def _frame(
    m: mujoco.MjModel,
    d: mujoco.MjData,
    shapes: list[tuple[int, Faces]],
    width: int,
    height: int,
) -> np.ndarray:
    eye, axes, fovy = _camera(m, d)
    scale = 1.0 / math.tan(math.radians(fovy) / 2.0)
    layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # flat, depth, color

    def add(corners: np.ndarray, color: np.ndarray) -> None:
        seen = (corners - eye) @ axes  # right, up, back
        ahead = -seen[..., 2]
        kept = (ahead > _NEAR).all(1)
        flat = scale * seen[kept, :, :2] / ahead[kept, :, None]
        layers.append((flat, ahead[kept].mean(1), color[kept]))

    for corners, color in _floors(m, d, eye, -axes[:, 2]):
        add(corners, color)
    ground = len(layers)
    for geom, faces in shapes:
        corners = faces @ d.geom_xmat[geom].reshape(3, 3).T + d.geom_xpos[geom]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        sight = eye - corners.mean(1)
        sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-12)
        facing = (normal * sight).sum(1)
        front = facing > 0
        light = _AMBIENT + _DIFFUSE * facing[front, None]
        add(corners[front], np.clip(_color(m, geom) * light, 0.0, 1.0))
    parts = [_sorted(layers[:ground]), _sorted(layers[ground:])]
    size = width / _DPI, height / _DPI
    figure = Figure(size, dpi=_DPI, facecolor=str(_BACKGROUND))
    canvas = FigureCanvasAgg(figure)
    page = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    page.set(xlim=(-width / height, width / height), ylim=(-1.0, 1.0))
    page.set_axis_off()
    for flat, color in parts:
        look = {"facecolors": color, "edgecolors": color, "linewidths": 0.3}
        page.add_collection(PolyCollection(flat, **look))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _sorted(
    layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[list[np.ndarray], np.ndarray]:
    """Faces and their colors, the farthest first."""
    flat = [face for faces, _, _ in layers for face in faces]
    depth = np.concatenate([np.zeros(0), *(x for _, x, _ in layers)])
    color = np.concatenate([np.zeros((0, 3)), *(x for _, _, x in layers)])
    order = np.argsort(-depth)
    return [flat[i] for i in order.tolist()], color[order]


def _camera(
    m: mujoco.MjModel, d: mujoco.MjData
) -> tuple[np.ndarray, np.ndarray, float]:
    """Where the eye is, its axes as columns (right, up, back), and its angle of view,
    from top to bottom [degree]."""
    if m.ncam:
        return d.cam_xpos[0], d.cam_xmat[0].reshape(3, 3), float(m.cam_fovy[0])
    free = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(m, free)
    a, e = math.radians(free.azimuth), math.radians(free.elevation)
    ahead = np.array(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
    )
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    axes = np.stack([right, np.cross(right, ahead), -ahead], 1)
    return free.lookat - free.distance * ahead, axes, float(m.vis.global_.fovy)


def _color(m: mujoco.MjModel, geom: int) -> np.ndarray:
    material = int(m.geom_matid[geom])
    own = m.geom_rgba[geom]
    plain = np.allclose(own, (0.5, 0.5, 0.5, 1.0))  # MuJoCo's, where none is given
    return (m.mat_rgba[material] if material >= 0 and plain else own)[:3]


def _floors(
    m: mujoco.MjModel, d: mujoco.MjData, eye: np.ndarray, ahead: np.ndarray
) -> Iterator[tuple[Faces, np.ndarray]]:
    """Tiles of each plane about where the eye looks at it, and their colors."""
    tile = float(m.stat.extent) / _TILE
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    for geom in np.flatnonzero(m.geom_type == _SHAPES.mjGEOM_PLANE).tolist():
        turn, center = d.geom_xmat[geom].reshape(3, 3), d.geom_xpos[geom]
        above, down = turn[:, 2] @ (eye - center), -turn[:, 2] @ ahead
        if above <= 0:
            continue
        far = min(above / max(down, 1e-3), 4.0 * m.stat.extent)
        middle = (eye + far * ahead - center) @ turn
        first = np.floor(middle[:2] / tile) - _TILES
        i, j = np.meshgrid(*(f + np.arange(2 * _TILES) for f in first), indexing="ij")
        low = np.stack([i, j, 0 * i], -1).reshape(-1, 1, 3)
        corners = tile * (low + square)
        half = np.where(m.geom_size[geom, :2] > 0, m.geom_size[geom, :2], np.inf)
        corners[..., :2] = np.clip(corners[..., :2], -half, half)
        inside = (np.ptp(corners[..., :2], axis=1) > 0).all(1)
        shade = np.array(_FLOOR)[(low.sum((1, 2)) % 2).astype(int)]
        yield corners[inside] @ turn.T + center, np.repeat(shade[inside, None], 3, 1)


def _shapes(m: mujoco.MjModel) -> Iterator[tuple[int, Faces]]:
    """Geoms that are shown, and their triangles in their own frames."""
    ball, ring = _ball(), _ball()[:_AROUND] * [1, 1, 0]
    corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    for geom in range(m.ngeom):
        if m.geom_group[geom] >= _GROUPS or m.geom_rgba[geom, 3] == 0:
            continue
        kind, size = int(m.geom_type[geom]), m.geom_size[geom]
        ends = np.array([[0, 0, size[1]], [0, 0, -size[1]]])[:, None]
        if kind == _SHAPES.mjGEOM_SPHERE:
            yield geom, _hull(ball * size[0])
        elif kind == _SHAPES.mjGEOM_ELLIPSOID:
            yield geom, _hull(ball * size)
        elif kind == _SHAPES.mjGEOM_CAPSULE:
            yield geom, _hull((ball * size[0] + ends).reshape(-1, 3))
        elif kind == _SHAPES.mjGEOM_CYLINDER:
            yield geom, _hull((ring * size[0] + ends).reshape(-1, 3))
        elif kind == _SHAPES.mjGEOM_BOX:
            yield geom, _hull(corners * size)
        elif kind == _SHAPES.mjGEOM_MESH:
            yield geom, _mesh(m, int(m.geom_dataid[geom]))


def _ball() -> np.ndarray:
    """Points on a sphere of radius 1, the equator's first, ``(n, 3)``."""
    around = 2 * np.pi * np.arange(_AROUND) / _AROUND
    up = np.pi / 2 * np.arange(_ALONG) / _ALONG
    rings = [
        np.stack([c * np.cos(around), c * np.sin(around), np.full(_AROUND, z)], 1)
        for c, z in zip(np.cos(up), np.sin(up), strict=True)
    ]
    half = np.concatenate([*rings, [[0.0, 0.0, 1.0]]])
    return np.concatenate([half, half[_AROUND:] * [1, 1, -1]])


def _hull(points: np.ndarray) -> Faces:
    """The convex hull of ``points (n, 3)``, its triangles seen counterclockwise."""
    found = ConvexHull(points, qhull_options="QJ")  # also of what is flat
    faces = points[found.simplices]
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    inward = (normal * found.equations[:, :3]).sum(1) < 0
    faces[inward] = faces[inward, ::-1]
    return faces


def _mesh(m: mujoco.MjModel, mesh: int) -> Faces:
    points = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]].astype(float)
    if m.mesh_facenum[mesh] > _MOST:
        return _hull(points)
    return points[m.mesh_face[m.mesh_faceadr[mesh] :][: m.mesh_facenum[mesh]]]

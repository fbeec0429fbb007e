"""A repaired model loads wherever it is written, with all files that it names."""

import dataclasses
import struct
import zlib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from easi_jax.export.mjcf import identified_model
from easi_jax.io.models.repaired_mjcf import Repaired, repaired_model
from easi_jax.model.found_effects import EffectEntry
from easi_jax.model.parameters import ParameterSpace, declare
from easi_jax.simulation.simulator import Simulator

FRICTION = EffectEntry("coulomb_friction", "j", "joint", {"coulomb": 0.05}, {})
MODEL = """<mujoco><compiler meshdir="shapes" texturedir="looks"/>
<include file="parts/arm.xml"/>
<asset><texture name="sky" type="skybox" fileright="r.png" fileleft="l.png"/></asset>
<worldbody><geom type="hfield" hfield="ground"/>
<body name="b" pos="0 0 3"><joint name="j" damping="0.1"/>
<geom type="mesh" mesh="one" material="painted"/>
<geom type="mesh" mesh="two" pos="0.1 0.2 0"/></body>
<body pos="1 0 3"><joint name="k"/><geom size="0.1"/>
<attach model="tool" body="tip" prefix="t_"/></body></worldbody>
<asset><model name="tool" file="tool/tool.xml"/></asset>
<actuator><motor name="a" joint="j"/></actuator></mujoco>"""
ARM = """<mujoco><asset><texture name="paint" type="2d" file="p.png"/>
<material name="painted" texture="paint"/>
<hfield name="ground" file="g.png" size="1 1 0.1 0.1"/>
<mesh name="one" file="a/body.obj"/><mesh name="two" file="b/body.obj"/></asset>
</mujoco>"""
TOOL = """<mujoco model="tool"><asset><mesh name="t" file="tip.obj"/></asset>
<worldbody><body name="tip"><geom type="mesh" mesh="t"/></body></worldbody></mujoco>"""


def tetrahedron(size: float) -> str:
    corners = ("0 0 0", f"{size} 0 0", f"0 {size} 0", "0 0 0.2")
    faces = ("1 3 2", "1 2 4", "1 4 3", "2 3 4")
    return "".join(f"v {c}\n" for c in corners) + "".join(f"f {f}\n" for f in faces)


def picture(gray: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    rows = b"".join(b"\0" + bytes([gray, 40 * i, gray] * 4) for i in range(4))
    head = struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    files = {
        "robot.xml": MODEL,
        "parts/arm.xml": ARM,
        "tool/tool.xml": TOOL,
        "tool/tip.obj": tetrahedron(0.1),
        "shapes/a/body.obj": tetrahedron(0.2),
        "shapes/b/body.obj": tetrahedron(0.3),
        "parts/g.png": picture(90),
        "parts/p.png": picture(100),
        "looks/p.png": picture(110),
        "looks/r.png": picture(120),
        "looks/l.png": picture(130),
    }
    for name, content in files.items():
        path = tmp_path / "robot" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = content if isinstance(content, bytes) else content.encode()
        path.write_bytes(data)
    return tmp_path / "robot" / "robot.xml"


def written(got: Repaired, folder: Path) -> mujoco.MjModel:
    for name, place in got.assets.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(place.read_bytes())
    (folder / "model.xml").write_text(got.xml)
    return mujoco.MjModel.from_xml_path(str(folder / "model.xml"))


def assert_same_files(got: mujoco.MjModel, want: mujoco.MjModel) -> None:
    for name in ("mesh_vert", "tex_data", "hfield_data", "geom_size", "body_mass"):
        a, b = getattr(got, name), getattr(want, name)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6, err_msg=name)


def test_with_effects(model: Path, tmp_path: Path) -> None:
    got = repaired_model(model, [FRICTION])
    want = mujoco.MjModel.from_xml_path(str(model))
    model.parent.rename(tmp_path / "elsewhere")
    moved = {
        n: tmp_path / "elsewhere" / p.relative_to(model.parent)
        for n, p in got.assets.items()
    }
    m = written(dataclasses.replace(got, assets=moved), tmp_path / "out")
    assert_same_files(m, want)
    assert len(got.assets) == 7
    assert m.joint("j").frictionloss[0] == pytest.approx(0.05)


def test_files_of_one_name_of_attached_models(tmp_path: Path) -> None:
    """Each is the one that MuJoCo read: of an attached model the name alone is left."""
    tip = TOOL.replace("<asset>", '<compiler meshdir="m"/><asset>')
    names = {"l": 0.1, "r": 0.3}
    for name, size in names.items():
        (tmp_path / name / "m").mkdir(parents=True)
        (tmp_path / name / "tool.xml").write_text(tip)
        (tmp_path / name / "m" / "tip.obj").write_text(tetrahedron(size))
    models = "".join(f'<model name="{n}" file="{n}/tool.xml"/>' for n in names)
    attached = "".join(
        f'<body pos="{k} 0 0"><joint/><attach model="{n}" body="tip" prefix="{n}_"/>'
        "</body>"
        for k, n in enumerate(names)
    )
    path = tmp_path / "robot.xml"
    path.write_text(
        f"<mujoco><asset>{models}</asset><worldbody>{attached}</worldbody></mujoco>"
    )
    got = repaired_model(path, [])
    assert got.left == [] and len(got.assets) == 2
    want = mujoco.MjModel.from_xml_path(str(path))
    assert_same_files(written(got, tmp_path / "out"), want)


SPRUNG = """<mujoco>{0}<worldbody><body name="b"><joint name="j" stiffness="2"
springref="{1}"/><geom size="0.1" mass="1" pos="0 0 1"/><body name="c" pos="0 0 1">
<joint name="k"/><geom size="0.1" mass="0.2" pos="0 0 1"/></body></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize(
    ("compiler", "ref"), [("", "30"), ('<compiler angle="radian"/>', "0.5235988")]
)
def test_springs_add_up_in_degrees_and_in_radians(
    compiler: str, ref: str, tmp_path: Path
) -> None:
    path = tmp_path / "m.xml"
    path.write_text(SPRUNG.format(compiler, ref))
    entries = [
        EffectEntry(
            "joint_stiffness", at, "joint", {"stiffness": k, "spring": torque}, {}
        )
        for at, k, torque in (("j", 1.0, -0.4), ("k", 0.25, 0.05))
    ]
    got = repaired_model(path, entries)
    m = mujoco.MjModel.from_xml_string(got.xml)
    assert not got.left
    np.testing.assert_allclose(m.jnt_stiffness, [3.0, 0.25])
    torque = 2 * np.pi / 6 - 0.4
    np.testing.assert_allclose(m.qpos_spring, [torque / 3, 0.2], rtol=1e-5)


def test_two_effects_at_one_body(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(SPRUNG.format("", "0"))
    load = EffectEntry("payload_mass", "c", "body", {"mass": 0.1, "spread": 1.0}, {})
    off = EffectEntry("com_offset", "c", "body", {"com.0": 0.05}, {})
    for entries in ([load, off], [off, load]):
        m = mujoco.MjModel.from_xml_string(repaired_model(path, entries).xml)
        assert m.body("c").mass[0] == pytest.approx(0.3)
        np.testing.assert_allclose(m.body("c").ipos, [0.05, 0.0, 1.0])
    m = mujoco.MjModel.from_xml_string(repaired_model(path, [off]).xml)
    assert m.body("c").mass[0] == pytest.approx(0.2)


def test_as_identified(model: Path, tmp_path: Path) -> None:
    m = mujoco.MjModel.from_xml_path(str(model))
    space = ParameterSpace((declare(m, "damping", "joint.j.damping"),))
    simulator = Simulator(m, space, 0.02)
    got = identified_model(model, simulator, np.array([0.15]), [FRICTION])
    new = written(got, tmp_path / "out")
    assert_same_files(new, m)
    assert new.joint("j").damping[0] == pytest.approx(0.15)
    assert new.joint("j").frictionloss[0] == pytest.approx(0.05)

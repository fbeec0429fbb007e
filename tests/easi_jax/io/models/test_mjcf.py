"""A model reads its own folder, and no other file."""

import os
import re
from pathlib import Path

import pytest

from benchmarks.fuzz_readers import tetrahedron
from easi_jax.errors import UserError
from easi_jax.io.models.mjcf import read_mjcf

BODY = '<worldbody><body><joint name="a"/><geom size=".1"/></body></worldbody>'
INCLUDE = '<include file="{}"/>'
MESH = '<asset><mesh name="m" file="{}"/></asset>' + BODY
TEXTURE = '<asset><texture name="t" type="cube" fileup="{}"/></asset>' + BODY


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A folder ``robot`` with parts, and ``elsewhere`` beside it."""
    part = f"<mujocoinclude>{BODY}</mujocoinclude>"
    nested = '<mujocoinclude><include file="{}"/></mujocoinclude>'
    for name in ("robot/sub", "robot/meshes", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("robot", "robot/sub", "elsewhere"):
        (tmp_path / name / "part.xml").write_text(part)
    for name in ("robot/meshes", "elsewhere"):
        (tmp_path / name / "t.stl").write_bytes(tetrahedron())
    folder = tmp_path / "robot"
    (folder / "near.xml").write_text(nested.format("sub/part.xml"))
    (folder / "sub/far.xml").write_text(nested.format("../../elsewhere/part.xml"))
    (folder / "sub/own.xml").write_text(nested.format("part.xml"))
    (folder / "link.xml").symlink_to("../elsewhere/part.xml")
    (folder / "linked").symlink_to("../elsewhere")
    (folder / "nowhere.xml").symlink_to("none.xml")
    attach = '<mujocoinclude><asset><model name="n" file="{}"/></asset></mujocoinclude>'
    (folder / "turn.xml").write_text(attach.format("sub/back.xml"))
    (folder / "sub/back.xml").write_text(attach.format("../turn.xml"))
    os.mkfifo(folder / "pipe.xml")
    return folder


def model(folder: Path, inside: str) -> Path:
    path = folder / "model.xml"
    path.write_text(f"<mujoco>{inside}</mujoco>")
    return path


@pytest.mark.parametrize(
    "inside",
    [
        BODY,
        INCLUDE.format("part.xml"),
        INCLUDE.format("sub/part.xml"),
        INCLUDE.format("sub/../part.xml"),
        INCLUDE.format("near.xml"),
        INCLUDE.format("sub/own.xml"),
        MESH.format("meshes/t.stl"),
        '<compiler meshdir="meshes"/>' + MESH.format("t.stl"),
        f'<!-- {INCLUDE.format("/etc/passwd")} "unclosed -->{BODY}',
    ],
)
def test_files_of_its_own_folder_are_read(robot: Path, inside: str) -> None:
    assert read_mjcf(model(robot, inside)).njnt == 1


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        (INCLUDE.format("../elsewhere/part.xml"), "../elsewhere/part.xml lies outside"),
        (INCLUDE.format("sub/../../elsewhere/part.xml"), "lies outside"),
        (INCLUDE.format("ROOT/elsewhere/part.xml"), "lies outside"),
        (INCLUDE.format("&#46;&#x2e;/elsewhere/part.xml"), "lies outside"),
        (INCLUDE.format("..\\elsewhere\\part.xml"), "lies outside"),
        (INCLUDE.format("link.xml"), "link.xml lies outside"),
        (INCLUDE.format("linked/part.xml"), "lies outside"),
        (INCLUDE.format("sub/far.xml"), "../../elsewhere/part.xml lies outside"),
        ('<option a=">"/>' + INCLUDE.format("link.xml"), "lies outside"),
        ("<include file = 'link.xml'></include>", "lies outside"),
        (INCLUDE.format("/dev/zero"), "/dev/zero lies outside"),
        (INCLUDE.format("nowhere.xml"), "leads nowhere"),
        (INCLUDE.format("pipe.xml"), "is no file"),
        (INCLUDE.format("sub"), "is no file"),
        (MESH.format("../elsewhere/t.stl"), "lies outside"),
        (MESH.format("ROOT/elsewhere/t.stl"), "lies outside"),
        ('<compiler meshdir="../elsewhere"/>' + MESH.format("t.stl"), "lies outside"),
        ('<compiler assetdir="ROOT/elsewhere"/>' + MESH.format("t.stl"), "outside"),
        (TEXTURE.format("/etc/passwd"), "/etc/passwd lies outside"),
        (f'<asset><model name="x" file="link.xml"/></asset>{BODY}', "lies outside"),
        ('<asset><model name="n" file="model.xml"/></asset>', "includes itself"),
        (INCLUDE.format("model.xml"), "model.xml includes itself"),
        (INCLUDE.format("turn.xml"), "includes itself"),
        (INCLUDE.format(""), "without a file name"),
        ("<" + "a" * 300_000 + "/>", "MuJoCo cannot read this model"),
        ("<!-- never closed", "not an XML text"),
        ('<a b="', "not an XML text"),
        ("\0", "not an XML text"),
        ("<worldbody><nothing/></worldbody>", "MuJoCo cannot read this model"),
    ],
)
@pytest.mark.timeout(60)
@pytest.mark.fault("models that read outside of their folder")
def test_other_files_are_not(robot: Path, inside: str, said: str) -> None:
    path = model(robot, inside.replace("ROOT", str(robot.parent)))
    with pytest.raises(UserError) as error:
        read_mjcf(path)
    assert said in str(error.value)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        ('<replicate count="3000000"><geom size=".1"/></replicate>', "3e+06 copies"),
        (
            '<replicate count="1000"><replicate count="1000"><geom size=".1"/>'
            "</replicate></replicate>",
            "1e+06 copies",
        ),
        ('<flexcomp name="f" count="2000 2000 2" type="grid"/>', "8e+06 copies"),
    ],
)
@pytest.mark.timeout(20)
@pytest.mark.fault("models that would fill the memory")
def test_huge_models_are_refused(robot: Path, inside: str, said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        read_mjcf(model(robot, f"<worldbody>{inside}</worldbody>"))


@pytest.mark.parametrize(
    "inside",
    [
        '<asset><texture name="t" type="2d" builtin="flat" width="99999" '
        f'height="99999"/></asset>{BODY}',
        f'<asset><hfield name="h" nrow="60000" ncol="60000"/></asset>{BODY}',
        f'<size nkey="500000000"/>{BODY}',
        f'<size nuser_body="1000000000"/>{BODY}',
        f'<replicate count="nan"/>{BODY}',
    ],
)
@pytest.mark.timeout(20)
@pytest.mark.fault("models that would fill the memory")
def test_huge_tables_are_refused(robot: Path, inside: str) -> None:
    with pytest.raises(UserError, match=r"model.xml: "):
        read_mjcf(model(robot, inside))


def test_replicates_beside_each_other_add_up(robot: Path) -> None:
    some = '<replicate count="9" offset="1 0 0"><geom size=".1"/></replicate>'
    path = model(robot, BODY + f"<worldbody>{some * 9}</worldbody>")
    assert read_mjcf(path).ngeom == 82


@pytest.mark.parametrize("allowed", ["elsewhere", "elsewhere/part.xml", "."])
def test_allowed_places_are_read(robot: Path, allowed: str) -> None:
    path = model(robot, INCLUDE.format("../elsewhere/part.xml"))
    assert read_mjcf(path, [robot.parent / allowed]).njnt == 1
    with pytest.raises(UserError, match="--allow-assets"):
        read_mjcf(path, [robot.parent / "elsewhere2"])


def test_no_model_file(robot: Path) -> None:
    for name in ("none.xml", "sub", "pipe.xml"):
        with pytest.raises(UserError, match="no such model file"):
            read_mjcf(robot / name)


@pytest.mark.fault("models that read outside of their folder")
def test_a_model_that_names_too_much_is_refused_at_once(robot: Path) -> None:
    many = "".join(f'<a file="{i}"/><b meshdir="{i}"/>' for i in range(400))
    with pytest.raises(UserError, match="too many files"):
        read_mjcf(model(robot, many + BODY))


def test_mujocos_warnings_leave_no_file(
    robot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (robot / "noend").write_bytes(tetrahedron())
    monkeypatch.chdir(robot.parent)
    before = sorted(robot.parent.iterdir())
    with pytest.raises(UserError, match="MuJoCo cannot read this model"):
        read_mjcf(model(robot, MESH.format("noend")))
    assert sorted(robot.parent.iterdir()) == before


def test_names_that_are_no_utf8(robot: Path) -> None:
    path = robot / "model.xml"
    path.write_bytes(f'<mujoco model="Pr\xfcfstand">{BODY}</mujoco>'.encode("latin-1"))
    with pytest.raises(UserError, match="save the file as UTF-8"):
        read_mjcf(path)


@pytest.mark.parametrize("step", ["0", "-0.002"])
def test_a_timestep_has_to_be_positive(robot: Path, step: str) -> None:
    path = model(robot, f'<option timestep="{step}"/>' + BODY)
    with pytest.raises(UserError, match="has to be positive"):
        read_mjcf(path)

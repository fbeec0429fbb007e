"""``train.import_logs``: recordings of every kind become logs, or one clear line."""

import errno
import json
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from easi_jax.data.recording import Run
from easi_jax.errors import UserError
from easi_jax.io.importers.minari import read_minari
from easi_jax.io.importers.streams import Selection
from easi_jax.io.logs.reader import read_logs
from tests.commands import command, refused
from tests.documented import ROOT
from tests.recordings import (
    MODEL,
    STEP,
    Ros,
    lerobot,
    minari,
    motion,
    pace,
    torch_zip,
    written_by_minari,
)
from train import import_logs

TIME, QPOS, QVEL, CTRL = motion()
NAMES = ("slider", "pole")
PACE = "joints: [slider, pole]\nactuators: {0: drive, 1: }\n"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "robot.xml"
    path.write_text(MODEL)
    return path


@pytest.fixture
def call(tmp_path: Path, model: Path) -> Callable[..., dict[str, Run]]:
    """Runs the command and reads its logs, by name."""

    def run(*args: object, mapping: str = "") -> dict[str, Run]:
        command(import_logs, *_arguments(tmp_path, model, args, mapping))
        paths = sorted((tmp_path / "logs").iterdir())
        mj_model = mujoco.MjModel.from_xml_path(str(model))
        return {path.stem: read_logs(path, mj_model).runs[0] for path in paths}

    return run


@pytest.fixture
def refuse(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """The line that ends the command, after which nothing is left behind."""

    def run(*args: object, mapping: str = "") -> str:
        arguments = _arguments(tmp_path, model, args, mapping)
        before = sorted(tmp_path.rglob("*"))
        line = refused(capsys, import_logs, *arguments)
        assert sorted(tmp_path.rglob("*")) == before
        return line

    return run


def _arguments(
    folder: Path, model: Path, args: tuple[object, ...], mapping: str
) -> list[object]:
    arguments = [*args, "--model", model, "--out", folder / "logs"]
    if mapping:
        (folder / "map.yaml").write_text(mapping)
        arguments += ["--mapping", folder / "map.yaml"]
    return arguments


def check(run: Run, ctrl: np.ndarray = CTRL, rtol: float = 1e-12) -> None:
    np.testing.assert_allclose(run.time, TIME, atol=1e-6)
    np.testing.assert_allclose(run.qpos, QPOS, rtol, atol=rtol)
    np.testing.assert_allclose(run.ctrl[:, 0], ctrl, rtol)


def bag(**changes: Any) -> Ros:
    """States with velocities, and commands sent with them."""
    ros = Ros()
    for i, at in enumerate(TIME):
        names = changes.get("names", NAMES)
        ros.joints(at, names, QPOS[i], QVEL[i], [CTRL[i], 0.0])
        ros.array(at + changes.get("late", 0.0), [CTRL[i]])
    return ros


ARRAY = "actuators: [drive]\n"


@pytest.mark.parametrize("kind", ["mcap folder", "sqlite folder", "mcap", "db3"])
def test_rosbag(tmp_path: Path, call: Any, kind: str) -> None:
    folder = bag().write(tmp_path / "walk", mcap="mcap" in kind)
    path = folder if "folder" in kind else next(folder.glob(f"walk*.{kind}"))
    (run,) = call(path, mapping=ARRAY).values()
    check(run)
    assert run.qvel_measured and run.name == "walk"
    np.testing.assert_allclose(run.qvel, QVEL)


def test_a_message_with_the_stamp_of_the_one_before_is_dropped(
    tmp_path: Path, call: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    ros = bag()
    ros.joints(TIME[-1], NAMES, [0.0, 0.0])
    (run,) = call(ros.write(tmp_path / "walk"), mapping=ARRAY).values()
    check(run)
    said = " ".join(capsys.readouterr().out.split())
    assert "repeats that of the row before: 1 (the first is row 31)" in said


def test_joint_names_order_units_and_sensor(tmp_path: Path, call: Any) -> None:
    ros = Ros()
    names = ["cart_slide", "pole_hinge", "gripper"]
    for i, at in enumerate(TIME):
        order = [1, 0, 2] if i % 2 else [2, 0, 1]
        values = np.array([QPOS[i, 0] * 1000, QPOS[i, 1], 7.0])
        effort = np.array([2.0 * i, 0, 0])
        ros.joints(at, [names[k] for k in order], values[order], effort=effort[order])
        ros.joints(at, ["cart_slide"], effort=[CTRL[i]], topic="/joint_command")
        ros.text(at, "hello")
    mapping = """
joints: {cart_slide: slider, pole_hinge: pole, gripper: }
columns: {/joint_states.effort.cart_slide: sensor.force}
scale: {"qpos.sl*": 0.001}
offset: {qpos.pole: 0.25}
"""
    path = ros.write(tmp_path / "walk")
    chosen = ("--state", "/joint_states", "--command", "/joint_command")
    (run,) = call(path, *chosen, mapping=mapping).values()
    np.testing.assert_allclose(run.qpos - [0, 0.25], QPOS, atol=1e-12)
    np.testing.assert_allclose(run.ctrl[:, 0], CTRL)
    np.testing.assert_allclose(run.sensors["force"][:, 0], 2.0 * np.arange(len(TIME)))
    assert not run.qvel_measured


def test_commands_are_held_at_the_times_of_the_states(
    tmp_path: Path, call: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bag(late=0.001).write(tmp_path / "walk")
    (run,) = call(path, mapping=ARRAY).values()
    told = capsys.readouterr().out
    # The first row comes before any command.
    np.testing.assert_allclose(run.time, TIME[1:], atol=1e-12)
    np.testing.assert_allclose(run.ctrl[:, 0], CTRL[:-1])
    np.testing.assert_allclose(run.qpos, QPOS[1:])
    assert "1 rows left out before its first message" in told
    assert "--command-slack 0.002" in told
    args = (path, "--command-slack", 0.002, "--overwrite")
    (run,) = call(*args, mapping=ARRAY).values()
    check(run)


def test_rare_commands_are_held_long(tmp_path: Path, call: Any) -> None:
    ros = Ros()
    for i, at in enumerate(TIME):
        ros.joints(at, NAMES, QPOS[i])
        if i % 10 == 0:
            ros.array(at, [CTRL[i]])
    (run,) = call(ros.write(tmp_path / "walk"), mapping=ARRAY).values()
    check(run, np.repeat(CTRL[::10], 10))


def test_two_topics_of_states_are_brought_to_the_rows_of_the_first(
    tmp_path: Path, call: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    ros = Ros()
    fine = np.arange(0.0, 0.3, 0.004)
    for i, at in enumerate(TIME):
        ros.joints(at, ["slider"], [QPOS[i, 0]], topic="/base")
        ros.array(at, [CTRL[i]])
    for at in fine:
        if not 0.1 < at < 0.15:
            # a hinge without limits, that its driver wraps
            turned = (50 * at + np.pi) % (2 * np.pi) - np.pi
            ros.joints(at, ["pole"], [turned], topic="/arm")
    path = ros.write(tmp_path / "walk")
    command(
        import_logs,
        *_arguments(
            tmp_path,
            tmp_path / "robot.xml",
            (path, "--state", "/base", "/arm", "--format", "parquet"),
            ARRAY,
        ),
    )
    assert "where it pauses: /arm.position" in capsys.readouterr().out
    mj_model = mujoco.MjModel.from_xml_string(MODEL)
    runs = read_logs(tmp_path / "logs" / "walk.parquet", mj_model).runs
    assert len(runs) == 2
    for run in runs:
        moved = run.qpos[:, 1] - 50 * run.time
        np.testing.assert_allclose(moved - moved[0], 0.0, atol=1e-9)
    # The first that is named, whichever joint the model has first.
    again = (path, "--state", "/arm", "/base", "--format", "parquet", "--overwrite")
    command(import_logs, *_arguments(tmp_path, tmp_path / "robot.xml", again, ARRAY))
    runs = read_logs(tmp_path / "logs" / "walk.parquet", mj_model).runs
    assert runs[0].dt == pytest.approx(0.004)


def test_clock_of_the_headers(tmp_path: Path, call: Any, refuse: Any) -> None:
    ros = Ros()
    jitter = np.random.default_rng(0).uniform(0.0, 0.004, len(TIME))
    for i, at in enumerate(TIME):
        ros.joints(at + jitter[i], NAMES, QPOS[i], stamp=at)
        ros.joints(at + 0.005, ["slider"], [CTRL[i]], topic="/to", stamp=at)
    path = ros.write(tmp_path / "walk")
    args = (path, "--state", "/joint_states", "--command", "/to", "--clock", "header")
    (run,) = call(*args).values()
    check(run)
    path = bag().write(tmp_path / "run")
    line = refuse(path, "--clock", "header", mapping=ARRAY)
    assert "messages of /commands have no header" in line
    ros = Ros()
    ros.joints(0.0, NAMES, QPOS[0], stamp=-1)
    ros.array(0.0, [0.0])
    line = refuse(ros.write(tmp_path / "jump"), "--clock", "header")
    assert "message 1 of /joint_states has no time in its header" in line


def test_trajectory_points(tmp_path: Path, call: Any) -> None:
    ros = Ros()
    for i, at in enumerate(TIME):
        ros.joints(at, NAMES, QPOS[i])
        ros.point(at, positions=[CTRL[i]])
        if i % 10 == 0:
            # the points beyond the tenth are replaced by the next message
            points = [
                {"positions": [CTRL[i] + 0.1 * k], "after": STEP * k} for k in range(15)
            ]
            ros.trajectory(at, ["slider"], points)
    path = ros.write(tmp_path / "walk")
    (run,) = call(path, "--command", "/point", mapping=ARRAY).values()
    check(run)
    (run,) = call(path, "--command", "/trajectory", "--overwrite").values()
    check(run)


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_lerobot(tmp_path: Path, call: Any, version: str) -> None:
    runs = call(lerobot(tmp_path / "pusht", version))
    assert list(runs) == ["pusht_000000", "pusht_000001"]
    for episode, run in enumerate(runs.values()):
        check(run, CTRL + episode, rtol=1e-6)


def test_lerobot_episode_without_names(tmp_path: Path, call: Any) -> None:
    path = lerobot(tmp_path / "pusht", episodes=3, names=None)
    runs = call(path, "--episodes", 1, mapping="joints: [slider, pole]\n")
    assert list(runs) == ["pusht_000001"]
    check(runs["pusht_000001"], CTRL + 1, rtol=1e-6)


WRITER = "LEROBOT_PYTHON"


@pytest.mark.skipif(WRITER not in os.environ, reason=f"{WRITER} names no Python")
def test_lerobot_written_by_lerobot(tmp_path: Path, call: Any) -> None:
    actions = np.stack([CTRL, CTRL + 1])[..., None]
    states = np.stack([QPOS, QPOS])
    episodes = tmp_path / "episodes.npz"
    np.savez(episodes, state=np.float32(states), action=np.float32(actions))
    folder = tmp_path / "cart"
    script = ROOT / "tests" / "lerobot_writer.py"
    subprocess.run(
        [os.environ[WRITER], script, episodes, folder, str(round(1 / STEP))],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf")},
        check=True,
        timeout=300,
    )
    runs = call(folder)
    assert list(runs) == ["cart_000000", "cart_000001"]
    for episode, run in enumerate(runs.values()):
        check(run, CTRL + episode, rtol=1e-6)


MINARI = """
actuators: [drive]
columns:
  observations.0: qpos.slider
  observations.1: qpos.pole
  observations.2: qvel.slider
  observations.3: qvel.pole
"""


def test_minari(tmp_path: Path, call: Any) -> None:
    folder = minari(tmp_path / "cart-v0", rows=len(TIME) - 1)
    runs = call(folder, "--step", STEP, mapping=MINARI)
    assert list(runs) == ["cart-v0_000000", "cart-v0_000001"]
    for run in runs.values():
        # no action follows the last observation
        check(run, np.append(CTRL[:-1], CTRL[-2]))
        np.testing.assert_allclose(run.qvel, QVEL)
    file = folder / "data" / "main_data.hdf5"
    one = call(
        *(file, "--step", STEP, "--episodes", 1, "--overwrite", "--format", "npz"),
        mapping=MINARI + "  infos.force.0: sensor.force\n",
    )
    assert "cart-v0" in one
    np.testing.assert_allclose(one["cart-v0"].sensors["force"][:, 0], range(len(TIME)))


@pytest.mark.filterwarnings("ignore::UserWarning:minari.*")
def test_minari_written_by_minari(
    tmp_path: Path, call: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari", reason="minari is not installed (extra dev)")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    written_by_minari("rig/cart-v0", episodes=2)
    runs = call(tmp_path / "rig" / "cart-v0", "--step", STEP, mapping=MINARI)
    assert list(runs) == ["cart-v0_000000", "cart-v0_000001"]
    for episode, run in enumerate(runs.values()):
        ctrl = CTRL + episode
        check(run, np.append(ctrl[:-1], ctrl[-2]))
        np.testing.assert_allclose(run.qvel, QVEL)


def test_pace(tmp_path: Path, call: Any) -> None:
    path = torch_zip(tmp_path / "chirp_data.pt", pace())
    check(call(path, mapping=PACE)["chirp_data"], rtol=1e-6)


def test_pace_written_by_torch(tmp_path: Path, call: Any) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed (extra peers)")
    tensors: dict[str, Any] = {k: torch.tensor(v) for k, v in pace().items()}
    # strided views of a larger storage, as slices of a buffer are saved
    wide = torch.zeros(2, 3, len(TIME) + 4)
    wide[1, :2, 4:] = tensors["dof_pos"].T
    tensors["dof_pos"] = wide[1, :2, 4:].T
    tensors |= {"note": "chirp", "rate": 100, "gains": [1.0, 2.0], "none": None}
    path = tmp_path / "chirp_data.pt"
    torch.save(tensors, path)
    check(call(path, mapping=PACE)["chirp_data"], rtol=1e-6)


class _Evil:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


@pytest.mark.fault("pickles and damaged archives")
def test_a_malicious_pickle_does_not_run(tmp_path: Path, refuse: Any) -> None:
    trap = tmp_path / "executed"
    for protocol in (0, 2, 4, 5):
        program = pickle.dumps({"time": _Evil(trap)}, protocol)
        path = torch_zip(tmp_path / f"evil{protocol}.pt", pace(), program)
        line = refuse(path)
        assert "refused: its pickle" in line and "nothing is executed" in line
        assert not trap.exists()
    pickle.loads(pickle.dumps(_Evil(trap)))  # the trap does work
    assert trap.exists()


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (b"\x80\x02cbuiltins\neval\n.", "asks for builtins.eval"),
        (b"\x80\x02ctorch._utils\n_rebuild_parameter\n.", "_rebuild_parameter"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93.", "asks for os.system"),
        (b"\x80\x02c\x1b[31m\nred\n.", r"asks for \x1b[31m.red"),
        (b"\x80\x02(ios\nsystem\n.", "uses INST"),
        (b"\x80\x02}}b.", "uses BUILD"),
        (b"\x80\x02ccollections\nOrderedDict\n)\x81.", "uses NEWOBJ"),
        (b"\x80\x02\x82\x01.", "uses EXT1"),
        (b"\x80\x02ctorch\nFloatStorage\n)R.", "makes no tensor"),
        (b"\x80\x02K\x05.", "holds a int"),
        (b"\x80\x02h\x07.", "damaged or cut short"),
        (b"\x80\x02}(u", "damaged or cut short"),
        (b"no pickle", "damaged or cut short"),
    ],
)
@pytest.mark.fault("pickles and damaged archives")
def test_other_pickles_are_refused(
    tmp_path: Path, refuse: Any, program: bytes, words: str
) -> None:
    assert words in refuse(torch_zip(tmp_path / "a.pt", {}, program))


def test_broken_torch_files(tmp_path: Path, refuse: Any) -> None:
    path = tmp_path / "a.pt"
    path.write_bytes(pickle.dumps([1, 2]))
    assert "not a file of torch.save" in refuse(path)
    whole = torch_zip(tmp_path / "b.pt", pace())
    for name, size in (("archive/data/1", 8), ("archive/data/1", 10**6)):
        with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
            for entry in old.namelist():
                content = old.read(entry)
                new.writestr(entry, bytes(size) if entry == name else content)
        assert str(path) in refuse(path)
    deflated = zipfile.ZIP_DEFLATED
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w", deflated) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    assert "compressed" in refuse(path)
    rng = np.random.default_rng(0)
    raw = whole.read_bytes()
    for _ in range(20):
        at = int(rng.integers(len(raw)))
        path.write_bytes(raw[:at])
        refuse(path)


def test_tensors_stay_inside_their_storage(tmp_path: Path, refuse: Any) -> None:
    values = np.zeros(4)
    path = torch_zip(tmp_path / "a.pt", {})
    whole = torch_zip(tmp_path / "b.pt", {"time": values})
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.namelist():
            raw = old.read(entry)
            if entry.endswith("pkl"):
                far = raw.replace(b"(J\x01\x00\x00\x00t", b"(J\x0a\x00\x00\x00t")
                assert far != raw
                raw = far
            new.writestr(entry, raw)
    assert "reaches beyond its storage" in refuse(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time": None}, 'no tensor "time"'),
        ({"dof_pos": None, "dof_posn": QPOS}, 'did you mean "dof_posn"?'),
        ({"time": TIME[:-1]}, "dof_pos has 30 rows where its time has 29"),
        ({"time": np.append(TIME[:-1], 0.1)}, "goes back or stands still from row 29"),
        (
            {"time": np.append(TIME[:-1], np.nan)},
            "the time of dof_pos is nan in row 30",
        ),
        ({"dof_pos": QPOS[:, :, None]}, "dof_pos is 30x2x1, not rows by joints"),
        ({"time": 1000 * TIME}, "wrong rate"),
        ({"dof_pos": QPOS[:0]}, "dof_pos is empty"),
    ],
)
def test_wrong_pace_recordings(
    tmp_path: Path, refuse: Any, changes: dict[str, Any], words: str
) -> None:
    tensors = {k: v for k, v in {**pace(), **changes}.items() if v is not None}
    path = torch_zip(tmp_path / "chirp_data.pt", tensors)
    line = refuse(path, mapping=PACE)
    assert words in line


def test_milliseconds_are_scaled(tmp_path: Path, call: Any) -> None:
    path = torch_zip(tmp_path / "chirp_data.pt", {**pace(), "time": 1000 * TIME})
    check(call(path, mapping=PACE + "scale: {time: 1e-3}")["chirp_data"], rtol=1e-6)


def test_non_finite_values(
    tmp_path: Path, call: Any, refuse: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    tensors = pace()
    tensors["dof_pos"][12, 1] = np.nan
    path = torch_zip(tmp_path / "chirp_data.pt", tensors)
    line = refuse(path, mapping=PACE)
    assert "dof_pos.1 is nan in row 13 (1 of 30 rows); --allow-nan" in line
    run = call(path, "--allow-nan", mapping=PACE)["chirp_data"]
    assert len(run) == 12 and "1 of 30 rows dropped" in capsys.readouterr().out
    tensors["dof_pos"][12, 1] = 0.0
    tensors["des_dof_pos"][3, 0] = np.inf
    path = torch_zip(tmp_path / "chirp_data.pt", tensors)
    assert "des_dof_pos.0 is inf in row 4" in refuse(path, "--overwrite", mapping=PACE)


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ("", 'say whose they are, in order, by "joints: [...]"'),
        ("joints: [slider, pol]", 'the model has no joint "pol"; did you mean "pole"?'),
        ("joints: [slider, pole]", 'no actuator for "pole" of des_dof_pos'),
        ("joints: [slider, ]", "dof_pos has 2 entries without names"),
        ("joints: {0: slider, 1: }", 'nothing gives "qpos.pole"'),
        ("joints: [slider, slider]", "both become qpos.slider; leave one out"),
        ("joint: [slider]", 'unknown key "joint"; did you mean "joints"?'),
        ("joints: {a: slider}", 'joints name "a" is not in'),
        ("joints: 3", '"joints:" must hold'),
        ("joints: {0: [slider]}", 'joints of "0" is not a name'),
        ("columns: {dof_poss.0: qpos.slider}", 'did you mean "dof_pos.0"?'),
        (PACE + "columns: {dof_pos.0: qpos.slidr}", 'did you mean "qpos.slider"?'),
        (PACE + "scale: {qpos.pole: 0}", 'scale of "qpos.pole" is zero'),
        (PACE + "scale: {qpos.pole: x}", "'x', not a number"),
        (PACE + "quaternions: {pole: xyzw}", 'quaternions of "pole", which has none'),
        (
            PACE + "scale: {qpos.pola: 2}",
            'did you mean "qpos.pole"?',
        ),
        (
            PACE + 'scale: {"q*": 2, "qp*": 2}',
            'scale of "qpos.slider" is given by "q*" and "qp*"',
        ),
        ("actuators: [drove]\njoints: [slider, pole]", 'did you mean "drive"?'),
    ],
)
def test_wrong_mappings(tmp_path: Path, refuse: Any, mapping: str, words: str) -> None:
    path = torch_zip(tmp_path / "chirp_data.pt", pace())
    assert words in refuse(path, mapping=mapping)


def test_a_joint_without_a_sensor(
    tmp_path: Path, model: Path, refuse: Any, capsys: Any
) -> None:
    path = torch_zip(tmp_path / "chirp_data.pt", pace())
    mapping = "joints: {0: slider, 1: }"
    assert "if joint pole has no sensor" in refuse(path, mapping=mapping)
    given = path, "--unmeasured", "pole"
    command(import_logs, *_arguments(tmp_path, model, given, mapping))
    assert "pole (--unmeasured)" in capsys.readouterr().out
    log = tmp_path / "logs" / "chirp_data.csv"
    assert log.read_text().startswith("time,qpos.slider,ctrl.drive")


def test_topics(tmp_path: Path, refuse: Any) -> None:
    ros = bag()
    ros.text(0.0, "hello")
    path = ros.write(tmp_path / "walk")
    assert 'did you mean "/joint_states"?' in refuse(path, "--state", "/joint_state")
    line = refuse(path, "--command", "/chatter")
    assert "--command /chatter is of type std_msgs/msg/String" in line
    ros.array(0.0, [1.0], topic="/other")
    path = ros.write(tmp_path / "two")
    assert "2 topics could be --command: /commands, /other" in refuse(path)
    ros = Ros()
    ros.text(0.0, "hello")
    line = refuse(ros.write(tmp_path / "none"))
    assert "no topic for --state" in line and "/chatter [std_msgs/msg/String]" in line
    assert "no episodes" in refuse(path, "--episodes", 0)


def test_the_field_of_a_command(tmp_path: Path, call: Any, refuse: Any) -> None:
    ros = Ros()
    for i, at in enumerate(TIME):
        ros.joints(at, NAMES, QPOS[i])
        ros.joints(at, ["drive"], [9.0], effort=[CTRL[i]], topic="/to")
    chosen = ("--state", "/joint_states", "--command", "/to", "--command-field")
    path = ros.write(tmp_path / "walk")
    check(call(path, *chosen, "effort")["walk"])
    line = refuse(path, *chosen, "velocity", "--overwrite")
    assert "message 1 of /to has 1 names and 0 values" in line


@pytest.mark.parametrize("package", ["rosbags", "h5py"])
def test_a_package_that_is_not_installed(
    tmp_path: Path, refuse: Any, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    paths = {"rosbags": bag().write(tmp_path / "a"), "h5py": minari(tmp_path / "b")}
    # the module that is imported from, which earlier tests have loaded
    module = {"rosbags": "rosbags.rosbag2", "h5py": "h5py"}[package]
    monkeypatch.setitem(sys.modules, module, None)
    line = refuse(paths[package], "--step", STEP)
    assert f"needs the package {package}" in line and "easi-jax[import]" in line


def test_joints_that_the_model_lacks(tmp_path: Path, refuse: Any) -> None:
    path = bag(names=("slider", "polle")).write(tmp_path / "walk")
    line = refuse(path, mapping=ARRAY)
    assert 'the model has no joint "polle"' in line and 'did you mean "pole"?' in line


def _lengths(ros: Ros) -> None:
    ros.joints(0.3, NAMES, [1.0])


def _lengths_of_velocity(ros: Ros) -> None:
    ros.joints(0.3, NAMES, [1.0, 2.0], [1.0, 2.0, 3.0])


def _names_twice(ros: Ros) -> None:
    ros.joints(0.3, ["pole", "pole"], [1.0, 2.0])


def _other_joints(ros: Ros) -> None:
    ros.joints(0.3, ["pole"], [1.0])


def _command_width(ros: Ros) -> None:
    ros.array(0.3, [1.0, 2.0])


def _not_a_number(ros: Ros) -> None:
    ros.joints(0.3, NAMES, [0.0, np.nan])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_lengths, "message 31 of /joint_states has 2 names and 1 values of position"),
        (_lengths_of_velocity, "2 names and 3 values of velocity"),
        (_names_twice, "message 31 of /joint_states names a joint twice"),
        (_other_joints, "is in messages that list different joints"),
        (_command_width, "has 2 values where the first has 1"),
        (_not_a_number, "/joint_states.position.pole is nan in row 31"),
    ],
)
def test_wrong_messages(
    tmp_path: Path, refuse: Any, spoil: Callable[[Ros], None], words: str
) -> None:
    ros = bag()
    spoil(ros)
    assert words in refuse(ros.write(tmp_path / "walk"), mapping=ARRAY)


def test_time_of_headers_that_goes_back(tmp_path: Path, refuse: Any) -> None:
    ros = Ros()
    for i, at in enumerate(TIME):
        stamp = at - 0.1 if i == 20 else at
        ros.joints(at, NAMES, QPOS[i], stamp=stamp)
        ros.joints(at, ["slider"], [0.0], topic="/to")
    path = ros.write(tmp_path / "walk")
    chosen = (path, "--state", "/joint_states", "--command", "/to", "--clock", "header")
    assert "goes back or stands still from row 20 (0.19 s) to row 21" in refuse(*chosen)


def test_clocks_that_do_not_meet(tmp_path: Path, refuse: Any) -> None:
    path = bag(late=5.0).write(tmp_path / "walk")
    assert "are their clocks the same?" in refuse(path, mapping=ARRAY)


def test_broken_bags(tmp_path: Path, refuse: Any) -> None:
    path = next(bag().write(tmp_path / "walk").glob("*.mcap"))
    raw = path.read_bytes()
    rng = np.random.default_rng(0)
    for at in (0, 5, *rng.integers(8, len(raw), 10)):
        path.write_bytes(raw[:at])
        assert "damaged or cut short" in refuse(path, mapping=ARRAY)
    (tmp_path / "walk" / "metadata.yaml").write_text("a: [")
    assert "cannot be read as a ROS 2 recording" in refuse(tmp_path / "walk")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"timestamp": TIME[::-1].copy()}, "goes back or stands still from row 1"),
        ({"timestamp": np.full(30, np.nan)}, "is nan in row 1"),
        ({"action": np.full(30, np.nan)}, "action.slider.pos is nan in row 1"),
        ({"action": ["a"] * 30}, "action holds string, not numbers"),
        (
            {"action": [[1.0]] * 29 + [[1.0, 2.0]]},
            "row 30 of action has 2 numbers where the first has 1",
        ),
    ],
)
def test_wrong_lerobot_rows(
    tmp_path: Path, refuse: Any, change: dict[str, Any], words: str
) -> None:
    path = lerobot(tmp_path / "pusht", episodes=1, changes=change)
    assert words in refuse(path)


def test_wrong_lerobot_datasets(tmp_path: Path, refuse: Any) -> None:
    path = lerobot(tmp_path / "pusht", names=("slider.pos", "poole.pos"))
    assert 'no joint "poole" of observation.state; did you mean "pole"?' in refuse(path)
    line = refuse(path, "--state", "observation.stat")
    assert 'did you mean "observation.state"?' in line
    assert "no episode 7" in refuse(path, "--episodes", 7)
    info = json.loads((path / "meta" / "info.json").read_text())
    for version in ("v1.6", "v4.0"):
        text = json.dumps({**info, "codebase_version": version})
        (path / "meta" / "info.json").write_text(text)
        assert "versions 2 and 3 are read" in refuse(path)
    (path / "meta" / "info.json").write_text("{")
    assert "not valid JSON" in refuse(path)
    path = lerobot(tmp_path / "cut")
    file = next((path / "data").rglob("*.parquet"))
    file.write_bytes(file.read_bytes()[:200])
    assert "damaged or cut short" in refuse(path)
    file.unlink()
    assert "no Parquet files" in refuse(path)


def test_wrong_minari_datasets(tmp_path: Path, refuse: Any) -> None:
    import h5py

    folder = minari(tmp_path / "cart-v0")
    assert "give its control step" in refuse(folder, mapping=MINARI)
    step = (folder, "--step", STEP)
    assert "--step is -1" in refuse(folder, "--step", -1)
    assert "actions has 1 entries without names" in refuse(*step)
    assert "no episode 5; it has 0 to 1" in refuse(*step, "--episodes", 5)
    line = refuse(*step, "--command", "action", mapping=MINARI)
    assert 'no array "action"; did you mean "actions"?' in line
    short = minari(tmp_path / "short", actions=20)
    line = refuse(short, "--step", STEP, mapping=MINARI)
    assert "31 rows of observations where 20 of actions call for 21" in line
    with h5py.File(tmp_path / "empty.hdf5", "w"):
        pass
    assert "no group episode_0" in refuse(tmp_path / "empty.hdf5", "--step", STEP)
    file = folder / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[:1000])
    assert "not an HDF5 file, damaged or cut short" in refuse(*step, mapping=MINARI)


@pytest.mark.fault("pickles and damaged archives")
def test_damaged_minari_datasets_are_read_or_refused(tmp_path: Path) -> None:
    """Lists of groups, links and chunks that lead nowhere, in every block of a file."""
    folder = minari(tmp_path / "cart-v0", episodes=1, rows=4)
    file = folder / "data" / "main_data.hdf5"
    whole = file.read_bytes()
    rng, refused = np.random.default_rng(0), 0
    for start in range(0, len(whole), 48):
        raw = bytearray(whole)
        raw[start : start + 8] = rng.bytes(8)
        file.write_bytes(raw)
        try:
            for _ in read_minari(folder, Selection(step=STEP)):
                pass
        except UserError as error:
            assert str(file) in str(error)
            refused += 1
    assert refused > 20


def test_earlier_logs_are_kept(tmp_path: Path, call: Any, refuse: Any) -> None:
    path = lerobot(tmp_path / "pusht")
    (tmp_path / "logs").mkdir()
    mine = tmp_path / "logs" / "pusht_000001.csv"
    mine.write_text("mine")
    assert "--overwrite" in refuse(path)  # not even the first episode is written
    assert mine.read_text() == "mine"
    check(call(path, "--overwrite")["pusht_000001"], CTRL + 1, rtol=1e-6)


def test_logs_are_as_before_where_one_cannot_be_written(
    tmp_path: Path, call: Any, refuse: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [lerobot(tmp_path / name) for name in ("pusht", "reach")]
    call(*paths)
    logs = sorted((tmp_path / "logs").iterdir())
    for log in logs:
        log.write_text("mine")
    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if Path(target) == logs[-1] and Path(source).parent.name != "before":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    assert "No space left" in refuse(*paths, "--overwrite")
    assert [log.read_text() for log in logs] == ["mine"] * len(logs)
    assert sorted((tmp_path / "logs").iterdir()) == logs


def test_a_reading_that_is_no_number_costs_its_own_rows_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a joint that turns, too, whose readings are brought to other rows."""
    ros = Ros()
    for i, at in enumerate(TIME):
        ros.joints(at, ["slider"], [QPOS[i, 0]], topic="/base")
        ros.array(at, [CTRL[i]])
        angle = np.nan if i == len(TIME) // 3 else QPOS[i, 1]
        ros.joints(at + 1e-3, ["pole"], [angle], topic="/arm")
    path = ros.write(tmp_path / "walk")
    model = tmp_path / "robot.xml"
    model.write_text(MODEL)
    asked = (path, "--state", "/base", "/arm", "--allow-nan")
    command(import_logs, *_arguments(tmp_path, model, asked, ARRAY))
    capsys.readouterr()
    mj_model = mujoco.MjModel.from_xml_string(MODEL)
    runs = read_logs(tmp_path / "logs" / "walk.csv", mj_model).runs
    assert sum(map(len, runs)) >= len(TIME) - 4


def test_a_wrong_last_recording_leaves_nothing(tmp_path: Path, refuse: Any) -> None:
    good = lerobot(tmp_path / "pusht")
    bad = lerobot(tmp_path / "spoilt", changes={"action": np.full(30, np.nan)})
    assert "spoilt" in refuse(good, bad)
    assert "another recording becomes" in refuse(good, good)


def test_what_is_no_recording(tmp_path: Path, refuse: Any) -> None:
    assert "no recording given" in refuse()
    assert "no such file or folder" in refuse(tmp_path / "none.mcap")
    (tmp_path / "a.bag").touch()
    assert "ROS 1" in refuse(tmp_path / "a.bag")
    (tmp_path / "a.txt").touch()
    assert "not a recording of a known kind" in refuse(tmp_path / "a.txt")
    (tmp_path / "folder").mkdir()
    assert "no recording of a known kind in it" in refuse(tmp_path / "folder")
    assert "--command-slack" in refuse(tmp_path / "a.bag", "--command-slack", -1)
    (tmp_path / "logs").touch()
    line = refuse(
        torch_zip(tmp_path / "a.pt", pace()), mapping="joints: [slider, pole]"
    )
    assert "is a file, not a folder" in line

"""Reading and writing of logs, and every way in which a log can be wrong."""

import io
import os
import zipfile
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from easi_jax.data.cleaning import split_at_resets
from easi_jax.data.recording import Run
from easi_jax.errors import UserError
from easi_jax.io.logs import tables as log_tables
from easi_jax.io.logs.columns import named_joints
from easi_jax.io.logs.mapping import LogMapping
from easi_jax.io.logs.reader import read_logs, write_log
from easi_jax.model.joint_space import Configuration

SHARED = Path(__file__).parents[5] / "shared" / "data"

CART = """
<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <body name="cart"><joint name="slider" type="slide" range="-1 1" limited="true"/>
    <geom size=".1"/><site name="site"/>
    <body><joint name="pole" type="hinge" range="-2 2" limited="true"/>
      <geom size=".1"/></body></body>
</worldbody>
<actuator><motor name="drive" joint="slider" ctrlrange="-5 5" ctrllimited="true"/>
</actuator>
<sensor><jointpos name="encoder" joint="pole"/><accelerometer name="imu" site="site"/>
</sensor></mujoco>
"""

FLYER = """
<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <body><freejoint name="base"/><geom size=".1"/>
    <body><joint name="wrist" type="ball"/><geom size=".1"/>
      <body><joint name="wheel" type="hinge"/><geom size=".1"/></body></body></body>
</worldbody></mujoco>
"""

ROWS = 40


@pytest.fixture(scope="module")
def cart() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CART)


@pytest.fixture(scope="module")
def flyer() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(FLYER)


def cart_columns(rows: int = ROWS, dt: float = 0.01) -> dict[str, Any]:
    time = dt * np.arange(rows)
    return {
        "time": time,
        "qpos.slider": 0.3 * np.sin(3 * time),
        "qpos.pole": 0.5 * np.cos(2 * time),
        "ctrl.drive": np.arange(rows) / 10.0,
    }


def save(path: Path, columns: dict[str, Any]) -> Path:
    """Written by other code than the project's own."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".parquet":
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
    else:
        lines = [",".join(columns)]
        for row in zip(*columns.values(), strict=True):
            lines.append(",".join("" if x is None else str(x) for x in row))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def failure(*args, **kwargs) -> str:
    with pytest.raises(UserError) as caught:
        read_logs(*args, **kwargs)
    text = str(caught.value)
    assert "\n" not in text
    return text


def said(log, words: str) -> str:
    found = [note for note in log.notes if words in note.partition(": ")[2]]
    assert len(found) == 1, log.notes
    return found[0]


EXTENSIONS = ["csv", "npz", "parquet"]


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_reads_every_file_type(tmp_path, cart, extension):
    columns = cart_columns()
    shuffled = dict(reversed(columns.items()))
    log = read_logs(save(tmp_path / f"a.{extension}", shuffled), cart)
    (run,) = log.runs
    assert (run.name, run.dt, len(run)) == ("a", 0.01, ROWS)
    assert run.source.endswith(f"a.{extension}")
    np.testing.assert_array_equal(run.time, columns["time"])
    np.testing.assert_array_equal(run.qpos[:, 0], columns["qpos.slider"])
    np.testing.assert_array_equal(run.qpos[:, 1], columns["qpos.pole"])
    np.testing.assert_array_equal(run.ctrl[:, 0], columns["ctrl.drive"])
    assert not run.qvel_measured
    assert run.qvel.dtype == run.qpos.dtype == np.float64
    np.testing.assert_allclose(run.qvel[5:-5, 0], 0.9 * np.cos(3 * run.time)[5:-5],
                               atol=5e-3)  # fmt: skip
    assert "qvel.slider, qvel.pole" in said(log, "estimated")


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_written_logs_read_back_bit_equal(tmp_path, cart, extension):
    rng = np.random.default_rng(0)
    runs = [
        Run(
            name=name,
            source="",
            dt=0.01,
            time=0.01 * np.arange(20),
            qpos=rng.normal(size=(20, 2)) * 0.3,
            qvel=rng.normal(size=(20, 2)),
            qvel_measured=True,
            ctrl=rng.normal(size=(20, 1)),
            configuration=Configuration.of(cart),
            sensors={"imu": rng.normal(size=(20, 3))},
        )
        for name in ("first", "second")
    ]
    path = tmp_path / f"out.{extension}"
    write_log(path, cart, runs)
    log = read_logs(path, cart)
    assert log.notes == ()
    assert [run.name for run in log.runs] == ["out/first", "out/second"]
    for old, new in zip(runs, log.runs, strict=True):
        assert new.qvel_measured
        for name in ("time", "qpos", "qvel", "ctrl"):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
        np.testing.assert_array_equal(new.sensors["imu"], old.sensors["imu"])

    write_log(path, cart, [runs[0], replace(runs[1], sensors={})])
    both = read_logs(path, cart).runs
    np.testing.assert_array_equal(both[0].sensors["imu"], runs[0].sensors["imu"])
    assert np.isnan(both[1].sensors.get("imu", np.nan)).all()

    write_log(path, cart, runs[0], velocities=False)
    (run,) = read_logs(path, cart).runs
    assert run.name == "out"
    assert not run.qvel_measured
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_writing_refuses_what_it_cannot_do(tmp_path, cart):
    save(tmp_path / "a.csv", cart_columns())
    (run,) = read_logs(tmp_path / "a.csv", cart).runs
    with pytest.raises(UserError, match="ends in"):
        write_log(tmp_path / "a.xlsx", cart, run)
    with pytest.raises(UserError, match="no run"):
        write_log(tmp_path / "a.csv", cart, [])
    with pytest.raises(ValueError, match="one name"):
        write_log(tmp_path / "a.csv", cart, [run, run])
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        write_log(tmp_path / "file" / "a.csv", cart, run)


# Columns


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_missing_column_is_named_with_the_nearest(tmp_path, cart, extension):
    columns = cart_columns()
    columns["qpos.pol"] = columns.pop("qpos.pole")
    text = failure(save(tmp_path / f"a.{extension}", columns), cart)
    assert f"a.{extension}" in text
    assert '"qpos.pole"' in text
    assert 'did you mean "qpos.pol"?' in text


def test_the_log_of_another_robot_is_offered_no_column_by_chance(tmp_path, cart):
    """What all columns of positions begin with makes none alike."""
    columns = cart_columns()
    for mine, other in (("slider", "drone.6"), ("pole", "drone.5")):
        columns[f"qpos.{other}"] = columns.pop(f"qpos.{mine}")
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert "did you mean" not in text and "drone.6" in text


def test_all_missing_columns_are_named(tmp_path, cart):
    text = failure(save(tmp_path / "a.csv", {"time": np.arange(3)}), cart)
    for name in ("qpos.slider", "qpos.pole", "ctrl.drive"):
        assert f'"{name}"' in text
    columns = cart_columns()
    del columns["time"]
    assert '"time"' in failure(save(tmp_path / "b.csv", columns), cart)


ARM = """<mujoco><option timestep=".01"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0"/><geom size=".1"/>
  <body name="fore" pos="0 0 .5"><joint name="elbow" type="ball"/><geom size=".1"/>
    <body name="hand" pos="0 0 .5"><joint name="wrist"/><geom size=".1"/></body>
</body></body></worldbody>
<actuator><motor name="lift" joint="shoulder"/><motor name="bend" joint="elbow"/>
<motor name="turn" joint="wrist"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("dropped", "lost"),
    [
        (
            "qpos.elbow",
            "without them little can be determined of joint elbow, drive bend, "
            "bodies fore, hand: log them; if joint elbow has no sensor, give "
            "--unmeasured elbow",
        ),
        (
            "qpos.wrist",
            "without it little can be determined of joint wrist, drive turn, "
            "body hand: log it; if joint wrist has no sensor, give --unmeasured wrist",
        ),
        ("ctrl.lift", "without it nothing can be determined of drive lift: log it"),
    ],
)
def test_what_a_missing_joint_leaves_open_is_said(tmp_path, dropped, lost):
    m = mujoco.MjModel.from_xml_string(ARM)
    columns = {"time": 0.01 * np.arange(ROWS), "imu": np.ones(ROWS)}
    columns |= {f"qpos.{j}": np.zeros(ROWS) for j in ("shoulder", "wrist")}
    columns |= {f"qpos.elbow.{i}": np.full(ROWS, float(i == 0)) for i in range(4)}
    columns |= {f"ctrl.{a}": np.zeros(ROWS) for a in ("lift", "bend", "turn")}
    kept = {k: v for k, v in columns.items() if not k.startswith(dropped)}
    text = failure(save(tmp_path / "a.csv", kept), m)
    assert text.endswith(lost)
    assert "determined" not in failure(save(tmp_path / "b.csv", {"time": [0]}), m)


@pytest.mark.parametrize(
    ("extra", "near"),
    [
        ("qpos.pole2", "qpos.pole"),
        ("qvel.slidr", "qvel.slider"),
        ("ctrl.driver", "ctrl.drive"),
        ("qpos.pole.0", "qpos.pole"),
    ],
)
def test_unknown_position_velocity_or_command_is_an_error(tmp_path, cart, extra, near):
    columns = cart_columns() | {extra: np.zeros(ROWS)}
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert f'"{extra}"' in text
    assert f'did you mean "{near}"?' in text


def test_other_unknown_columns_are_listed_and_ignored(tmp_path, cart):
    columns = cart_columns() | {
        "temperature": np.zeros(ROWS),
        "sensor.gyro": np.zeros(ROWS),
    }
    note = said(read_logs(save(tmp_path / "a.csv", columns), cart), "ignored")
    assert "temperature, sensor.gyro" in note


def test_ignored_columns_may_hold_anything(tmp_path, cart):
    columns = cart_columns() | {"remark": np.array(["x"] * ROWS)}
    for extension in EXTENSIONS:
        log = read_logs(save(tmp_path / f"a.{extension}", columns), cart)
        assert "remark" in said(log, "ignored")
    np.savez(tmp_path / "b.npz", **cart_columns(), image=np.zeros((2, 3, 4)))
    assert "image" in said(read_logs(tmp_path / "b.npz", cart), "ignored")


def test_duplicate_columns(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    lines = path.read_text().splitlines()
    lines[0] += ",time"
    path.write_text("\n".join([lines[0], *(f"{x},0" for x in lines[1:])]))
    assert '"time" is there more than once' in failure(path, cart)

    table = pyarrow.table(cart_columns())
    table = table.append_column("qpos.pole", table["qpos.pole"])
    pyarrow.parquet.write_table(table, tmp_path / "a.parquet")
    assert '"qpos.pole" is there more' in failure(tmp_path / "a.parquet", cart)

    save(tmp_path / "a.npz", cart_columns())
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        raw = archive.read("time.npy")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("time.npy", raw)
    assert '"time" is there more' in failure(tmp_path / "a.npz", cart)


def test_velocities_of_some_joints(tmp_path, cart, flyer):
    columns = cart_columns() | {"qvel.pole": np.full(ROWS, 7.0)}
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    (run,) = log.runs
    np.testing.assert_array_equal(run.qvel[:, 1], 7.0)
    assert abs(run.qvel[3, 0]) < 1.0
    assert not run.qvel_measured
    note = said(log, "estimated")
    assert "qvel.slider" in note
    assert "qvel.pole" not in note

    columns = flyer_columns() | {"qvel.base.0": np.zeros(ROWS)}
    text = failure(save(tmp_path / "b.csv", columns), flyer)
    assert '"qvel.base.0" needs "qvel.base.1"' in text


@pytest.mark.parametrize(("lost", "measured"), [([3, 9], True), ([3, 9, 20], False)])
def test_missing_velocity_cells_are_estimated_and_counted(
    tmp_path, cart, lost, measured
):
    """A few of them are no reason to leave all velocities aside."""
    columns = cart_columns()
    columns |= {"qvel.slider": np.full(ROWS, 7.0), "qvel.pole": np.full(ROWS, 8.0)}
    columns["qvel.pole"][lost] = np.nan
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    (run,) = log.runs
    assert len(run) == ROWS
    note = said(log, "velocities missing")
    assert f"{len(lost)} rows are estimated" in note
    assert ("no velocity counts as measured" in note) == (not measured)
    assert run.qvel_measured == measured
    assert abs(run.qvel[3, 1]) < 1.0
    assert run.qvel[4, 1] == 8.0


def test_sensors_are_optional_and_may_have_gaps(tmp_path, cart):
    slow = np.where(np.arange(ROWS) % 5 == 0, 1.0, np.nan)
    columns = cart_columns() | {"sensor.encoder": slow}
    columns |= {f"sensor.imu.{i}": np.full(ROWS, float(i)) for i in range(3)}
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    (run,) = log.runs
    assert len(run) == ROWS
    np.testing.assert_array_equal(run.sensors["encoder"][:, 0], slow)
    np.testing.assert_array_equal(run.sensors["imu"][4], [0, 1, 2])
    columns["sensor.encoder.0"] = columns.pop("sensor.encoder")  # of one number
    path = save(tmp_path / "b.npz", columns)
    (run,) = read_logs(path, cart).runs
    np.testing.assert_array_equal(run.sensors["encoder"][:, 0], slow)
    (tmp_path / "m.yaml").write_text("scale: {sensor.encoder.0: 0.5}")
    (run,) = read_logs(path, cart, tmp_path / "m.yaml").runs
    np.testing.assert_array_equal(run.sensors["encoder"][:, 0], 0.5 * slow)
    del columns["sensor.imu.2"]
    log = read_logs(save(tmp_path / "b.csv", columns), cart)
    assert "imu" not in log.runs[0].sensors
    assert "it has 3 columns" in said(log, "sensor imu")


def test_models_whose_parts_have_no_name():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="b"><joint/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    assert 'joint 0 (in body "b") has no name' in failure("a.csv", model)
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body>'
        '</worldbody><actuator><motor joint="j"/></actuator></mujoco>'
    )
    assert "actuator 0 has no name" in failure("a.csv", model)


# Joints without a reading


@pytest.mark.parametrize("given", [("pole",), ("po*",), ("all",), ("pole", "all")])
def test_a_joint_without_a_reading(tmp_path, cart, given):
    columns = cart_columns()
    columns["qvel.pole"] = np.ones(ROWS)
    del columns["qpos.pole"]
    log = read_logs(save(tmp_path / "a.csv", columns), cart, unmeasured=given)
    (run,) = log.runs
    assert run.hidden.tolist() == [False, True] and not run.qvel_measured
    assert np.all(run.qpos[:, 1] == 0) and np.all(run.qvel[:, 1] == 0)
    assert "pole (--unmeasured)" in said(log, "without a reading, whose start")
    assert "qvel.pole" in said(log, "not read")
    assert said(log, "estimated from positions").endswith(": qvel.slider")


def test_columns_of_a_joint_that_is_named_are_not_read(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    log = read_logs(path, cart, unmeasured=("pole",))
    assert log.runs[0].hidden.tolist() == [False, True]
    assert np.all(log.runs[0].qpos[:, 1] == 0)
    assert "qpos.pole" in said(log, "not read")
    assert not read_logs(path, cart, unmeasured=("all",)).runs[0].hidden.any()


def test_what_one_log_lacks_is_hidden_in_all(tmp_path, cart):
    columns = cart_columns()
    a = save(tmp_path / "a.csv", columns)
    del columns["qpos.pole"]
    b = save(tmp_path / "b.csv", columns)
    log = read_logs([a, b], cart, unmeasured=("all",))
    assert [run.hidden.tolist() for run in log.runs] == [[False, True]] * 2
    assert log.notes[-1].startswith("readings of pole are not used")


def test_joints_that_the_model_places_need_no_word(tmp_path):
    m = mujoco.MjModel.from_xml_string(
        CART.replace(
            "<actuator>",
            '<equality><joint joint1="pole" joint2="slider" polycoef="0.1 2 0 0 0"/>'
            "</equality><actuator>",
        )
    )
    columns = cart_columns()
    del columns["qpos.pole"]
    log = read_logs(save(tmp_path / "a.csv", columns), m)
    (run,) = log.runs
    np.testing.assert_allclose(run.qpos[:, 1], 0.1 + 2 * run.qpos[:, 0], atol=1e-9)
    assert "pole (coupled to slider)" in said(log, "without a reading, whose start")
    # Both are missing, so neither is placed.
    del columns["qpos.slider"]
    text = failure(save(tmp_path / "b.csv", columns), m)
    assert 'no column "qpos.slider"' in text


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((), "; if joint pole has no sensor, give --unmeasured pole"),
        (("slider", "all"), "no joint is measured, so nothing can be determined"),
        (("pola",), 'has no such joint; did you mean "pole"? (known: slider, pole)'),
    ],
)
def test_missing_joints_that_nobody_declared(tmp_path, cart, given, words):
    columns = cart_columns()
    columns["qpos.pol"] = columns.pop("qpos.pole")
    text = failure(save(tmp_path / "a.csv", columns), cart, unmeasured=given)
    assert words in text
    if not given:
        assert 'did you mean "qpos.pol"?' in text


def test_a_base_without_a_reading(tmp_path, flyer):
    columns = {k: v for k, v in flyer_columns().items() if "base" not in k}
    path = save(tmp_path / "a.csv", columns)
    text = failure(path, flyer)
    assert '"qpos.base.0"' in text and "--held-base" in text
    assert text.endswith("if joint base has no sensor, give --unmeasured base")
    log = read_logs(path, flyer, unmeasured=("base",))
    (run,) = log.runs
    assert run.hidden.tolist() == [True] * 6 + [False] * 4
    np.testing.assert_allclose(run.qpos[:, 3:7], np.tile([1.0, 0, 0, 0], (ROWS, 1)))
    back = tmp_path / "b.csv"
    write_log(back, flyer, run)
    assert "base" not in back.read_text()
    again = read_logs(back, flyer, unmeasured=("all",)).runs[0]
    np.testing.assert_allclose(again.qpos, run.qpos, rtol=0, atol=1e-15)


def test_trees_without_a_reading_are_told(tmp_path):
    m = mujoco.MjModel.from_xml_string(
        CART.replace(
            "</worldbody>",
            '<body name="ball"><freejoint name="ball"/><geom size=".1"/></body>'
            "</worldbody>",
        )
    )
    path = save(tmp_path / "a.csv", cart_columns())
    log = read_logs(path, m, unmeasured=("ball",))
    assert "tie ball to what is measured" in said(log, "only contacts")


# Time and runs


def test_runs_by_column(tmp_path, cart):
    columns = cart_columns()
    label = np.repeat([7, 3], ROWS // 2)
    columns["time"] = np.tile(columns["time"][: ROWS // 2], 2)
    for extension in EXTENSIONS:
        path = save(tmp_path / f"a.{extension}", {**columns, "run": label})
        assert [r.name for r in read_logs(path, cart).runs] == ["a/7", "a/3"]
    for extension in EXTENSIONS:
        names = np.where(label == 7, "up", "down")
        path = save(tmp_path / f"b.{extension}", {**columns, "run": names})
        assert [r.name for r in read_logs(path, cart).runs] == ["b/up", "b/down"]
    text = failure(save(tmp_path / "c.csv", columns), cart)
    assert '"run" column' in text
    label = np.array(["x", *[""] * (ROWS - 1)])
    text = failure(save(tmp_path / "d.csv", {**columns, "run": label}), cart)
    assert "row 2 has no value" in text


def test_runs_of_different_rates_together(tmp_path, cart):
    slow = save(tmp_path / "slow.csv", cart_columns(dt=0.02))
    fast = save(tmp_path / "fast.npz", cart_columns(dt=0.005))
    assert [r.dt for r in read_logs([slow, fast], cart).runs] == [0.02, 0.005]


def test_names_stay_apart(tmp_path, cart):
    (tmp_path / "mon").mkdir()
    (tmp_path / "tue").mkdir()
    a = save(tmp_path / "mon" / "run.csv", cart_columns())
    b = save(tmp_path / "tue" / "run.csv", cart_columns())
    names = [run.name for run in read_logs([a, b], cart).runs]
    assert len(set(names)) == 2
    assert "more than once" in failure([a, a], cart)
    assert "no log" in failure([], cart)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_time_going_back(tmp_path, cart, extension):
    columns = cart_columns()
    columns["time"][11] = columns["time"][10] - 0.005
    text = failure(save(tmp_path / f"a.{extension}", columns), cart)
    assert "row 11" in text
    assert "row 12" in text
    assert "goes back or stands still" in text


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_repeated_time_stamp_is_dropped(tmp_path, cart, extension):
    columns = cart_columns()
    for name, values in columns.items():
        columns[name] = np.insert(values, 11, values[10])
    log = read_logs(save(tmp_path / f"a.{extension}", columns), cart)
    (run,) = log.runs
    np.testing.assert_array_equal(run.qpos[:, 0], cart_columns()["qpos.slider"])
    assert "1 (the first is row 12)" in said(log, "repeats that of the row before")


def test_a_clock_coarser_than_the_rows_is_refused(tmp_path, cart):
    columns = cart_columns()
    columns["time"] = np.floor(columns["time"] / 0.04) * 0.04
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert "30 of 40 rows repeat the time stamp" in text
    assert "row 2" in text


@pytest.mark.parametrize(
    ("factor", "unit", "line"),
    [
        (1e3, "milliseconds", "scale: {time: 0.001}"),
        (1e6, "microseconds", "scale: {time: 1e-06}"),
        (1e9, "nanoseconds", "scale: {time: 1e-09}"),
    ],
)
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_clocks_of_other_units(tmp_path, cart, factor, unit, line, start):
    """From their own start or from 1970 on; the line that is told cures it."""
    columns = cart_columns()
    columns["time"] = np.round((columns["time"] + start) * factor)
    path = save(tmp_path / "a.npz", columns)
    text = failure(path, cart)
    assert f"{unit}" in text and f"'{line}' in a mapping file" in text
    (tmp_path / "map.yaml").write_text(line)
    (run,) = read_logs(path, cart, mapping=tmp_path / "map.yaml").runs
    assert run.dt == pytest.approx(0.01, rel=1e-4)
    assert len(run) == ROWS


@pytest.mark.parametrize("timestep", [0.01, 0.001])
def test_a_time_that_counts_the_rows(tmp_path, timestep):
    """Told where it may be seconds, refused where it cannot be."""
    model = mujoco.MjModel.from_xml_string(CART)
    model.opt.timestep = timestep
    path = save(tmp_path / "a.csv", cart_columns() | {"time": np.arange(ROWS)})
    line = f"'scale: {{time: {timestep}}}' in a mapping file"
    if timestep < 0.002:
        assert line in failure(path, model)
    else:
        assert line in said(read_logs(path, model), "counts rows")


def test_times_that_no_clock_shows(tmp_path, cart):
    columns = cart_columns()
    columns["time"][7] = 1e154
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    assert [len(run) for run in log.runs] == [7, 32]
    assert "1 rows (the first is row 8, 1e+154 s)" in said(log, "no clock shows")
    columns["time"] = columns["time"] + 1e154
    assert 'column "time" holds 1e+154' in failure(save(tmp_path / "b.csv", columns),
                                                   cart)  # fmt: skip


@pytest.mark.parametrize("column", ["time", "qpos.pole", "ctrl.drive"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_non_finite_rows_split_the_run(tmp_path, cart, column, value, extension):
    columns = cart_columns()
    columns[column][[10, 25]] = value
    log = read_logs(save(tmp_path / f"a.{extension}", columns), cart)
    assert [run.name for run in log.runs] == ["a#1", "a#2", "a#3"]
    assert [len(run) for run in log.runs] == [10, 14, 14]
    assert log.runs[1].ctrl[0, 0] == pytest.approx(1.1)
    note = said(log, "dropped")
    assert "2 of 40 rows" in note
    assert "row 11" in note
    assert "3 runs" in said(log, "split")


def test_empty_cells_are_non_finite(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    lines = path.read_text().splitlines()
    cells = lines[6].split(",")
    lines[6] = ",".join([*cells[:2], "", cells[3]])
    path.write_text("\n".join(lines))
    log = read_logs(path, cart)
    assert [len(run) for run in log.runs] == [5, 34]
    table = pyarrow.table({k: list(v) for k, v in cart_columns().items()})
    nulls = table.set_column(1, "qpos.slider", [[None, *[0.0] * (ROWS - 1)]])
    pyarrow.parquet.write_table(nulls, tmp_path / "a.parquet")
    assert [len(r) for r in read_logs(tmp_path / "a.parquet", cart).runs] == [ROWS - 1]


def test_kinds_of_columns_of_parquet_and_npz(tmp_path, cart):
    """Long whole numbers and text of any kind as labels, decimals as numbers."""
    columns = cart_columns()
    large = 1_700_000_000_000_000_000 + (np.arange(ROWS) >= ROWS // 2)
    decimals = [Decimal(f"{x:.6f}") for x in columns["qpos.pole"]]
    text = ["a"] * (ROWS // 2) + ["b"] * (ROWS - ROWS // 2)
    kinds = [
        pyarrow.array(large),
        pyarrow.array(text, pyarrow.string_view()),
        pyarrow.array([t.encode() for t in text]),
    ]
    for k, label in enumerate(kinds):
        table = pyarrow.table({**columns, "qpos.pole": decimals, "run": label})
        path = tmp_path / f"{k}.parquet"
        pyarrow.parquet.write_table(table, path)
        runs = read_logs(path, cart).runs
        assert [len(run) for run in runs] == [ROWS // 2, ROWS - ROWS // 2]
        pole = np.concatenate([run.qpos[:, 1] for run in runs])
        np.testing.assert_allclose(pole, columns["qpos.pole"], atol=1e-6)
    blob = [b"\xff\xfe"] * ROWS  # no text, and nothing that a log needs
    table = pyarrow.table({**columns, "blob": blob})
    pyarrow.parquet.write_table(table, tmp_path / "blob.parquet")
    assert "blob" in said(read_logs(tmp_path / "blob.parquet", cart), "ignored")
    np.savez(tmp_path / "blob.npz", **columns, blob=np.array(blob))
    assert "blob" in said(read_logs(tmp_path / "blob.npz", cart), "ignored")
    columns["run"] = np.array([t.encode() for t in text])
    log = read_logs(save(tmp_path / "a.npz", columns), cart)
    assert [run.name for run in log.runs] == ["a/a", "a/b"]


def test_names_may_have_two_spaces(tmp_path):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="a  b"/><geom size="1"/></body>'
        "</worldbody></mujoco>"
    )
    time = 0.01 * np.arange(ROWS)
    path = save(tmp_path / "a.csv", {"time": time, " qpos.a  b ": np.sin(time)})
    assert len(read_logs(path, model).runs[0]) == ROWS


def test_holes(tmp_path, cart):
    columns = cart_columns()
    keep = np.ones(ROWS, bool)
    keep[[10, 11]] = False  # three steps: bridged
    keep[[20, 21, 22]] = False  # four: a hole
    log = read_logs(
        save(tmp_path / "a.csv", {k: v[keep] for k, v in columns.items()}), cart
    )
    first, second = log.runs
    assert len(first) == 20
    assert len(second) == 17
    np.testing.assert_allclose(first.time, columns["time"][:20], atol=1e-12)
    bridge = np.interp(0.10, [0.09, 0.12], columns["qpos.slider"][[9, 12]])
    assert first.qpos[10, 0] == pytest.approx(bridge)
    np.testing.assert_allclose(first.ctrl[9:13, 0], [0.9, 0.9, 0.9, 1.2])
    assert said(log, "holes longer than 3 steps: 1")
    assert "200 % (a#1)" in said(log, "in 1 of 2 runs")


def test_irregular_times(tmp_path, cart):
    """Linear motion comes out exact; commands are held from the row before."""
    rng = np.random.default_rng(2)
    time = 0.01 * np.arange(ROWS)
    time[1:-1] += rng.uniform(-0.003, 0.003, ROWS - 2)
    columns = cart_columns() | {
        "time": time,
        "qpos.slider": 0.5 * time,
        "qvel.slider": 2.0 * time,
        "qvel.pole": -1.0 * time,
        "sensor.encoder": 3.0 * time,
    }
    (run,) = read_logs(save(tmp_path / "a.npz", columns), cart).runs
    assert run.dt == pytest.approx(np.median(np.diff(time)))
    np.testing.assert_allclose(np.diff(run.time), run.dt)
    np.testing.assert_allclose(run.qpos[:, 0], 0.5 * run.time, atol=1e-12)
    np.testing.assert_allclose(run.qvel[:, 0], 2.0 * run.time, atol=1e-12)
    np.testing.assert_allclose(run.sensors["encoder"][:, 0], 3 * run.time, atol=1e-12)
    before = [np.flatnonzero(time <= t + 1e-4)[-1] for t in run.time]
    np.testing.assert_array_equal(run.ctrl[:, 0], columns["ctrl.drive"][before])
    assert run.qvel_measured


def test_rounded_time_stamps_are_not_interpolated(tmp_path, cart):
    columns = cart_columns()
    columns["time"] += np.random.default_rng(0).uniform(-2e-5, 2e-5, ROWS)
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    np.testing.assert_array_equal(log.runs[0].qpos[:, 0], columns["qpos.slider"])
    columns["time"] += 1.7e9  # seconds since 1970
    (run,) = read_logs(save(tmp_path / "b.csv", columns), cart).runs
    assert len(run) == ROWS


@pytest.mark.parametrize(
    ("factor", "ratio"), [(1000.0, "1e+03 times"), (1e-3, "0.001 times")]
)
def test_wrong_rate(tmp_path, cart, factor, ratio):
    columns = cart_columns()
    columns["time"] = columns["time"] * factor
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert "wrong rate" in text
    assert ratio in text
    assert "scale" in text


@pytest.mark.parametrize(
    ("factor", "words"), [(100.0, "100 physics steps"), (0.1, "is the control step")]
)
def test_odd_rate_is_said(tmp_path, cart, factor, words):
    columns = cart_columns()
    columns["time"] = columns["time"] * factor
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    assert words in said(log, "a control step of")


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_single_rows(tmp_path, cart, extension):
    one = save(tmp_path / f"a.{extension}", cart_columns(rows=1))
    assert "single row" in failure(one, cart)
    none = save(tmp_path / f"b.{extension}", cart_columns(rows=0))
    assert "no rows" in failure(none, cart)


def test_names_with_brackets_are_names() -> None:
    """No pattern has any but ``*``."""
    m = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="leg[0]"/><geom size=".1"/>
        <body><joint name="leg[1]"/><geom size=".1"/></body></body></worldbody>
        </mujoco>"""
    )
    assert named_joints(m, ["leg[0]"]) == {"leg[0]"}
    assert named_joints(m, ["leg*"]) == {"leg[0]", "leg[1]"}
    names = LogMapping(source="m", scale={"qpos.leg[0]": 2.0})
    names.check_used(["qpos.leg[0]"])
    assert names.apply("qpos.leg[0]", np.ones(2)).tolist() == [2.0, 2.0]
    assert names.apply("qpos.leg[1]", np.ones(2)).tolist() == [1.0, 1.0]


def test_rows_that_stand_alone(tmp_path, cart):
    columns = cart_columns()
    columns["qpos.pole"][1::2] = np.nan
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert (
        "no two successive rows" in text and '"qpos.pole" has a number in 50%' in text
    )
    columns = cart_columns()
    columns["qpos.pole"][1] = np.nan
    log = read_logs(save(tmp_path / "b.csv", columns), cart)
    assert [(run.name, len(run)) for run in log.runs] == [("b", ROWS - 2)]
    assert said(log, "alone between holes: 1")
    columns = cart_columns() | {"run": np.array([1] * (ROWS - 1) + [2])}
    log = read_logs(save(tmp_path / "c.csv", columns), cart)
    assert [run.name for run in log.runs] == ["c/1"]
    assert said(log, "c/2 left out")


# Values


def test_degrees_are_noticed(tmp_path, cart, flyer):
    columns = cart_columns()
    columns["qpos.pole"] = np.degrees(columns["qpos.pole"])
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    assert "degrees" in said(log, "joint pole")
    columns = cart_columns()
    columns["qpos.slider"] = 1000 * columns["qpos.slider"]
    log = read_logs(save(tmp_path / "b.csv", columns), cart)
    assert "mm" in said(log, "joint slider")
    columns = flyer_columns() | {"qpos.wheel": np.linspace(0, 90, ROWS)}
    log = read_logs(save(tmp_path / "c.csv", columns), flyer)
    assert "degrees" in said(log, "joint wheel")


def test_commands_beyond_their_range_are_noticed(tmp_path, cart):
    columns = cart_columns()
    columns["ctrl.drive"][:4] = 6.0
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    assert "4 commands" in said(log, "actuator drive")
    assert log.runs[0].ctrl[0, 0] == 6.0


@pytest.mark.parametrize("column", ["qpos.pole", "ctrl.drive"])
def test_huge_numbers(tmp_path, cart, column):
    columns = cart_columns()
    columns[column][4] = 1e300
    text = failure(save(tmp_path / "a.csv", columns), cart)
    assert "row 5" in text
    assert column in text
    assert "1e+300" in text


def flyer_columns() -> dict[str, np.ndarray]:
    """A free base and a ball joint that turn steadily, quaternions of any length."""
    time = 0.01 * np.arange(ROWS)
    angle = 2.0 * time
    columns = {"time": time, "qpos.wheel": 3.0 * time}
    for i, value in enumerate((0.1 * time, 0 * time, 1 + 0 * time)):
        columns[f"qpos.base.{i}"] = value
    zero = 0 * time
    for i, value in enumerate((np.cos(angle / 2), zero, zero, np.sin(angle / 2))):
        columns[f"qpos.base.{i + 3}"] = 2.0 * value
    for i, value in enumerate((np.cos(angle), np.sin(angle), zero, zero)):
        columns[f"qpos.wrist.{i}"] = -value
    return columns


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_free_and_ball_joints(tmp_path, flyer, extension):
    columns = flyer_columns()
    for i in range(4):  # the sign of a quaternion means nothing
        columns[f"qpos.wrist.{i}"][17:] *= -1
    log = read_logs(save(tmp_path / f"a.{extension}", columns), flyer)
    (run,) = log.runs
    assert "base" in said(log, "off unit length")
    for first in (3, 7):
        quaternion = run.qpos[:, first : first + 4]
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0)
        assert np.all(np.sum(quaternion[1:] * quaternion[:-1], axis=1) > 0.9)
    expected = [0.1, 0, 0, 0, 0, 2.0, 4.0, 0, 0, 3.0]
    np.testing.assert_allclose(run.qvel, np.tile(expected, (ROWS, 1)), atol=1e-9)
    assert run.ctrl.shape == (ROWS, 0)


def test_quaternions_between_rows(tmp_path, flyer):
    columns = flyer_columns()
    keep = np.arange(ROWS) != 12
    log = read_logs(
        save(tmp_path / "a.npz", {k: v[keep] for k, v in columns.items()}), flyer
    )
    (run,) = log.runs
    assert len(run) == ROWS
    expected = [np.cos(0.12), 0, 0, np.sin(0.12)]
    np.testing.assert_allclose(run.qpos[12, 3:7], expected, atol=1e-12)


def test_zero_quaternion(tmp_path, flyer):
    columns = flyer_columns()
    for i in range(4):
        columns[f"qpos.wrist.{i}"][6] = 0.0
    text = failure(save(tmp_path / "a.csv", columns), flyer)
    assert "row 7" in text
    assert "wrist" in text


def test_wrapped_hinge_is_unrolled_per_recording(tmp_path, flyer, cart):
    columns = flyer_columns()
    true = np.linspace(0, 8, ROWS)
    columns["qpos.wheel"] = (true + np.pi) % (2 * np.pi) - np.pi
    log = read_logs(save(tmp_path / "a.csv", columns), flyer)
    np.testing.assert_allclose(log.runs[0].qpos[:, 11], true, atol=1e-9)
    assert "wheel" in said(log, "whole turn")
    # another recording may start anywhere: its jump is no wrap
    values = np.where(np.arange(ROWS) < 20, 0.0, 6.0)
    columns |= {"qpos.wheel": values, "run": np.repeat([1, 2], 20)}
    log = read_logs(save(tmp_path / "b.csv", columns), flyer)
    np.testing.assert_array_equal(log.runs[1].qpos[:, 11], 6.0)
    # a joint with limits cannot wrap
    columns = cart_columns()
    columns["qpos.pole"][20:] += 2 * np.pi
    (run,) = read_logs(save(tmp_path / "c.csv", columns), cart).runs
    np.testing.assert_array_equal(run.qpos[:, 1], columns["qpos.pole"])


TURN = """
<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody><body>
<joint name="wrist" range="-6.28319 6.28319"/><geom size=".1"/></body></worldbody>
<actuator><position name="drive" joint="wrist" kp="50"/></actuator></mujoco>
"""


@pytest.mark.parametrize(("start", "reach"), [(2.5, 3.4), (-6.0, 7.0)])
def test_an_encoder_wraps_in_a_range_of_two_turns(tmp_path, start, reach):
    """The run stays whole, and inside of the range that the joint has."""
    model = mujoco.MjModel.from_xml_string(TURN)
    time = 0.01 * np.arange(200)
    true = start + 0.5 * reach * (1 - np.cos(2 * time))
    columns = {"time": time, "qpos.wrist": (true + np.pi) % (2 * np.pi) - np.pi}
    assert np.ptp(np.diff(columns["qpos.wrist"])) > 6
    log = read_logs(save(tmp_path / "a.csv", columns | {"ctrl.drive": true}), model)
    (run,) = log.runs
    np.testing.assert_allclose(run.qpos[:, 0], true, atol=1e-9)
    assert 'column "qpos.wrist"' in said(log, "whole turn")
    assert split_at_resets([run], np.full(2, 1e-3)) == ([run], [])


def test_quaternions_written_x_y_z_w(tmp_path, flyer):
    """Velocities tell them; without any a half turn in every row is told."""
    columns = flyer_columns()
    speed = {f"qvel.base.{i}": np.zeros(ROWS) for i in range(6)}
    speed["qvel.base.5"][:] = 2.0
    right = save(tmp_path / "right.csv", columns | speed)
    assert read_logs(right, flyer).runs[0].qpos[0, 3] == 1.0
    swapped = {f"qpos.base.{3 + i}": columns[f"qpos.base.{j}"]
               for i, j in enumerate((4, 5, 6, 3))}  # fmt: skip
    line = "quaternions: {base: xyzw}"
    path = save(tmp_path / "a.csv", columns | swapped | speed)
    text = failure(path, flyer)
    assert f"qpos.base.3 to .6 if these are written x y z w, not w x y z; '{line}'" in (
        text
    )
    mapping = tmp_path / "map.yaml"
    mapping.write_text(line)
    run = read_logs(path, flyer, mapping=mapping).runs[0]
    np.testing.assert_array_equal(run.qpos, read_logs(right, flyer).runs[0].qpos)

    path = save(tmp_path / "b.csv", columns | swapped)
    assert f"'{line}'" in said(read_logs(path, flyer), "w and x of the quaternion")
    notes = read_logs(path, flyer, mapping=mapping).notes
    assert not any("quaternion (" in note for note in notes)
    mapping.write_text("quaternions: {base: wxyz}")
    log = read_logs(path, flyer, mapping=mapping)
    assert not any("quaternion (" in note for note in log.notes)
    assert log.runs[0].qpos[0, 6] == 1.0


@pytest.mark.parametrize(
    ("orders", "words"),
    [
        ("{base: zyxw}", "not one of wxyz, xyzw"),
        ("{bas: xyzw}", 'did you mean "base"?'),
        ("{wheel: xyzw}", "which has none in the log"),
    ],
)
def test_wrong_orders(tmp_path, flyer, orders, words):
    mapping = tmp_path / "map.yaml"
    mapping.write_text(f"quaternions: {orders}")
    path = save(tmp_path / "a.csv", flyer_columns())
    assert words in failure(path, flyer, mapping=mapping)


def test_a_free_joint_without_a_name_is_called_after_its_body(tmp_path):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep=".01"/><worldbody><body name="trunk"><freejoint/>'
        '<geom size=".1"/><body><joint name="hip"/><geom size=".1"/></body></body>'
        "</worldbody></mujoco>"
    )
    names = [f"qpos.trunk.{i}" for i in range(7)]
    columns = {name: np.full(ROWS, float(i == 3)) for i, name in enumerate(names)}
    columns["qpos.hip"] = np.linspace(0.0, 0.1, ROWS)
    columns["qpos.trunk.0"] = np.linspace(0.0, 0.1, ROWS)
    columns["time"] = 0.01 * np.arange(ROWS)
    assert len(read_logs(save(tmp_path / "a.csv", columns), model).runs[0]) == ROWS
    text = failure(save(tmp_path / "b.csv", {"time": columns["time"]}), model)
    assert "if trunk was held" in text and "give --held-base" in text


def test_encoder_ticks_are_noticed(tmp_path, cart):
    columns = cart_columns()
    columns["qpos.pole"] = np.round(columns["qpos.pole"] * 4096 / (2 * np.pi))
    path = save(tmp_path / "a.csv", columns)
    note = said(read_logs(path, cart), "encoder ticks")
    line = "scale: {qpos.pole: 0.00153398}"
    assert f"'{line}' in a mapping file" in note
    (tmp_path / "map.yaml").write_text(line)
    log = read_logs(path, cart, mapping=tmp_path / "map.yaml")
    assert not any("encoder ticks" in note for note in log.notes)
    np.testing.assert_allclose(log.runs[0].qpos[:, 1], cart_columns()["qpos.pole"],
                               atol=1e-3)  # fmt: skip


@pytest.mark.parametrize(
    ("column", "factor", "words", "line"),
    [
        ("qvel.wrist", np.degrees(1), "in degrees per second?", "0.0174533"),
        ("qvel.wrist", 30 / np.pi, "in revolutions per minute?", "0.10472"),
        ("ctrl.drive", np.degrees(1), "in degrees?", "0.0174533"),
        ("qpos.wrist", np.degrees(1), "in degrees?", "0.0174533"),
        ("qpos.wrist", 1.0, "", ""),
    ],
)
def test_units_of_speeds_and_targets(tmp_path, column, factor, words, line):
    model = mujoco.MjModel.from_xml_string(TURN)
    time = 0.01 * np.arange(200)
    columns = {
        "time": time,
        "qpos.wrist": 0.1 * np.sin(5 * time),
        "qvel.wrist": 0.5 * np.cos(5 * time),
        "ctrl.drive": 0.11 * np.sin(5 * time + 0.2),
    }
    columns[column] = columns[column] * factor
    if column == "qpos.wrist":
        columns["qvel.wrist"] = columns["qvel.wrist"] * factor
    log = read_logs(save(tmp_path / "a.npz", columns), model)
    notes = [note for note in log.notes if "mapping file" in note]
    if not words:
        assert notes == []
        return
    (note,) = notes
    assert words in note and f"'scale: {{{column}: {line}}}'" in note


def test_targets_far_beyond_their_range_may_be_in_degrees(tmp_path):
    """Of a soft drive, too, whose joint hangs far behind them."""
    text = TURN.replace('name="drive"', 'name="drive" ctrlrange="-1 1"')
    model = mujoco.MjModel.from_xml_string(text)
    time = 0.01 * np.arange(200)
    columns = {
        "time": time,
        "qpos.wrist": 0.1 * np.sin(5 * time),
        "ctrl.drive": 50.0 * np.cos(5 * time),
    }
    log = read_logs(save(tmp_path / "a.npz", columns), model)
    (note,) = [n for n in log.notes if "control range" in n]
    assert "if it is in degrees" in note and "'scale: {ctrl.drive: " in note
    columns["ctrl.drive"] *= 0.03
    log = read_logs(save(tmp_path / "a.npz", columns), model)
    (note,) = [n for n in log.notes if "control range" in n]
    assert note.endswith("which MuJoCo clamps")


def test_only_a_base_may_have_been_held(tmp_path):
    """A load with a free joint carries nothing."""
    arm = CART.replace(
        "</worldbody>",
        '<body name="load"><freejoint/><geom size=".1"/></body></worldbody>',
    )
    model = mujoco.MjModel.from_xml_string(arm)
    refused = failure(save(tmp_path / "a.npz", cart_columns()), model)
    assert 'no column "qpos.load.0"' in refused
    assert "--held-base" not in refused and "--unmeasured load" in refused


# Files


def test_decimal_commas(tmp_path, cart):
    plain = save(tmp_path / "plain.csv", cart_columns())
    text = plain.read_text()
    path, mapping = tmp_path / "a.csv", tmp_path / "map.yaml"
    path.write_text(text.replace(",", ";").replace(".", ",").replace("qpos,", "qpos.")
                    .replace("ctrl,", "ctrl."))  # fmt: skip
    refused = failure(path, cart)
    assert 'row 1, column "time" holds "0,0"' in refused
    line = 'decimal: ","'
    assert f"'{line}' in a mapping file" in refused
    mapping.write_text(line)
    (run,) = read_logs(path, cart, mapping=mapping).runs
    (expected,) = read_logs(plain, cart).runs
    np.testing.assert_array_equal(run.qpos, expected.qpos)
    mapping.write_text('decimal: "x"')
    assert "decimal is 'x', not" in failure(path, cart, mapping=mapping)
    lines = text.splitlines()
    commas = [line.replace(".", ",") for line in lines[1:]]
    path.write_text("\n".join([lines[0], *commas]))
    assert 'separate columns by ";"' in failure(path, cart)


def test_comments_before_the_header(tmp_path, cart):
    """As people write them, and as ``np.savetxt(header=...)`` does."""
    plain = save(tmp_path / "plain.csv", cart_columns())
    (expected,) = read_logs(plain, cart).runs
    path, text = tmp_path / "a.csv", plain.read_text()
    for begins in ("# of Monday, with a new belt\n#\n", "# ", "# rig 2\n# "):
        path.write_text(begins + text)
        (run,) = read_logs(path, cart).runs
        np.testing.assert_array_equal(run.qpos, expected.qpos)
        np.testing.assert_array_equal(run.ctrl, expected.ctrl)
    path.write_text("# of Monday\n")
    assert "is empty" in failure(path, cart)
    path.write_text("# of Monday\n" + text.partition("\n")[2])
    assert "the first row must name the columns" in failure(path, cart)


@pytest.mark.parametrize("name", ["", "index", "Unnamed: 0"])
def test_index_columns_are_told(tmp_path, cart, name):
    columns = {name: np.arange(ROWS), **cart_columns()}
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    said(log, f'column "{name or "unnamed column 1"}" counts the rows')
    assert len(log.runs[0]) == ROWS


def test_an_index_that_the_header_lacks_and_a_separator_too_many(tmp_path, cart):
    path = save(tmp_path / "a.csv", {"i": np.arange(ROWS), **cart_columns()})
    path.write_text(path.read_text().removeprefix("i,"))
    log = read_logs(path, cart)
    said(log, 'column "unnamed column 1" counts the rows')
    np.testing.assert_array_equal(log.runs[0].time, cart_columns()["time"])
    path.write_text(path.read_text().replace("\n", ",\n").replace("time", ",time", 1))
    log = read_logs(path, cart)
    said(log, "columns ignored: unnamed column 6")


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_missing_empty_and_unreadable_files(tmp_path, cart, extension):
    path = tmp_path / f"a.{extension}"
    assert "no such file" in failure(path, cart)
    path.write_bytes(b"")
    assert "is empty" in failure(path, cart)
    path.write_bytes(b"\x93garbage \xff\xfe" * 50)
    assert f"a.{extension}" in failure(path, cart)
    path.unlink()
    path.mkdir()
    assert "folder" in failure(path, cart)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_files_cut_short_anywhere(tmp_path, cart, extension):
    whole = save(tmp_path / f"whole.{extension}", cart_columns()).read_bytes()
    path = tmp_path / f"a.{extension}"
    for share in np.linspace(0.02, 0.98, 25):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            log = read_logs(path, cart)
        except UserError as error:
            assert "\n" not in str(error)
            assert f"a.{extension}" in str(error)
        else:  # a CSV that ends inside its last number or after it
            assert extension == "csv"
            assert len(log.runs[0]) < ROWS
            if not path.read_bytes().endswith(b"\n"):
                assert said(log, "no line end")


@pytest.mark.parametrize("extension", ["npz", "parquet"])
def test_damaged_files(tmp_path, cart, extension):
    """Wherever bytes are wrong: an error of one line, or nothing of use was hit."""
    whole = save(tmp_path / f"whole.{extension}", cart_columns()).read_bytes()
    path = tmp_path / f"a.{extension}"
    rng = np.random.default_rng(0)
    errors = 0
    for _ in range(60):
        raw = bytearray(whole)
        for at in rng.integers(0, len(raw), 4):
            raw[at] = rng.integers(256)
        path.write_bytes(raw)
        try:
            read_logs(path, cart)
        except UserError as error:
            errors += 1
            assert "\n" not in str(error)
    assert errors > 10


def test_csv_row_of_another_length(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], "0.39,1.0"]))
    text = failure(path, cart)
    assert "row 40 has 2 cells where the header has 4" in text
    assert "cut short" in text
    path.write_text("\n".join([*lines[:5], "0.39,1.0", *lines[6:]]))
    text = failure(path, cart)
    assert "row 5 " in text
    assert "cut short" not in text


def test_damaged_npz_entry(tmp_path, cart):
    path = save(tmp_path / "a.npz", cart_columns())
    raw = bytearray(path.read_bytes())
    at = raw.index(b"NUMPY") + 150
    raw[at : at + 20] = bytes(20)
    path.write_bytes(raw)
    assert "damaged" in failure(path, cart)


def test_one_type_under_the_name_of_another(tmp_path, cart):
    for kind in EXTENSIONS:
        raw = save(tmp_path / f"true.{kind}", cart_columns()).read_bytes()
        for name in EXTENSIONS:
            if name != kind:
                path = tmp_path / f"false.{name}"
                path.write_bytes(raw)
                assert f"false.{name}" in failure(path, cart)
    path = tmp_path / "log.txt"
    path.write_text("time\n")
    assert ".csv, .npz, .parquet" in failure(path, cart)


@pytest.mark.fault("pickles and damaged archives")
def test_npy_and_pickles_are_refused(tmp_path, cart):
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    (tmp_path / "a.npz").write_bytes(buffer.getvalue())
    assert "not an NPZ" in failure(tmp_path / "a.npz", cart)
    columns = cart_columns()
    columns["qpos.pole"] = columns["qpos.pole"].astype(object)
    np.savez(tmp_path / "b.npz", **columns)
    text = failure(tmp_path / "b.npz", cart)
    assert "qpos.pole" in text
    assert "pickled" in text


def test_npz_arrays_of_other_shapes(tmp_path, cart):
    columns = cart_columns()
    np.savez(tmp_path / "a.npz", **{**columns, "qpos.pole": np.zeros((ROWS, 2))})
    assert "2-dimensional" in failure(tmp_path / "a.npz", cart)
    np.savez(tmp_path / "b.npz", **{**columns, "qpos.pole": np.zeros(ROWS - 1)})
    assert "39 rows where time has 40" in failure(tmp_path / "b.npz", cart)
    np.savez(tmp_path / "c.npz", **{**columns, "qpos.pole": np.zeros(ROWS) * 1j})
    assert "complex128" in failure(tmp_path / "c.npz", cart)


def test_text_and_encodings(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    text = path.read_text()
    path.write_text(text, encoding="utf-16")
    assert "UTF-8" in failure(path, cart)
    path.write_text(text, encoding="utf-8-sig")
    assert len(read_logs(path, cart).runs) == 1
    path.write_text(text.replace("\n", "\r\n") + "\r\n")
    assert len(read_logs(path, cart).runs[0]) == ROWS
    path.write_text(text.replace(",", ";"))
    assert len(read_logs(path, cart).runs[0]) == ROWS
    path.write_text(text.replace(",", ";").replace("0.01;", "0,01;"))
    assert "'decimal: \",\"' in a mapping file" in failure(path, cart)
    path.write_text(text.replace("0.03,", "start,"))
    assert 'row 4, column "time" holds "start"' in failure(path, cart)
    path.write_text(text.replace("0.03,", '"two\nlines",'))
    assert 'holds "two lines"' in failure(path, cart)
    path.write_text(text.split("\n", 1)[1])
    assert "name the columns" in failure(path, cart)
    path.write_text("\n\n")
    assert "is empty" in failure(path, cart)


def test_parquet_types(tmp_path, cart):
    columns = {k: pyarrow.array(v) for k, v in cart_columns().items()}
    columns["ctrl.drive"] = pyarrow.array(np.arange(ROWS) % 3, pyarrow.int8())
    columns["qpos.pole"] = columns["qpos.pole"].cast(pyarrow.float32())
    columns["run"] = pyarrow.array(["a"] * ROWS).dictionary_encode()
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    (run,) = read_logs(tmp_path / "a.parquet", cart).runs
    assert run.ctrl[4, 0] == 1.0
    columns["time"] = pyarrow.array(np.arange(ROWS), pyarrow.timestamp("ms"))
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "b.parquet")
    assert "timestamp" in failure(tmp_path / "b.parquet", cart)


# Mapping


def foreign(tmp_path: Path) -> Path:
    ours = cart_columns()
    return save(
        tmp_path / "foreign.csv",
        {
            "t_ms": 1000 * ours["time"],
            "x": ours["qpos.slider"],
            "theta_deg": np.degrees(ours["qpos.pole"]) + 90,
            "ctrl.drive": ours["ctrl.drive"],
        },
    )


MAPPING = """
columns:
  t_ms: time
  x: qpos.slider
  theta_deg: qpos.pole
scale:
  t_ms: 1e-3          # by their name; YAML takes this one for text
  qpos.pole: 0.017453292519943295
offset:
  qpos.pole: -1.5707963267948966
"""


def test_mapping(tmp_path, cart):
    path = tmp_path / "map.yaml"
    path.write_text(MAPPING)
    (run,) = read_logs(foreign(tmp_path), cart, mapping=path).runs
    ours = cart_columns()
    np.testing.assert_allclose(run.time, ours["time"], atol=1e-12)
    np.testing.assert_allclose(run.qpos[:, 1], ours["qpos.pole"], atol=1e-12)
    np.testing.assert_array_equal(run.qpos[:, 0], ours["qpos.slider"])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("columns:", "colums:", 'unknown key "colums"; did you mean "columns"?'),
        ("t_ms: time", "t_s: time", '"t_s" is not in'),
        ("t_ms: time", "t_ms: tim", 'no column "time"'),
        ("x: qpos.slider", "x: ctrl.drive", "two columns become"),
        ("qpos.pole: 0.01745", "qpos.pol: 0.01745", 'did you mean "qpos.pole"?'),
        ("1e-3 ", "fast ", "'fast', not a number"),
        ("1e-3 ", ".nan ", "not a number"),
        ("1e-3 ", "0 ", "is zero"),
        ("scale:", "scale: 2\nothers:", '"others"'),
        ("  t_ms: 1e-3 ", "  time: 2\n  t_ms: 1e-3 ", 'scale of "time" is given twice'),
        ("offset:", "scale:", 'in line 9 (key "scale" is there twice)'),
        ("x: qpos.slider", "x: [", "not valid YAML in line"),
        ("columns:", "!!python/object:os.system columns:", "not valid YAML"),
    ],
)
def test_bad_mappings(tmp_path, cart, old, new, words):
    path = tmp_path / "map.yaml"
    assert old in MAPPING
    path.write_text(MAPPING.replace(old, new, 1))
    assert words in failure(foreign(tmp_path), cart, mapping=path)


def test_joints_actuators_and_patterns(tmp_path, cart):
    """One schema with the imports: joints by name, patterns, and what is left out."""
    names = {"time": "time", "qpos.slider": "qpos.x", "qpos.pole": "qpos.y",
             "ctrl.drive": "ctrl.u"}  # fmt: skip
    columns = {names[k]: v for k, v in cart_columns().items()}
    columns |= {"qpos.gripper": np.zeros(ROWS), "qvel.y": np.ones(ROWS)}
    path = save(tmp_path / "a.csv", columns)
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "joints: {x: slider, y: pole, gripper: }\nactuators: {u: drive}\n"
        'scale: {"qpos.*": 2.0}\n'
    )
    (run,) = read_logs(path, cart, mapping=mapping).runs
    np.testing.assert_array_equal(run.qpos[:, 1], 2 * columns["qpos.y"])
    np.testing.assert_array_equal(run.qvel[:, 1], 1.0)
    np.testing.assert_array_equal(run.ctrl[:, 0], columns["ctrl.u"])
    mapping.write_text("joints: {x: slider, yy: pole}")
    assert 'joints name "yy" is not in' in failure(path, cart, mapping=mapping)


def test_mapping_files_that_are_none(tmp_path, cart):
    path = tmp_path / "map.yaml"
    assert "cannot be read" in failure(foreign(tmp_path), cart, mapping=path)
    path.write_text("- 1\n")
    assert '"columns:"' in failure(foreign(tmp_path), cart, mapping=path)
    path.write_bytes(b"\xff\xfe")
    assert "UTF-8" in failure(foreign(tmp_path), cart, mapping=path)
    path.write_text("columns: 3\n")
    assert '"columns:" must hold' in failure(foreign(tmp_path), cart, mapping=path)


# Real machines


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is not here")
@pytest.mark.parametrize(
    ("folder", "rates", "runs"),
    [
        ("dfki_pendulum", {200.0, 500.0}, 4),
        ("emps", {1000.0}, 2),
        ("quanser_cartpole", {250.0}, 16),
    ],
)
def test_real_logs(folder, rates, runs):
    model = mujoco.MjModel.from_xml_path(str(SHARED / folder / "model.xml"))
    log = read_logs(sorted((SHARED / folder).glob("*.csv")), model)
    assert len(log.runs) == runs
    assert {round(1 / run.dt) for run in log.runs} == rates
    for run in log.runs:
        assert len(run) > 500
        for values in (run.qpos, run.qvel, run.ctrl):
            assert np.isfinite(values).all()


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_pipe_or_a_device_is_not_waited_for(tmp_path, cart, extension):
    path = tmp_path / f"log.{extension}"
    os.mkfifo(path)
    assert "a pipe or a device" in failure(path, cart)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "a pipe or a device" in failure(path, cart)


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999999999999,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
        "{'descr': ((((",
        "[[[[[[[[",
        "{{}: 1}",
        "'a' 'b",
    ],
)
def test_npz_headers_that_numpy_trips_over(tmp_path, cart, header):
    path = save(tmp_path / "a.npz", cart_columns())
    text = header.encode().ljust(117) + b"\n"
    with zipfile.ZipFile(path, "a") as archive:
        raw = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
        archive.writestr("other.npy", raw)
    assert "not an NPZ file, damaged or cut short" in failure(path, cart)


@pytest.mark.parametrize("extension", ["npz", "parquet"])
def test_files_that_unpack_to_more_than_a_log(tmp_path, cart, extension, monkeypatch):
    path = save(tmp_path / f"a.{extension}", cart_columns())
    monkeypatch.setattr(log_tables, "_LARGEST", 1000)
    assert "when unpacked, more than a log has" in failure(path, cart)


@pytest.mark.parametrize("column", ["time", "run"])
def test_parquet_text_that_is_no_utf8(tmp_path, cart, column):
    columns = {k: pyarrow.array(v) for k, v in cart_columns(3).items()}
    columns[column] = pyarrow.array([b"\xff", b"1", b"2"]).view(pyarrow.string())
    path = tmp_path / "a.parquet"
    pyarrow.parquet.write_table(pyarrow.table(columns), path)
    assert "not a Parquet file, damaged or cut short" in failure(path, cart)


@pytest.mark.timeout(120)
def test_a_run_column_that_counts_rows_is_refused_soon(tmp_path, flyer):
    """Time went with the square of the number of recordings."""
    rows = 30_000
    names = [f"qpos.base.{i}" for i in range(7)] + [f"qpos.wrist.{i}" for i in range(4)]
    columns = {name: np.full(rows, 0.5) for name in [*names, "qpos.wheel"]}
    columns |= {"time": 0.01 * np.arange(rows), "run": np.arange(rows)}
    path = save(tmp_path / "a.npz", columns)
    assert "no two successive rows" in failure(path, flyer)


def test_mapping_numbers_beyond_float(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    mapping = tmp_path / "m.yaml"
    mapping.write_text("scale: {time: 0x" + "f" * 400 + "}")
    assert "not a number" in failure(path, cart, mapping=mapping)


def test_rows_closer_than_a_step_between_holes_are_no_run(tmp_path, cart):
    columns = cart_columns(200)
    columns["time"] += 1e-3 * np.sin(7 * np.arange(200))
    columns["time"][100] = columns["time"][99] + 1e-3
    columns["qpos.pole"][[98, 101]] = np.nan
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    assert [len(run) for run in log.runs] == [98, 98]
    assert "alone between holes: 1" in said(log, "alone")


def test_runs_of_one_file_name_in_two_folders_are_told_apart(tmp_path, cart):
    for day in ("one", "two"):
        (tmp_path / day).mkdir()
        save(tmp_path / day / "run.csv", cart_columns())
    first, other = tmp_path / "one/run.csv", tmp_path / "two/run.csv"
    (run,) = read_logs(first, cart, beside=[other]).runs
    assert run.name == first.as_posix()
    (run,) = read_logs(first, cart, beside=[tmp_path / "two/held.csv"]).runs
    assert run.name == "run"


def test_codes_of_errors_are_no_readings(tmp_path, cart):
    rows = 400
    read = np.sin(0.1 * np.arange(rows))
    shaken = np.stack([read, 0.5 * read, 9.81 + read])
    shaken[2, 200] = 60.0  # a shock is a reading
    columns = cart_columns(rows) | {f"sensor.imu.{i}": shaken[i] for i in range(3)}
    columns |= {"sensor.encoder": read.copy()}
    columns["sensor.encoder"][[7, 50, 51]] = -9999.0, 65535.0, 65535.0
    log = read_logs(save(tmp_path / "a.csv", columns), cart)
    (run,) = log.runs
    gone = np.flatnonzero(~np.isfinite(run.sensors["encoder"][:, 0]))
    assert gone.tolist() == [7, 50, 51]
    assert np.isfinite(run.sensors["imu"]).all()
    note = said(log, "encoder")
    assert "3 of 400 readings" in note and "-9999, is in row 8" in note
    assert "imu" not in note
    # Two odd values beside each other are a shock.
    columns["sensor.encoder"][[7, 50, 51]] = 0.0, 400.0, 300.0
    (run,) = read_logs(save(tmp_path / "b.csv", columns), cart).runs
    assert np.isfinite(run.sensors["encoder"]).all()
    columns["sensor.encoder"][:] = 1e20
    assert '"sensor.encoder" holds 1e+20' in failure(
        save(tmp_path / "c.csv", columns), cart
    )


def test_a_spreadsheets_line_on_its_separator(tmp_path, cart):
    path = save(tmp_path / "a.csv", cart_columns())
    lines = path.read_text().replace(",", ";")
    path.write_bytes(b"\xef\xbb\xbfsep=;\r\n" + lines.encode())
    (run,) = read_logs(path, cart).runs
    assert len(run) == ROWS

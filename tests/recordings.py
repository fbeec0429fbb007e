"""Small recordings in foreign formats, by those formats' own libraries or by hand."""

import json
import pickle
import struct
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet

MODEL = """
<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <body name="cart"><joint name="slider" type="slide" range="-1 1" limited="true"/>
    <geom size=".1"/>
    <body><joint name="pole" type="hinge"/><geom size=".1"/></body></body>
</worldbody>
<actuator><motor name="drive" joint="slider" ctrlrange="-5 5" ctrllimited="true"/>
</actuator><sensor><jointactuatorfrc name="force" joint="slider"/></sensor></mujoco>
"""
STEP = 0.01
START = 1_700_000_000_000_000_000  # ns


def motion(rows: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (s), positions of slider and pole, their velocities, a command."""
    time = STEP * np.arange(rows)
    qpos = np.stack([0.3 * np.sin(3 * time), 0.5 * np.cos(2 * time)], 1)
    qvel = np.stack([0.9 * np.cos(3 * time), -np.sin(2 * time)], 1)
    return time, qpos, qvel, 0.1 * np.arange(1.0, rows + 1)


class Ros:
    """Messages of the types that are read; collected, then written."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.messages: list[tuple[str, str, int, Any]] = []

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def _header(self, nanoseconds: int) -> Any:
        sec, nanosec = divmod(nanoseconds, 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def joints(
        self,
        at: float,
        names: Sequence[str],
        position: Iterable[float] = (),
        velocity: Iterable[float] = (),
        effort: Iterable[float] = (),
        topic: str = "/joint_states",
        stamp: float | None = None,
    ) -> None:
        kind = "sensor_msgs/msg/JointState"
        stamped = START + round((at if stamp is None else stamp) * 1e9)
        message = self._make(
            kind,
            header=self._header(0 if stamp == -1 else stamped),
            name=list(names),
            position=np.array(list(position), float),
            velocity=np.array(list(velocity), float),
            effort=np.array(list(effort), float),
        )
        self._add(topic, kind, at, message)

    def array(self, at: float, data: Iterable[float], topic: str = "/commands") -> None:
        kind = "std_msgs/msg/Float64MultiArray"
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        values = np.array(list(data), float)
        self._add(topic, kind, at, self._make(kind, layout=layout, data=values))

    def text(self, at: float, text: str, topic: str = "/chatter") -> None:
        kind = "std_msgs/msg/String"
        self._add(topic, kind, at, self._make(kind, data=text))

    def point(self, at: float, topic: str = "/point", **fields: Any) -> None:
        kind = "trajectory_msgs/msg/JointTrajectoryPoint"
        self._add(topic, kind, at, self._point(**fields))

    def trajectory(
        self,
        at: float,
        names: Sequence[str],
        points: Sequence[dict[str, Any]],
        topic: str = "/trajectory",
    ) -> None:
        kind = "trajectory_msgs/msg/JointTrajectory"
        message = self._make(
            kind,
            header=self._header(0),
            joint_names=list(names),
            points=[self._point(**point) for point in points],
        )
        self._add(topic, kind, at, message)

    def _point(self, after: float = 0.0, **fields: Iterable[float]) -> Any:
        values = {
            name: np.array(list(fields.get(name, ())), float)
            for name in ("positions", "velocities", "accelerations", "effort")
        }
        sec, nanosec = divmod(round(after * 1e9), 10**9)
        kind = "builtin_interfaces/msg/Duration"
        duration = self._make(kind, sec=sec, nanosec=nanosec)
        return self._make(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            **values,
            time_from_start=duration,
        )

    def _add(self, topic: str, kind: str, at: float, message: Any) -> None:
        self.messages.append((topic, kind, START + round(at * 1e9), message))

    def write(self, folder: Path, mcap: bool = True) -> Path:
        """A rosbag2 folder, its storage an MCAP file or SQLite."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        with Writer(folder, version=9, storage_plugin=plugin) as writer:
            topics: dict[str, Any] = {}
            for topic, kind, at, message in self.messages:
                if topic not in topics:
                    topics[topic] = writer.add_connection(
                        topic, kind, typestore=self.store
                    )
                data = self.store.serialize_cdr(message, kind)
                writer.write(topics[topic], at, data)
        return folder


def lerobot(
    folder: Path,
    version: str = "v3.0",
    episodes: int = 2,
    names: Sequence[str] | None = ("slider.pos", "pole.pos"),
    rows: int = 30,
    changes: Mapping[str, Any] | None = None,
) -> Path:
    """A dataset of equal episodes; ``changes`` replaces columns."""
    time, qpos, _, ctrl = motion(rows)
    parts = []
    for episode in range(episodes):
        columns: dict[str, Any] = {
            "observation.state": pyarrow.array(qpos.astype(np.float32).tolist()),
            "action": pyarrow.array((ctrl + episode)[:, None].tolist()),
            "timestamp": pyarrow.array(time.astype(np.float32)),
            "frame_index": np.arange(rows),
            "episode_index": np.full(rows, episode),
        }
        columns |= dict(changes or {})
        parts.append(pyarrow.table(columns))
    state = {"dtype": "float32", "shape": [2], "names": None}
    if names is not None:
        state["names"] = {"motors": list(names)} if "v2" in version else list(names)
    info = {
        "codebase_version": version,
        "fps": round(1 / STEP),
        "features": {
            "observation.state": state,
            "action": {"dtype": "float32", "shape": [1], "names": ["slider.pos"]},
            "observation.images.top": {"dtype": "video", "shape": [48, 64, 3]},
        },
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if "v3" in version:
        parts = [pyarrow.concat_tables(parts)]
    for i, table in enumerate(parts):
        name = f"file-{i:03d}" if "v3" in version else f"episode_{i:06d}"
        pyarrow.parquet.write_table(table, chunk / f"{name}.parquet")
    return folder


def minari(
    folder: Path, episodes: int = 2, rows: int = 30, actions: int | None = None
) -> Path:
    """A dataset folder by hand; observations are positions, then velocities."""
    import h5py

    _, qpos, qvel, ctrl = motion(rows + 1)
    (folder / "data").mkdir(parents=True)
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        file.attrs["total_episodes"] = episodes
        for i in range(episodes):
            group = file.create_group(f"episode_{i}")
            group.attrs["id"] = i
            group.attrs["total_steps"] = rows
            group["observations"] = np.concatenate([qpos, qvel], 1)
            group["actions"] = ctrl[: actions or rows, None]
            group["rewards"] = np.zeros(rows)
            group["truncations"] = np.zeros(rows, bool)
            infos = group.create_group("infos")
            infos["force"] = np.arange(rows + 1.0)
    return folder


def written_by_minari(name: str, episodes: int = 2) -> None:
    """The same by Minari itself, below ``MINARI_DATASETS_PATH``; actions grow by 1."""
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer

    _, qpos, qvel, ctrl = motion()
    box = gymnasium.spaces.Box
    several: Any = EpisodeBuffer  # its hints know lists and trees of arrays alone
    buffer = [
        several(
            id=episode,
            observations=np.concatenate([qpos, qvel], 1),
            actions=ctrl[:-1, None] + episode,
            rewards=[0.0] * (len(ctrl) - 1),
            terminations=[False] * (len(ctrl) - 1),
            truncations=[False] * (len(ctrl) - 1),
        )
        for episode in range(episodes)
    ]
    minari.create_dataset_from_buffers(
        name,
        buffer,
        action_space=box(-9, 9, (1,), np.float64),
        observation_space=box(-9, 9, (4,), np.float64),
    )


_STORAGES = {"f4": "FloatStorage", "f8": "DoubleStorage", "i8": "LongStorage"}


def torch_zip(
    path: Path, tensors: Mapping[str, np.ndarray], program: bytes | None = None
) -> Path:
    """A file as ``torch.save`` writes it, made by hand, for tests without torch."""
    body = b"\x80\x02}("
    storages: list[bytes] = []
    for name, values in tensors.items():
        kind = _STORAGES[values.dtype.str[1:]]
        storage = b"(" + _text("storage") + f"ctorch\n{kind}\n".encode()
        storage += _text(str(len(storages))) + _text("cpu") + _int(values.size)
        strides = [s // values.itemsize for s in values.strides]
        body += _text(name) + b"ctorch._utils\n_rebuild_tensor_v2\n("
        body += storage + b"tQ" + _int(0)
        body += b"(" + b"".join(map(_int, values.shape)) + b"t"
        body += b"(" + b"".join(map(_int, strides)) + b"t"
        body += b"\x89ccollections\nOrderedDict\n)RtR"
        storages.append(np.ravel(values, "K").tobytes())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", program or body + b"u.")
        archive.writestr("archive/byteorder", "little")
        for i, raw in enumerate(storages):
            archive.writestr(f"archive/data/{i}", raw)
        archive.writestr("archive/version", "3\n")
    return path


def _text(text: str) -> bytes:
    raw = text.encode()
    return pickle.BINUNICODE + struct.pack("<I", len(raw)) + raw


def _int(value: int) -> bytes:
    return pickle.BININT + struct.pack("<i", value)


def pace(rows: int = 30) -> dict[str, np.ndarray]:
    """What a PACE recording holds, two joints."""
    time, qpos, _, ctrl = motion(rows)
    return {
        "time": time.astype(np.float32),
        "dof_pos": qpos.astype(np.float32),
        "des_dof_pos": np.stack([ctrl, 0 * ctrl], 1).astype(np.float32),
    }

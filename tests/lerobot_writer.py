"""Writes a dataset with LeRobot itself, in whose environment it runs (see below).

LeRobot needs an older numpy than this project, so its package lives elsewhere:
``python -m venv V && V/bin/pip install lerobot``, then ``LEROBOT_PYTHON=V/bin/python``.
"""

import sys
from pathlib import Path

import numpy as np


def write(episodes: Path, folder: Path, fps: int) -> None:
    """``episodes``: NPZ of ``state`` (E, N, 2) and ``action`` (E, N, 1), float32."""
    from lerobot.datasets.lerobot_dataset import (  # pyright: ignore[reportMissingImports]
        LeRobotDataset,
    )

    names = {"observation.state": ["slider.pos", "pole.pos"], "action": ["slider.pos"]}
    features = {
        key: {"dtype": "float32", "shape": (len(value),), "names": value}
        for key, value in names.items()
    }
    dataset = LeRobotDataset.create(
        "test/cart", fps=fps, features=features, root=folder, use_videos=False
    )
    with np.load(episodes) as file:
        for state, action in zip(file["state"], file["action"], strict=True):
            for row, command in zip(state, action, strict=True):
                frame = {"observation.state": row, "action": command, "task": "sweep"}
                dataset.add_frame(frame)
            dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    write(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))

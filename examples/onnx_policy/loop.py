"""Drives a robot with a policy that train.export wrote: numpy and onnxruntime suffice.

    python loop.py policy.onnx my_robot.py

my_robot.py has ``read() -> {name: value}``, the observation by name (those in
policy.json), and ``send(commands)``, a dict by actuator; units are SI.
"""

import importlib.util
import json
import sys
import time

import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
told = session.get_modelmeta().custom_metadata_map
names, drives, dt = (json.loads(told[k]) for k in ("observation", "ctrl", "dt"))
spec = importlib.util.spec_from_file_location("my_robot", sys.argv[2])
robot = importlib.util.module_from_spec(spec)
spec.loader.exec_module(robot)
if "ctrl" not in [output.name for output in session.get_outputs()]:
    sys.exit(f"{sys.argv[1]} has no commands: its robot has no action_map")
steps = int(sys.argv[3]) if len(sys.argv) > 3 else None  # for ever where not given

due = time.monotonic()
while steps is None or steps > 0:
    now = robot.read()
    observation = np.array([[now[name] for name in names]], np.float32)
    (ctrl,) = session.run(["ctrl"], {"observation": observation})
    robot.send(dict(zip(drives, ctrl[0].tolist(), strict=True)))
    steps = None if steps is None else steps - 1
    due = max(due + dt, time.monotonic())  # what a stall missed is not made up for
    time.sleep(max(0.0, due - time.monotonic()))

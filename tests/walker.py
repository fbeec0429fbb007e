"""A small robot on four stiff legs that logs its joints and an inertial unit."""

from dataclasses import replace

import mujoco
import numpy as np

from easi_jax.data.recording import Run
from easi_jax.data.unmeasured import with_guess
from easi_jax.model.joint_space import Configuration

_LEG = """<body name="{name}" pos="{x} {y} 0">
  <joint name="{name}" axis="0 1 0" damping="0.05" armature="0.05" range="-60 60"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
  <geom name="{name}_foot" type="sphere" pos="0 0 -0.2" size="0.03" mass="0.05"
        contype="1" conaffinity="1"/>
  <site name="{name}_foot" type="sphere" pos="0 0 -0.2" size="0.035"/>
</body>"""
_LEGS = {"a": (0.2, 0.1), "b": (0.2, -0.1), "c": (-0.2, 0.1), "d": (-0.2, -0.1)}
XML = f"""<mujoco model="walker">
  <option timestep="0.005" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" contype="1" conaffinity="1"/>
    <body name="base" pos="0 0 0.23">
      <freejoint name="root"/>
      <geom type="box" size="0.2 0.1 0.05" mass="3"/>
      <site name="imu" pos="0.05 0 0.02" euler="0 0 30"/>
      {"".join(_LEG.format(name=n, x=x, y=y) for n, (x, y) in _LEGS.items())}
    </body>
  </worldbody>
  <actuator>
    {"".join(f'<position name="{n}" joint="{n}" kp="20" kv="1"/>' for n in _LEGS)}
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <framequat name="orientation" objtype="site" objname="imu"/>
    <touch name="foot" site="a_foot"/>
    <framepos name="place" objtype="site" objname="imu"/>
  </sensor>
</mujoco>"""
PARAMETERS = """parameters:
- {name: kp, address: actuator.*.kp, initial: [10, 40]}
- {name: kv, address: actuator.*.kv, initial: [0.5, 2.0]}
"""
DT = 0.02


def in_a_stand(seconds: float = 8.0, kp: float = 26.0, kv: float = 0.8) -> str:
    """A log of the joints, as text, of the robot with its base held."""
    machine = _with_gains(
        mujoco.MjModel.from_xml_string(XML.replace('<freejoint name="root"/>', "")),
        *(kp, kv),
    )
    data, rng = mujoco.MjData(machine), np.random.default_rng(9)
    names = ("qpos", "qvel", "ctrl")
    lines = [",".join(["time", *(f"{k}.{leg}" for k in names for leg in _LEGS)])]
    for k in range(round(seconds / DT)):
        t = k * DT
        data.ctrl = 0.3 * np.sin(np.arange(2, 6) * t) + 0.1 * np.sign(np.sin(3 * t))
        noisy = data.qpos + 1e-4 * rng.standard_normal(4)
        speed = data.qvel + 1e-2 * rng.standard_normal(4)
        row = np.concatenate([[t], noisy, speed, data.ctrl])
        lines.append(",".join(f"{x:.8g}" for x in row))
        mujoco.mj_step(machine, data, round(DT / machine.opt.timestep))
    return "\n".join(lines) + "\n"


def _with_gains(m: mujoco.MjModel, kp: float, kv: float) -> mujoco.MjModel:
    m.actuator_gainprm[:, 0], m.actuator_biasprm[:, 1] = kp, -kp
    m.actuator_biasprm[:, 2] = -kv
    return m


def walk(
    seconds: float = 12.0,
    kp: float = 26.0,
    kv: float = 0.8,
    seed: int = 0,
    kept: bool = False,
) -> tuple[mujoco.MjModel, Run]:
    """The model as given, and a log of one with other gains; its base is hidden
    unless it is ``kept``."""
    model, machine = (mujoco.MjModel.from_xml_string(XML) for _ in range(2))
    machine = _with_gains(machine, kp, kv)
    data, rng = mujoco.MjData(machine), np.random.default_rng(seed)
    rows = []
    phase = np.array([0.0, np.pi, np.pi, 0.0])
    for k in range(round(seconds / DT)):
        t = k * DT
        data.ctrl = 0.3 * np.sin(2 * np.pi * 1.5 * t + phase + np.sin(0.9 * t))
        data.ctrl += 0.15 * np.sign(np.sin(2 * np.pi * 0.7 * t + 1.3 * phase))
        mujoco.mj_forward(machine, data)
        read = data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()
        rows.append((*read, data.sensordata.copy()))
        mujoco.mj_step(machine, data, round(DT / machine.opt.timestep))
    qpos, qvel, ctrl, read = (np.array(x) for x in zip(*rows, strict=True))
    noise = rng.standard_normal((len(qpos), 8))
    qpos[:, 7:] += 1e-4 * noise[:, :4]
    qvel[:, 6:] += 1e-2 * noise[:, 4:]
    names = {"gyro": 3, "orientation": 4, "foot": 1, "place": 3}
    ends = np.cumsum(list(names.values()))[:-1]
    run = Run(
        name="walk",
        source="walk",
        dt=DT,
        time=DT * np.arange(len(qpos)),
        qpos=qpos,
        qvel=qvel,
        qvel_measured=True,
        ctrl=ctrl,
        configuration=Configuration.of(model),
        sensors=dict(zip(names, np.split(read, ends, axis=1), strict=True)),
    )
    if kept:
        return model, run
    hidden = np.arange(model.nv) < 6
    return model, with_guess(model, replace(run, hidden=hidden))

"""Named sensors of a model: of what kind they are, and in what units they read."""

import mujoco

from easi_jax.model.quantities import joint_unit

_UNITS = {
    "m": (
        *("FRAMEPOS", "SUBTREECOM", "RANGEFINDER", "GEOMDIST"),
        *("TENDONPOS", "TENDONLIMITPOS"),
    ),
    "m/s": (
        *("VELOCIMETER", "FRAMELINVEL", "SUBTREELINVEL"),
        *("TENDONVEL", "TENDONLIMITVEL"),
    ),
    "m/s^2": ("ACCELEROMETER", "FRAMELINACC"),
    "rad/s": ("GYRO", "FRAMEANGVEL", "BALLANGVEL"),
    "rad/s^2": ("FRAMEANGACC",),
    "N": ("TOUCH", "FORCE", "TENDONACTFRC", "TENDONLIMITFRC"),
    "N m": ("TORQUE",),
    "kg m^2/s": ("SUBTREEANGMOM",),
    "J": ("E_POTENTIAL", "E_KINETIC"),
}
_UNIT = {kind: unit for unit, kinds in _UNITS.items() for kind in kinds}
_OF_JOINTS = {
    **dict.fromkeys(("JOINTPOS", "JOINTLIMITPOS", "ACTUATORPOS"), ("m", "rad")),
    **dict.fromkeys(("JOINTVEL", "JOINTLIMITVEL", "ACTUATORVEL"), ("m/s", "rad/s")),
    **dict.fromkeys(("JOINTACTFRC", "JOINTLIMITFRC", "ACTUATORFRC"), ("N", "N m")),
}
_JOINT = mujoco.mjtTrn.mjTRN_JOINT


def sensor_kind(m: mujoco.MjModel, i: int) -> str:
    """Type of a sensor as MuJoCo names it, such as ``GYRO``."""
    return mujoco.mjtSensor(int(m.sensor_type[i])).name.removeprefix("mjSENS_")


def sensor_columns(m: mujoco.MjModel, i: int) -> slice:
    """Where a sensor's numbers are in ``sensordata``."""
    return slice(m.sensor_adr[i], m.sensor_adr[i] + m.sensor_dim[i])


def sensor_unit(m: mujoco.MjModel, i: int) -> str:
    """SI unit of a sensor's numbers; empty where they have none, or it is not known."""
    kind = sensor_kind(m, i)
    if kind not in _OF_JOINTS:
        return _UNIT.get(kind, "")
    joint = int(m.sensor_objid[i])
    if kind.startswith("ACTUATOR"):
        if m.actuator_trntype[joint] != _JOINT:
            return ""
        joint = int(m.actuator_trnid[joint, 0])
    return joint_unit(*_OF_JOINTS[kind])(m, joint)


def reads_joints(m: mujoco.MjModel, i: int) -> bool:
    """Whether a sensor is an encoder of a joint, which no geometry has a part in."""
    kind = sensor_kind(m, i)
    return kind.startswith("JOINT") and kind.endswith(("POS", "VEL"))

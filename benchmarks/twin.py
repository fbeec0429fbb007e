"""Twins: what stands here for the paper's real Cartpole and real Go2.

A twin is NOT hardware. It is a second simulation, MuJoCo C at 0.5 ms, of a robot with
effects that the MJX model of it lacks: Stribeck friction in the drives, commands that
come late, a motor whose force falls with speed, weaker drives, further inertia, other
contact, sensors with noise and resolution. What is measured on it is evidence for
transfer from one simulator to a richer one, and no more.

The constants below were chosen once, from what is published of such machines, before
anything was run on a twin, and are not tuned.
"""

import copy
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np

from envs.go2 import KNEE_REDUCTION, MOTOR


def _nothing(model: mujoco.MjModel) -> None:
    del model


@dataclass(frozen=True)
class Motor:
    """Force or torque that a drive can give at a speed; arrays are ``(nu,)``."""

    corner: Any
    """Speed up to which all of it is there [m/s, rad/s]."""
    free: Any
    """Speed at which none is left."""
    driving: Any
    """Most with the motion [N, N m]."""
    braking: Any
    """Most against the motion [N, N m]."""

    def limits(self, speed: np.ndarray) -> np.ndarray:
        """Least and most at drive speeds ``(nu,)``, ``(nu, 2)``."""
        left = (self.free - np.abs(speed)) / (np.subtract(self.free, self.corner))
        drive = self.driving * np.clip(left, 0.0, 1.0)
        most = np.where(speed > 0, drive, self.braking)
        least = np.where(speed < 0, drive, self.braking)
        return np.stack([-least, most], axis=1)


@dataclass(frozen=True)
class Gap:
    """What a twin has and the model lacks; without arguments, nothing.

    Numbers are for all drives, arrays ``(nu,)`` for each, or ``(nv,)`` where they are
    of sensors.
    """

    timestep: float = 5e-4
    """Physics step [s]."""
    delay: float = 0.0
    """Time from a reading to the command that it led to reaching the drive [s]."""
    gain: Any = 1.0
    """Share of the force that the drive's own controller asks for."""
    static: Any = 0.0
    """Friction of a drive that hardly moves [N, N m]."""
    kinetic: Any = 0.0
    """Friction of a drive that moves fast [N, N m]."""
    stribeck: float = 1.0
    """Speed at which the one turns into the other [m/s, rad/s]."""
    viscous: Any = 0.0
    """Friction per speed [N s/m, N m s/rad]."""
    motor: Motor | None = None
    """What the motor can give; the model's own limits of force and speed without."""
    change: Callable[[mujoco.MjModel], None] = _nothing
    """What else differs: masses, contact."""
    noise: Any = 0.0
    """Standard deviation of a position reading [m, rad]."""
    quantum: Any = 0.0
    """Resolution of a position reading; 0: none; free and ball joints have none."""
    window: float = 0.0
    """A measured speed is the difference of two readings this far apart over that
    time [s]; 0: the true speed."""


def _cart(model: mujoco.MjModel) -> None:
    model.dof_armature[model.joint("cart").dofadr] += 0.12


def _robot(model: mujoco.MjModel) -> None:
    model.body_mass[model.body("base").id] += 1.0
    floor = model.geom("floor").id
    model.geom_friction[floor] = 0.8, 0.02, 0.01
    model.geom_solimp[floor, :3] = 0.015, 1.0, 0.031
    model.geom_condim[floor] = 6
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model.opt.impratio = 100.0


CARTPOLE = Gap(
    delay=0.010,
    gain=0.85,
    static=0.44,
    kinetic=0.33,
    stribeck=0.01,
    viscous=0.3,
    motor=Motor(0.45 * 0.6, 0.6, 5.0, 5.0 * MOTOR[3] / MOTOR[2]),
    change=_cart,
    noise=np.array([5e-5, 5e-4]),
    quantum=np.array([2.28e-5, 2 * np.pi / 4096]),
    window=0.02,
)
"""The cart-pole's.

- delay: half a control step; fits of a real cart-pole's logs (Quanser's, recorded for
  SimuRLacra) lie between 4 and 17 ms.
- gain: the weakest of the drives that SPI-Active identified on robots (0.85).
- kinetic: the rail friction that `train.gap` names in that real cart-pole's logs
  (``results/gap_real_cartpole.json``: 0.33 N); static a third more; they meet within a
  centimeter a second, as for dry bearings.
- viscous: as much again as the paper's drive damping.
- motor: the paper's 5 N and 0.6 m/s as the ends of a real motor's curve, shaped like
  the Go2's (full up to 0.45 of the free speed).
- inertia: 0.12 kg of rotor through the gear, the same cart-pole's by its maker's
  constants.
- encoders: that cart-pole's, 4,096 a turn at the pole and 22.8 um at the cart, on a
  mount that shakes by a third of a count of the pole; speeds are differences over a
  control step.
"""

_KNEES = np.tile([1.0, 1.0, KNEE_REDUCTION], 4)
_CORNER, _FREE, _DRIVING, _BRAKING = MOTOR

GO2 = Gap(
    delay=0.015,
    gain=np.tile([0.85, 0.89, 0.93], 4),
    static=0.5 * _KNEES,
    kinetic=0.3 * _KNEES,
    stribeck=0.1,
    viscous=0.05 * _KNEES**2,
    motor=Motor(_CORNER / _KNEES, _FREE / _KNEES, _DRIVING * _KNEES, _BRAKING * _KNEES),
    change=_robot,
    noise=np.array([*[2e-4] * 3, *[5e-4] * 3, *[1e-4] * 12]),
    quantum=np.array([*[0.0] * 6, *[2 * np.pi / 2**15] * 12]),
    window=0.005,
)
"""The Go2's.

- delay: 10 ms there and 5 ms back; published controllers assume 5 to 45 ms.
- gain: the weaker end of what SPI-Active identified on the Go2 (hip 0.85, thigh 0.89,
  calf 0.93).
- friction: no measured figure is public. Static 0.5 N m and viscous 0.05 N m s/rad are
  the share of the rated torque that the maker's G1 motors have; kinetic 0.3 N m is
  MuJoCo Playground's for the Go1. The knee's further reduction multiplies them.
- motor: the maker's torque-speed curve (`envs.go2.MOTOR`), which the model leaves out.
- mass: 1 kg of computer on the base (DIAL-MPC's Go2).
- contact: MuJoCo Menagerie's soft rubber foot: friction 0.8 with torsion and rolling,
  elliptic cone, next to no creep.
- readings: 15-bit joint encoders, and a state estimator of the base whose speeds come
  out with about the noise that MuJoCo Playground trains against (0.06 m/s,
  0.14 rad/s); speeds are differences over 5 ms.
"""

_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)

GAPS = {"cartpole": CARTPOLE, "go2": GO2}


@dataclass
class Episode:
    """A twin in motion.

    Attributes:
        data: MuJoCo's.
        sent: commands on their way, the last one last.
        before: positions one ``window`` ago.
    """

    data: mujoco.MjData
    sent: deque[np.ndarray]
    before: np.ndarray


class Twin:
    """A built-in robot in MuJoCo C, with a `Gap`; not hardware.

    Args:
        env: the robot; actuators are position drives on hinges or slides.
        gap: what the twin has and the model lacks.
    """

    def __init__(self, env: Any, gap: Gap) -> None:
        self.env, self.gap = env, gap
        m = self.model = copy.copy(env.mj_model)
        self.parts = round(env.dt / gap.timestep)
        m.opt.timestep = env.dt / self.parts
        m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = 100, 50, 1e-12
        joints = m.actuator_trnid[:, 0]
        self._dof, self._pos = m.jnt_dofadr[joints], m.jnt_qposadr[joints]
        m.actuator_gainprm *= np.reshape(gap.gain, (-1, 1))
        m.actuator_biasprm *= np.reshape(gap.gain, (-1, 1))
        m.dof_damping[self._dof] += gap.viscous
        gap.change(m)
        mujoco.mj_setConst(m, mujoco.MjData(m))
        self._friction, self._limits = m.dof_frictionloss, m.actuator_forcerange
        self._kinetic = m.dof_frictionloss[self._dof] + gap.kinetic
        self._further = np.subtract(gap.static, gap.kinetic)
        self._rubs = bool(np.any(gap.static) or np.any(gap.kinetic))
        # MuJoCo has no speed limit: the model's is a clip, a motor's is its curve.
        self._clip = None
        if gap.motor is None:
            self._clip = np.asarray(jax.jit(lambda: env.model().speed_limit)(), float)
        self._late = divmod(round(gap.delay / m.opt.timestep), self.parts)
        self._back = round(gap.window / m.opt.timestep)
        if self._back > self.parts:
            raise ValueError("speeds are measured over one control step at most")
        self._scalar = ~np.isin(m.jnt_type, (0, 1))
        self._angles = m.jnt_qposadr[self._scalar], m.jnt_dofadr[self._scalar]

    def start(self, qpos: np.ndarray, qvel: np.ndarray) -> Episode:
        """At a state; drives hold where they are until the first command arrives."""
        data = mujoco.MjData(self.model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        before = data.qpos.copy()
        mujoco.mj_integratePos(self.model, before, data.qvel, -self.gap.window)
        held = data.qpos[self._pos].copy()
        mujoco.mj_forward(self.model, data)
        return Episode(data, deque([held] * (self._late[0] + 2)), before)

    def advance(self, episode: Episode, ctrl: np.ndarray) -> None:
        """One control step with ``ctrl (nu,)`` sent at its beginning."""
        data, gap = episode.data, self.gap
        whole, rest = self._late
        episode.sent.append(np.asarray(ctrl, float))
        episode.sent.popleft()
        for part in range(self.parts):
            if part == self.parts - self._back:
                episode.before = data.qpos.copy()
            data.ctrl[:] = episode.sent[-1 - whole - (part < rest)]
            speed = data.qvel[self._dof]
            if self._rubs:
                slow = np.exp(-((speed / gap.stribeck) ** 2))
                self._friction[self._dof] = self._kinetic + self._further * slow
            if gap.motor is not None:
                self._limits[:] = gap.motor.limits(speed)
            mujoco.mj_step(self.model, data)
            if self._clip is not None:
                np.clip(data.qvel, -self._clip, self._clip, out=data.qvel)
        if any(data.warning[w].number for w in _DIVERGED):
            raise FloatingPointError("the twin's simulation diverged")

    def read(
        self, episode: Episode, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the sensors say: positions ``(nq,)`` and speeds ``(nv,)``."""
        now = self._reading(episode.data.qpos, rng)
        if not self.gap.window:
            return now, episode.data.qvel.copy()
        speed = np.zeros(self.model.nv)
        before = self._reading(episode.before, rng)
        mujoco.mj_differentiatePos(self.model, speed, self.gap.window, before, now)
        return now, speed

    def _reading(self, qpos: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        m, out = self.model, qpos.copy()
        noise = self.gap.noise * rng.standard_normal(m.nv)
        mujoco.mj_integratePos(m, out, noise, 1.0)
        place, dof = self._angles
        step = np.broadcast_to(self.gap.quantum, m.nv)[dof]
        grid = np.where(step > 0, step, 1.0)
        out[place] = np.where(step > 0, grid * np.round(out[place] / grid), out[place])
        return out

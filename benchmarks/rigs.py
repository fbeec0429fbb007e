"""Machines that rivals identify, and how they are recorded.

``cartpole``: the built-in robot without its speed limit, for which MuJoCo C has no
word; its masses and the pole's length were weighed and measured, for logs tell them
from the pole's armature in no way that logarithms make straight; a rough stabilizer
moves it. ``arm6``: an arm with six joints (assets/arm6.xml).
``go2``: the built-in robot hung by its base, the floor taken away: without contact the
data determine the drives and the masses of the legs, and it is what an owner can
record on a stand; a body that floats without gravity is not. The last two follow
sines, two for each drive.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.recovery import WEIGHED
from easi_jax.baselines import Task
from easi_jax.data.segments import Segments
from easi_jax.simulation.rollout import collect, measured, policy_rollout
from easi_jax.simulation.simulator import Simulator
from envs import make
from envs.robot import model_file, parameter_space

STEPS = 200  # control steps of a trajectory
_DT = 0.02  # s
_FREQUENCIES = 0.3, 2.0  # Hz
_K = 3.0  # a search starts in [nominal / k, k nominal]
_EXPLORED = {"cartpole": 0.25, "arm6": 0.1, "go2": 0.1}  # std, action or rad
_ARM = ("yaw", "shoulder", "elbow", "roll", "pitch", "flange")
_LEG = ("hip", "thigh", "calf")


@dataclass(frozen=True)
class Rig:
    """A machine to be identified.

    Attributes:
        name: of the robot.
        simulator: what is simulated; truths lie about its nominal values.
        noise: of the sensors, standard deviations ``(2 nv,)``.
        home: what the drives are sent on average, ``(nu,)``; also where joints start.
        reach: amplitude of commands, ``(nu,)``.
        xml: the model, MJCF.
        env: the machine as an environment, where there is one.
    """

    name: str
    simulator: Simulator
    noise: np.ndarray
    home: np.ndarray
    reach: np.ndarray
    xml: str
    env: Any = None

    def with_machine(self, simulator: Simulator) -> Any:
        """The environment with another machine."""
        out = copy.copy(self.env)
        out.simulator, out.space = simulator, simulator.space
        return out

    def late(self, seconds: float) -> Simulator:
        """The machine with commands that all arrive late, which no model knows of."""
        m = self.simulator.mj_model
        drives = [m.actuator(i).name for i in range(m.nu)]
        fixed = {f"effect.delay.{name}": seconds for name in drives}
        return self.simulator.rebuilt(fixed=fixed)

    def record(
        self,
        simulator: Simulator,
        theta: jax.Array,
        key: jax.Array,
        trajectories: int,
        explore: float,
    ) -> Segments:
        """Trajectories ``(B, T, 1, ...)`` of ``simulator`` at ``theta (n,)``, without
        noise; ``explore`` is the share of the usual exploration."""
        std = explore * _EXPLORED[self.name]
        if self.env is not None:
            env = self.with_machine(simulator)
            return collect(
                env,
                env.model(theta),
                lambda obs, k: controller(std, obs, k),
                key,
                trajectories,
                STEPS,
            )

        def one(key: jax.Array) -> Segments:
            return self._open_loop(simulator, simulator.model(theta), key, std)

        return jax.vmap(one)(jax.random.split(key, trajectories))

    def _open_loop(
        self, simulator: Simulator, model: Any, key: jax.Array, std: float
    ) -> Segments:
        k_phase, k_rate, k_noise = jax.random.split(key, 3)
        shape = (2, len(self.home))
        phase = jax.random.uniform(k_phase, shape, maxval=2 * jnp.pi)
        low, high = _FREQUENCIES
        rate = jax.random.uniform(k_rate, shape, minval=low, maxval=high)
        time = self.simulator.dt * jnp.arange(STEPS)[:, None, None]
        sines = jnp.sin(2 * jnp.pi * rate * time + phase).mean(1)
        noise = std * jax.random.normal(k_noise, (STEPS, len(self.home)))
        ctrl = jnp.asarray(self.home + self.reach * sines + noise)

        def step(state: Any, u: jax.Array) -> Any:
            new = simulator.step(model, state, u)
            return new, (state.qpos, state.qvel, new.qpos, new.qvel)

        first = simulator.start(
            jnp.asarray(self.home, jnp.float32), jnp.zeros(len(self.home)), model
        )
        _, (qpos, qvel, after, speed) = jax.lax.scan(step, first, ctrl)
        return Segments(
            qpos=qpos,
            qvel=qvel,
            ctrl=ctrl[:, None],
            next_qpos=after[:, None],
            next_qvel=speed[:, None],
            weight=jnp.ones(STEPS),
        )

    def task(self, simulator: Simulator, theta: jax.Array, explore: float) -> Task:
        """What a method is given; ``simulator`` at ``theta`` is the real one."""
        noise = jnp.asarray(self.noise, jnp.float32)
        if self.env is None:
            return Task(self.simulator, noise)
        real = self.with_machine(simulator)

        def act(policy: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
            return controller(policy, obs, key)

        def best(policy: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
            return controller(0.0 * policy, obs, key)

        @jax.jit
        def record(policy: Any, keys: jax.Array) -> Segments:
            def one(key: jax.Array) -> Segments:
                return policy_rollout(
                    real,
                    real.model(theta),
                    lambda obs, k: best(policy, obs, k),
                    key,
                    STEPS,
                )

            return measured(
                jax.vmap(one)(keys),
                noise,
                jax.random.fold_in(keys[0], 1),
                simulator.configuration,
            )

        std = jnp.asarray(explore * _EXPLORED[self.name])
        return Task(
            self.simulator,
            noise,
            env=self.with_machine(self.simulator),
            act=act,
            act_best=best,
            policy=std,
            record=record,
            # Identification alone is compared: the controller stays as it is.
            train=lambda space, distribution, key: std,
        )


def controller(std: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
    """A rough stabilizer of Cartpole with exploration noise; action in [-1, 1]."""
    u = obs @ jnp.array([3.75, 1.5, 7.5, 1.375])
    return jnp.clip(u + std * jax.random.normal(key), -1.0, 1.0)[None]


def cartpole() -> Rig:
    """Seven parameters."""
    env = make("cartpole")
    known = {*WEIGHED, "cart_speed_limit"}
    names = [n for n in env.space.names if n not in known]
    simulator = Simulator(env.mj_model, env.space.select(names), env.dt)
    noise = np.array([5e-4, 2e-3, 1e-2, 2e-2])
    xml = model_file("cartpole").read_text()
    return Rig("cartpole", simulator, noise, np.zeros(1), np.zeros(1), xml, env)


def arm6() -> Rig:
    """15 parameters: stiffness and damping of each drive, three masses."""
    xml = (Path(__file__).parent / "assets" / "arm6.xml").read_text()
    gains = {f"{j}_{g}": f"actuator.{j}.{g}" for g in ("kp", "kv") for j in _ARM}
    masses = {f"{b}_mass": f"body.{b}.mass" for b in ("upper", "fore", "flange")}
    home = np.array([0.0, -0.6, 0.9, 0.0, 0.4, 0.0])
    return _rig("arm6", xml, {**gains, **masses}, home, 0.6)


def go2() -> Rig:
    """11 parameters, by kind of joint: stiffness, damping, armature, masses."""
    spec = mujoco.MjSpec.from_string(model_file("go2").read_text())
    home = np.array(spec.keys[0].qpos)[7:]
    for part in (spec.joint("root"), spec.geom("floor"), *spec.keys):
        spec.delete(part)
    spec.compile()
    gains = {f"{j}_{g}": f"actuator.*_{j}.{g}" for g in ("kp", "kv") for j in _LEG}
    rotors = {f"{j}_armature": f"joint.*_{j}.armature" for j in _LEG}
    masses = {f"{j}_mass": f"body.*_{j}.mass" for j in _LEG[1:]}
    return _rig("go2", spec.to_xml(), {**gains, **rotors, **masses}, home, 0.4)


def _rig(
    name: str,
    xml: str,
    addresses: dict[str, str],
    home: np.ndarray,
    reach: float,
) -> Rig:
    """A rig of joints that all have encoders: 0.5 mrad, 5 mrad/s."""
    m = mujoco.MjModel.from_xml_string(xml)
    simulator = Simulator(m, parameter_space(m, addresses, _K), _DT)
    noise = np.repeat([5e-4, 5e-3], m.nv)
    return Rig(name, simulator, noise, home, np.full(m.nu, reach), xml)


RIGS: dict[str, Callable[[], Rig]] = {"cartpole": cartpole, "arm6": arm6, "go2": go2}

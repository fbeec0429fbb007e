"""The preset `paper`, number by number, against the reference's recipe in numpy.

The recipe is written down here from its description alone: linear units, a Gaussian
first generation, transitions of the controller's observations with resets kept, weights
clipped before each step of RMSprop, weighted recombination about the new mean. MuJoCo C
simulates. What is drawn at random is drawn by the same generator from the same keys.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from easi_jax.data.segments import windows
from easi_jax.model.parameters import ParameterSpace
from easi_jax.search.config import preset
from easi_jax.search.easi import Search, SearchData
from easi_jax.simulation.rollout import collect
from envs import make

INDIVIDUALS, STEPS, RUNS, GENERATIONS = 12, 30, 5, 2
UPDATES, BATCH, PER_INDIVIDUAL = 4, 64, 5
# The controller drives the cart to an end of its rail, so that resets are on the way.
GAIN = np.array([[8.0, 1.0, 0.0, 0.0]])
PUSH = 0.5

MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" solver="Newton" iterations="100"
          ls_iterations="50"><flag contact="disable"/></option>
  <worldbody><body pos="0 0 2">
    <joint name="cart" type="slide" axis="1 0 0" range="-0.22 0.22"
           frictionloss="{cart_friction}"/>
    <geom type="box" size="0.02 0.01 0.0325" mass="{cart_mass}"/>
    <body pos="0 -0.024 0.0125">
      <joint type="hinge" axis="0 1 0" damping="{pole_damping}"
             frictionloss="{pole_friction}" armature="{pole_armature}"/>
      <geom type="box" size="0.003 0.003 {half}" pos="0 0 {half}" mass="{pole_mass}"/>
    </body>
  </body></worldbody>
  <actuator>
    <position joint="cart" kp="{cart_kp}" kv="{cart_kv}" ctrlrange="-0.2 0.2"
              forcerange="-{cart_force_limit} {cart_force_limit}"/>
  </actuator>
</mujoco>
"""


class Cart:
    """Cartpole as described, in MuJoCo C."""

    def __init__(self, values: dict[str, float]) -> None:
        text = MODEL.format(half=values["pole_length"] / 2, **values)
        self.m = mujoco.MjModel.from_xml_string(text)
        self.d = mujoco.MjData(self.m)
        self.limit = values["cart_speed_limit"]

    def reset(self, key: Any) -> np.ndarray:
        scale = jnp.array([0.1, 0.1, 0.2, 0.2])
        s = np.asarray(jax.random.uniform(key, (4,), minval=-scale, maxval=scale))
        mujoco.mj_resetData(self.m, self.d)
        self.d.qpos, self.d.qvel, self.steps = s[:2], s[2:], 0
        return self.seen()

    def seen(self) -> np.ndarray:
        x, angle = self.d.qpos
        v, rate = self.d.qvel
        return np.array([x, v, angle, rate])

    def step(self, action: np.ndarray) -> bool:
        """Whether the episode is over."""
        self.d.ctrl = 0.2 * np.clip(action, -1, 1)
        for _ in range(4):
            mujoco.mj_step(self.m, self.d)
            self.d.qvel[0] = np.clip(self.d.qvel[0], -self.limit, self.limit)
        self.steps += 1
        x, _, angle, _ = self.seen()
        return abs(x) > 0.18 or abs(angle) > np.pi / 2 or self.steps >= 200


def transitions(values: dict[str, float], key: Any) -> np.ndarray:
    """``[s, a, s']`` of one trajectory, ``(STEPS, 9)``."""
    cart, (k_reset, k_run), rows = Cart(values), jax.random.split(key), []
    seen = cart.reset(k_reset)
    for k in jax.random.split(k_run, STEPS):
        k_act, k_again = jax.random.split(k)
        noise = np.asarray(jax.random.normal(k_act, (1,)))
        action = GAIN @ seen + PUSH * noise
        over = cart.step(action)
        after = cart.reset(k_again) if over else cart.seen()
        rows.append(np.concatenate([seen, action, after]))
        seen = after
    return np.array(rows)


class Critic:
    """An MLP of two ReLU layers, trained by RMSprop as in PyTorch."""

    def __init__(self, params: Any) -> None:
        layers = [params["params"][f"Dense_{k}"] for k in range(3)]
        self.w = [np.array(x[n]) for x in layers for n in ("kernel", "bias")]
        self.v = [np.zeros_like(w) for w in self.w]

    def forward(self, x: np.ndarray) -> list[np.ndarray]:
        """Inputs of the three layers, and the scores."""
        seen = [x]
        for k in range(3):
            x = x @ self.w[2 * k] + self.w[2 * k + 1]
            x = np.maximum(x, 0) if k < 2 else x
            seen.append(x)
        return seen

    def update(self, real: np.ndarray, fake: np.ndarray) -> float:
        self.w = [np.clip(w, -0.01, 0.01) for w in self.w]
        gradient = [np.zeros_like(w) for w in self.w]
        loss = 0.0
        for x, sign in ((fake, 0.5), (real, -0.5)):
            *seen, score = self.forward(x)
            loss += sign * score.mean()
            back = np.full_like(score, sign / len(x))
            for k in (2, 1, 0):
                gradient[2 * k] += seen[k].T @ back
                gradient[2 * k + 1] += back.sum(0)
                back = (back @ self.w[2 * k].T) * (seen[k] > 0)
        self.v = [0.99 * v + 0.01 * g**2 for v, g in zip(self.v, gradient, strict=True)]
        steps = [g / (np.sqrt(v) + 1e-8) for v, g in zip(self.v, gradient, strict=True)]
        self.w = [w - 3e-4 * s for w, s in zip(self.w, steps, strict=True)]
        return loss


def recombination(elite_ratio: float) -> np.ndarray:
    best = int(INDIVIDUALS * elite_ratio)
    w = np.log(0.5 * (INDIVIDUALS + 1)) - np.log(np.arange(1, best + 1))
    return w / w.sum()


def recipe(
    space: ParameterSpace, state: Any, real: np.ndarray, elite_ratio: float
) -> dict[str, Any]:
    """`GENERATIONS` generations; what the last one leaves."""
    low, high = (np.array([p.initial[k] for p in space.parameters]) for k in (0, 1))
    bound = [(np.array(space.bounds[k]) - low) / (high - low) for k in (0, 1)]
    n, critic, key = len(low), Critic(state.critic.params), state.key
    mean, std = np.full(n, 0.5), np.full(n, 12**-0.5)
    out: dict[str, Any] = {}
    for _ in range(GENERATIONS):
        before = mean, std
        key, k_ask, k_sim, k_critic, _ = jax.random.split(key, 5)
        z = np.asarray(jax.random.normal(k_ask, (INDIVIDUALS, n)))
        unit = np.clip(mean + std * z, *bound)
        k_pick, k_roll = jax.random.split(k_sim)
        fake = np.array(
            [
                transitions(dict(zip(space.names, si, strict=True)), k)
                for si, k in zip(
                    low + unit * (high - low),
                    jax.random.split(k_roll, INDIVIDUALS),
                    strict=True,
                )
            ]
        )
        order = np.argsort(-np.asarray(jax.random.gumbel(k_pick, (len(real),))))
        for k in jax.random.split(k_critic, UPDATES):
            k_real, k_fake, _ = jax.random.split(k, 3)
            rows = np.asarray(jax.random.randint(k_real, (BATCH,), 0, len(real)))
            shape = INDIVIDUALS, PER_INDIVIDUAL
            cols = np.asarray(jax.random.randint(k_fake, shape, 0, STEPS))
            some = np.take_along_axis(fake, cols[..., None], 1).reshape(-1, 9)
            loss = critic.update(real[order][rows], some)
        fitness = critic.forward(fake)[-1][..., 0].mean(1)
        w = recombination(elite_ratio)
        best = unit[np.argsort(-fitness)][: len(w)]
        mean = w @ best
        std = np.sqrt(np.maximum(w @ (best - mean) ** 2, 0))
        out = {
            "mean": mean,
            "std": std,
            "result_mean": before[0],
            "result_std": before[1],
            "loss": loss,
            "score": fitness.mean(),
            "best": fitness.max(),
            "weights": critic.w,
        }
    return out


# Of 0.8, some weights are negative.
@pytest.mark.parametrize("elite_ratio", [0.5, 0.8])
def test_generations_are_those_of_the_reference(elite_ratio: float) -> None:
    with jax.enable_x64(True):
        env = make("cartpole")
        config = preset(
            "paper",
            population=INDIVIDUALS,
            rollout_steps=STEPS,
            discriminator_updates=UPDATES,
            real_batch=BATCH,
            fake_per_individual=PER_INDIVIDUAL,
            elite_ratio=elite_ratio,
        )

        def act(gain: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
            return gain @ obs + PUSH * jax.random.normal(key, (1,))

        search = Search(env.simulator, config, env=env, act=act)
        gain = jnp.asarray(GAIN)
        demos = collect(
            *(env, env.model(), lambda o, k: act(gain, o, k), jax.random.key(7)),
            *(RUNS, STEPS),
            auto_reset=config.crosses_resets,
            sees=config.observation_inputs,
        )
        nominal = {p.name: p.nominal for p in env.space.parameters}
        keys = jax.random.split(jax.random.key(7), RUNS)
        real = np.concatenate([transitions(nominal, k) for k in keys])
        data = SearchData(windows(demos, 1, 1), jnp.zeros(4), gain)
        assert (np.asarray(data.segments.weight) == 0).sum() > 0, "no reset on the way"
        np.testing.assert_allclose(data.segments.seen, real, rtol=1e-5, atol=1e-6)

        state = search.init(jax.random.key(3), data)
        got, info = jax.jit(lambda s: search.run(s, data, GENERATIONS))(state)
        want = recipe(env.space, state, real, elite_ratio)

    def equal(a: Any, b: Any) -> None:
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)

    equal(got.mean, want["mean"])
    equal(np.sqrt(np.diag(got.cov)), want["std"])
    equal(got.result_mean, want["result_mean"])
    equal(np.sqrt(np.diag(got.result_cov)), want["result_std"])
    equal(info.loss[-1], want["loss"])
    equal(info.score[-1], want["score"])
    equal(info.best[-1], want["best"])
    layers = [got.critic.params["params"][f"Dense_{k}"] for k in range(3)]
    found = [x[n] for x in layers for n in ("kernel", "bias")]
    for a, b in zip(found, want["weights"], strict=True):
        equal(a, b)

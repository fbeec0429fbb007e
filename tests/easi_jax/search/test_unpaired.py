"""The search on logs that pair with no simulation."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.noise import pooled_noise
from easi_jax.data.proprioception import proprioception
from easi_jax.errors import UserError
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.search.config import preset
from easi_jax.search.unpaired import (
    MEMORY,
    Delays,
    Simulations,
    UnpairedData,
    UnpairedSearch,
    linear_prediction,
    pieces_of,
    reading_delays,
)
from easi_jax.simulation.sent_commands import SentCommands
from easi_jax.simulation.simulator import Simulator
from tests.walker import DT, walk

STEPS, LONG = 75, 150
KP = Parameter("kp", ("actuator.*.kp",), 20.0, (10.0, 40.0), (1.0, 100.0))


def test_pieces_end_where_rows_do() -> None:
    rows, ctrl = jnp.arange(8.0)[:, None] ** 2, jnp.arange(8.0)[:, None]
    weight = jnp.array([1.0, 1, 1, 1, 0, 1, 1, 1])
    p = pieces_of(rows, ctrl, weight)
    assert p.before.shape == (8 - MEMORY - 1, 2 * (MEMORY + 1))
    np.testing.assert_array_equal(p.before[1], [1, 1, 4, 2, 9, 3])
    np.testing.assert_array_equal(p.change[1], [16 - 9])
    np.testing.assert_array_equal(p.weight, [1, 1, 0, 0, 0])


def test_a_late_reading_lies_between_rows() -> None:
    rows = jnp.stack([jnp.arange(6.0), 10 * jnp.arange(6.0)], 1)
    late = Delays((), (slice(1, 2),))
    for delay, row in ((0.0, 4.0), (0.006, 3.7), (0.02, 3.0), (0.04, 2.0)):
        read = late.read(rows, jnp.array([delay]), 0.02)
        np.testing.assert_allclose(read[4], [4.0, 10 * row], rtol=1e-5)


def test_a_linear_map_is_found_despite_rows_that_do_not_count() -> None:
    rng = np.random.default_rng(0)
    x, slope = rng.standard_normal((500, 4)), rng.standard_normal((4, 2))
    y = x @ slope + 3.0
    y[::5] = 100.0
    weight = np.ones(500)
    weight[::5] = 0.0
    predicted = linear_prediction(*map(jnp.asarray, (x, y, weight)))
    np.testing.assert_allclose(predicted(jnp.asarray(x))[1], y[1], atol=5e-3)


@pytest.fixture(scope="module")
def searched() -> tuple[UnpairedSearch, UnpairedData]:
    m, run = walk(8.0)
    simulator = Simulator(m, ParameterSpace((KP,)), DT, engine="mujoco")
    env = SentCommands("walker", simulator, [run], STEPS)
    of, _ = proprioception(m, [run], "mujoco")
    config = preset(
        "default",
        source="policy",
        innovation_inputs=False,
        rollout_steps=STEPS,
        population=32,
    )
    search = UnpairedSearch(
        env, lambda *_: jnp.zeros(0), of, reading_delays(of, DT), config
    )
    rows = jnp.asarray(of.of_run(run), jnp.float32)
    ctrl = jnp.asarray(run.ctrl, jnp.float32)
    noise = of.noise(pooled_noise([run]), [run])
    pieces = pieces_of(rows, ctrl, jnp.ones(len(rows)))
    return search, UnpairedData(pieces, jnp.asarray(noise, jnp.float32), ())


def test_delays_are_searched_beside_the_model(searched) -> None:
    search, _ = searched
    assert search.space.names == (
        *("kp", "reading.qvel.delay", "reading.gyro.delay"),
        "reading.orientation.delay",
    )


def test_a_search_moves_towards_the_truth(searched) -> None:
    """From a mean of 20 towards 30, where simulations are what was measured."""
    given, data = searched
    m, run = walk(8.0)
    env = SentCommands("walker", given.simulator, [run], LONG)
    env.simulator = Simulator(m, ParameterSpace((KP,)), DT, engine="mujoco")
    config = replace(given.config, population=64, rollout_steps=LONG)
    search = UnpairedSearch(env, lambda *_: jnp.zeros(0), given.of, Delays(), config)
    unit = np.asarray(search.space.to_unit(np.array([30.0])))
    many = np.tile(unit, (128, 1))
    read, _ = Simulations(search, data)(many, jax.random.key(5))
    pieces = jax.tree.map(lambda x: jnp.asarray(x.reshape(-1, *x.shape[2:])), read)
    data = data.replace(pieces=pieces)
    state = search.init(jax.random.key(1), data)
    state, info = jax.jit(lambda s: search.run(s, data, 12))(state)
    kp = np.asarray(search.space.to_si(info.mean))[:, 0]
    assert 25.0 < np.exp(np.log(kp[-6:]).mean()) < 36.0, kp
    assert int(info.non_finite.sum()) == 0


def test_the_same_key_gives_the_same_search(searched) -> None:
    search, data = searched
    run = jax.jit(lambda k: search.run(search.init(k, data), data, 2)[0].mean)
    np.testing.assert_array_equal(run(jax.random.key(3)), run(jax.random.key(3)))


def test_simulations_do_not_depend_on_how_many_are_asked_for(searched) -> None:
    search, data = searched
    simulated = Simulations(search, data)
    unit = np.full((simulated.size + 3, search.space.size), 0.5)
    some, sound = simulated(unit[:5], jax.random.key(0))
    more, _ = simulated(unit, jax.random.key(0))
    assert sound.all() and len(more.weight) == simulated.size + 3
    np.testing.assert_array_equal(some.change, more.change[:5])
    # Each from its own start.
    assert np.abs(some.before[0] - some.before[1]).max() > 1e-3


def test_what_falls_is_lost(searched) -> None:
    """A robot whose drives give way ends its episode, and is ranked last."""
    search, data = searched
    theta = jnp.array([[20.0, 0, 0, 0], [jnp.nan, 0, 0, 0]])
    simulate = jax.jit(
        lambda t: search.simulated(t, data, jax.random.key(0), STEPS, True)
    )
    pieces, sound = simulate(theta)
    assert sound.tolist() == [True, False]
    assert np.isfinite(pieces.before).all() and pieces.weight[1].sum() == 0


def test_too_short_rollouts_are_told(searched) -> None:
    search, _ = searched
    config = preset("default", source="policy", rollout_steps=40)
    with pytest.raises(UserError, match="rollout_steps is 40: the first 50"):
        UnpairedSearch(search.env, search.act, search.of, search.delays, config)  # type: ignore[arg-type]

"""One compiled training of all probes, shared by the tests that read it."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

from easi_jax.rl import Sac, SacConfig, SacState, init_seeds, run_seeds
from tests.easi_jax.rl.probes import Probe, probe_models

DISCOUNT = 0.8
CHUNK = 25


class Trained(NamedTuple):
    """Probes after training.

    Attributes:
        sac: the trainer.
        states: by name of the probe, and ``broken`` for the one that turns to NaN.
        start: state of all before, leading axis the probes.
        dist: the models of all, leading axis the probes.
        run: compiled ``run(states, dist) -> states, history`` of CHUNK steps.
        final: state of all afterwards.
    """

    sac: Sac
    states: dict[str, SacState]
    start: SacState
    dist: Any
    run: Any
    final: SacState
    history: dict[str, jax.Array]


@pytest.fixture(scope="session")
def trained() -> Trained:
    config = SacConfig(
        env_steps=2 * CHUNK * 16,
        num_envs=16,
        random_steps=64,
        updates_per_step=25,
        batch_size=64,
        hidden=(32, 32),
        learning_rate=3e-3,
        tau=0.05,
        discount=DISCOUNT,
        # The entropy then hardly adds to the values, which are compared.
        initial_temperature=1e-3,
        normalize_observations=False,
    )
    sac = Sac(Probe(), config, bind=lambda theta: theta, draw=lambda dist, key: dist)
    probes = probe_models()
    probes["broken"] = replace(probes["constant"], constant=jnp.float32(jnp.nan))
    dist = jax.tree.map(lambda *x: jnp.stack(x), *probes.values())
    keys = jax.random.split(jax.random.key(0), len(probes))
    start = jax.jit(lambda k, d: init_seeds(sac, k, d, dist_axis=0))(keys, dist)
    run = jax.jit(lambda s, d: run_seeds(sac, s, d, CHUNK, dist_axis=0))
    run = run.lower(start, dist).compile()
    half, first = run(start, dist)
    final, second = run(half, dist)
    history = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), first, second)
    states = {
        name: jax.tree.map(lambda x, i=i: x[i], final) for i, name in enumerate(probes)
    }
    return Trained(sac, states, start, dist, run, final, history)

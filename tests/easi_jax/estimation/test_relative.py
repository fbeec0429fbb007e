"""Results once the owner's weighed masses settle what motion alone cannot show."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.data.segments import Segments
from easi_jax.estimation.posterior import Estimate
from easi_jax.estimation.relative import seed_results
from easi_jax.io.report.parameters import parameter_rows
from easi_jax.model.distribution import gaussian
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import SeedResult
from easi_jax.simulation import slopes
from easi_jax.simulation.simulator import Simulator
from envs.cartpole import Cartpole

GEOMETRY = {
    "pole_length": 1.0,
    "pole_mass": -1.0,
    "pole_armature": -0.6,
    "cart_mass": 1 / 3,
}
Seen = Callable[[dict[str, Any]], jax.Array]


class Bench:
    """Numbers ``seen`` of parameters by name in place of a simulation, ``(12,)`` each
    known to ``std``; everything else is as it is."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, cartpole: Cartpole, names: Sequence[str]
    ) -> None:
        self.space = space = cartpole.space.select(list(names))
        self.simulator = Simulator(cartpole.mj_model, space, cartpole.dt)
        self.std = 0.01
        self.seen: Seen = lambda _: jnp.zeros(12)
        addresses = {p.addresses[0]: p.name for p in space.parameters}
        bench = self

        def bare(simulator: Simulator, space: Any, unit: Any, *rest: Any) -> Any:
            s = rest[1]
            own = dict(zip(space.names, space.to_si(unit), strict=True))
            held = {addresses[a]: x for a, x in simulator.fixed.items()}
            measured = jnp.concatenate([s.next_qpos, s.next_qvel], 1)
            return bench.seen(own | held).reshape(3, 4) - measured

        monkeypatch.setattr(slopes, "_residuals", bare)

    def numbers(self, unit: Any) -> jax.Array:
        si = self.space.to_si(jnp.asarray(unit))
        return self.seen(dict(zip(self.space.names, si, strict=True)))

    def found(self, unit: Any, measured: Any) -> Estimate:
        """A fit that ended at ``unit``, where it sees ``measured``."""
        noise = jnp.full(4, self.std)
        measured = jnp.asarray(measured).reshape(1, 3, 4)
        pieces = Segments(
            qpos=jnp.zeros((1, 2)),
            qvel=jnp.zeros((1, 2)),
            ctrl=jnp.zeros((1, 3, 1)),
            next_qpos=measured[..., :2],
            next_qvel=measured[..., 2:],
            weight=jnp.ones(1),
        )
        unit = jnp.asarray(unit)
        slope = jax.jacfwd(self.numbers)(unit) / self.std
        info = slope.T @ slope
        cov = jnp.linalg.inv(info + 12 * jnp.eye(self.space.size))
        return Estimate(
            distribution=gaussian(self.space, unit, cov),
            search_cov=cov,
            hessian=info,
            noise=noise,
            cost=jnp.zeros(1),
            delta=jnp.zeros((1, 4)),
            fit=unit,
            excess=jnp.zeros(()),
            simulated=jnp.zeros(()),
            pieces=pieces,
            residuals=jnp.zeros((1, 3, 4)),
            misfit=jnp.zeros(4),
            start=noise,
            doubts=jnp.zeros((0, 2)),
        )

    def stated(self, estimates: Sequence[Estimate]) -> list[SeedResult]:
        return seed_results(self.simulator, self.space, estimates, free_starts=False)


@pytest.fixture()
def bench(monkeypatch: pytest.MonkeyPatch, cartpole: Cartpole) -> Bench:
    return Bench(monkeypatch, cartpole, cartpole.space.names)


def _common(space: ParameterSpace) -> np.ndarray:
    unmoved = ("length", "speed_limit")
    return np.array([float(not n.endswith(unmoved)) for n in space.names])


def _geometry(space: ParameterSpace) -> np.ndarray:
    return np.array([GEOMETRY.get(n, 0.0) for n in space.names])


def _found(
    bench: Bench, off: np.ndarray, unseen: list[np.ndarray], std: float = 0.01
) -> tuple[Estimate, SeedResult]:
    """A quarter of the stiffness, found but for log ratios ``off``; all directions of
    log ratios seen to ``std`` but for ``unseen``."""
    space = bench.space
    truth = space.nominal.copy()
    truth[space.index("cart_kp")] *= 0.25
    basis = np.linalg.qr(np.stack(unseen, 1))[0]
    seen = jnp.asarray(np.eye(12, space.size) @ (np.eye(space.size) - basis @ basis.T))
    bench.std = std
    bench.seen = lambda v: (
        seen @ jnp.log(jnp.stack([v[n] for n in space.names]) / truth)
    )
    found = bench.found(space.to_unit(truth * np.exp(off)), np.zeros(12))
    return found, bench.stated([found])[0]


def test_all_is_known_relative_to_a_mass_and_a_length(bench: Bench) -> None:
    space = bench.space
    limit = space.index("cart_force_limit")
    unseen = [_common(space), _geometry(space), np.eye(space.size)[limit]]
    _, found = _found(bench, np.array([0.4, -0.3, 0.5]) @ unseen, unseen)
    assert found.flags.count("determined") == 1  # the speed limit
    known = found.relative
    assert known is not None and len(known.taken) == 2
    assert set(known.taken) <= {"pole_length", "pole_mass", "cart_mass"}
    names = list(space.names)
    for i, name in enumerate(names):
        expected = not (name in known.taken or i == limit)
        assert known.determined[i] == expected, name
        if i != limit:
            factor = 0.25 if name == "cart_kp" else 1.0
            wanted = factor * space.nominal[i]
            assert known.mean[i] == pytest.approx(wanted, rel=2e-3), name
    kp = names.index("cart_kp")
    assert known.std[kp] < 0.05 * known.mean[kp] < found.std[kp]
    assert known.depends(names.index("cart_speed_limit")) == []
    assert known.depends(kp)


def test_truth_is_compared_where_it_rests_on_what_is_true(bench: Bench) -> None:
    space = bench.space
    _, found = _found(bench, 0.1 * _common(space), [_common(space)])
    assert found.relative is not None
    truth = space.nominal.copy()
    (taken,) = found.relative.taken
    for times, shown in ((1.0, True), (1.2, False)):
        truth[space.index(taken)] = times * space.nominal[space.index(taken)]
        rows = {r.name: r for r in parameter_rows(space, found, truth)}
        assert rows["cart_kp"].flag == "relative"
        assert (rows["cart_kp"].truth is not None) == shown
        assert rows["cart_speed_limit"].truth is not None
        assert rows[taken].truth == truth[space.index(taken)]


def test_what_leaves_no_trace_stays_unknown(bench: Bench) -> None:
    space = bench.space
    limit = space.index("cart_force_limit")
    _, found = _found(bench, np.zeros(space.size), [np.eye(space.size)[limit]])
    assert found.relative is None
    assert found.flags[limit] == "not determined"
    assert found.flags.count("determined") == space.size - 1


def test_a_direction_without_a_mass_stays_open(bench: Bench) -> None:
    space = bench.space
    drive = np.zeros(space.size)
    drive[[space.index("cart_kv"), space.index("cart_friction")]] = 1.0, -0.4
    _, found = _found(bench, 0.2 * drive, [drive, _common(space)])
    known = found.relative
    assert known is not None and len(known.taken) == 1
    assert set(known.taken) < {"pole_mass", "cart_mass"}
    open_ = {"cart_kv", "cart_friction", *known.taken}
    for name, determined in zip(space.names, known.determined, strict=True):
        assert determined == (name not in open_), name
    assert _found(bench, 0.2 * drive, [drive])[1].relative is None


def test_what_is_not_known_closely_is_not_called_known(bench: Bench) -> None:
    space = bench.space
    exact, found = _found(bench, np.zeros(space.size), [_common(space)])
    assert found.relative is not None and any(found.relative.determined)
    # A search alone, whose place is no best fit.
    (unfitted,) = bench.stated([replace(exact, cost=jnp.zeros(0))])
    assert unfitted.relative is None
    # Far more is left over than the noise makes.
    (poor,) = bench.stated(
        [
            replace(
                exact, pieces=replace(exact.pieces, next_qvel=jnp.full((1, 3, 2), 9.0))
            )
        ]
    )
    assert poor.relative is not None and not any(poor.relative.determined)
    # The data themselves show little.
    _, weak = _found(bench, np.zeros(space.size), [_common(space)], std=0.6)
    assert weak.relative is None and "determined" not in weak.flags


def test_what_is_stated_covers_the_truth_along_a_curve(
    monkeypatch: pytest.MonkeyPatch, cartpole: Cartpole
) -> None:
    """A pole's mass is unseen: what it loses the cart gains, which is no product."""
    names = ["pole_mass", "cart_mass", "pole_armature", "cart_kp"]
    bench = Bench(monkeypatch, cartpole, names)
    bench.std = 2e-3

    def parts(v: dict[str, Any]) -> jax.Array:
        whole = v["cart_mass"] + v["pole_mass"]
        inertia = v["pole_armature"] + 0.03 * v["pole_mass"]
        return jnp.stack([whole, inertia, v["cart_kp"]])

    right = parts(dict(zip(bench.space.names, bench.space.nominal, strict=True)))
    bench.seen = lambda v: jnp.tile(jnp.log(parts(v) / right), 4)
    space, draws = bench.space, 200
    rng = np.random.default_rng(0)
    truth = np.asarray(space.nominal, float)
    noise = rng.normal(0.0, bench.std, (draws, 12))
    noise[0] = 0.0
    # Best fits are all along the curve; each search ends somewhere on it.
    whole, inertia, kp = (np.exp(noise.reshape(draws, 4, 3).mean(1)) * right).T
    pole = truth[0] * np.exp(rng.normal(0.0, 0.3, draws))
    fits = np.stack([pole, whole - pole, inertia - 0.03 * pole, kp], 1)
    ends = [bench.found(space.to_unit(f), m) for f, m in zip(fits, noise, strict=True)]
    stated = [r.relative for r in bench.stated(ends)]
    given = [i for i, r in enumerate(stated) if r and "pole_mass" in r.taken]
    assert len(given) > 0.9 * draws and given[0] == 0
    kept = [r for i, r in enumerate(stated) if r and i in given]
    off = np.array([(np.array(r.mean) - truth)[1:] for r in kept])
    std = np.array([np.array(r.std)[1:] for r in kept])
    assert all(r.determined == [False, True, True, True] for r in kept)
    covered = (np.abs(off) < 1.645 * std).mean(0)
    low, high = 0.9 + 3 * np.array([-1, 1]) * np.sqrt(0.09 / len(kept))
    assert ((covered > low) & (covered < high)).all(), covered
    assert (np.abs(off[0]) < 0.1 * std[0]).all(), "without noise it is the truth"
    # Straight on in logarithms many would miss by far.
    straight = np.log(fits[given, 1]) + (np.array([r.gain[1][0] for r in kept])) * (
        np.log(truth[0]) - np.log(fits[given, 0])
    )
    assert np.median(np.abs(np.exp(straight) - truth[1]) / std[:, 0]) > 3

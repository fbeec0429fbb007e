"""Results once the owner's weighed masses settle what motion alone cannot show."""

import numpy as np
import pytest

from easi_jax.estimation.identifiability import seed_result
from easi_jax.model.results import SeedResult
from envs import cartpole

SPACE = cartpole.space()
GEOMETRY = {
    "pole_length": 1.0,
    "pole_mass": -1.0,
    "pole_armature": -0.6,
    "cart_mass": 1 / 3,
}
LIMIT = SPACE.index("cart_force_limit")


def _common() -> np.ndarray:
    seen = [
        i for i, n in enumerate(SPACE.names) if n.endswith(("length", "speed_limit"))
    ]
    common = np.ones(SPACE.size)
    common[seen] = 0.0
    return common


def _geometry() -> np.ndarray:
    return np.array([GEOMETRY.get(n, 0.0) for n in SPACE.names])


def _information(unseen: list[np.ndarray], std: float) -> np.ndarray:
    """All directions of log ratios seen to ``std`` but for those; unit coordinates."""
    basis = np.linalg.qr(np.stack(unseen, 1))[0]
    info = (np.eye(SPACE.size) - basis @ basis.T) / std**2
    return info * np.outer(SPACE.log_width, SPACE.log_width)


def _found(off: np.ndarray, unseen: list[np.ndarray], std: float = 0.01) -> SeedResult:
    """A quarter of the stiffness, found but for log ratios ``off``."""
    truth = SPACE.nominal.copy()
    truth[SPACE.index("cart_kp")] *= 0.25
    mean = np.asarray(SPACE.to_unit(truth * np.exp(off)), float)
    info = _information(unseen, std)
    cov = np.linalg.inv(info + 12 * np.eye(SPACE.size))
    return seed_result(SPACE, mean, cov, info)


def test_all_is_known_relative_to_a_mass_and_a_length() -> None:
    limit = np.eye(SPACE.size)[LIMIT]
    off = 0.4 * _common() - 0.3 * _geometry() + 0.5 * limit
    found = _found(off, [_common(), _geometry(), limit])
    assert found.flags.count("determined") == 1  # the speed limit
    known = found.relative
    assert known is not None and len(known.taken) == 2
    assert set(known.taken) <= {"pole_length", "pole_mass", "cart_mass"}
    names = list(SPACE.names)
    for i, name in enumerate(names):
        expected = not (name in known.taken or i == LIMIT)
        assert known.determined[i] == expected, name
        if i != LIMIT:
            factor = 0.25 if name == "cart_kp" else 1.0
            wanted = factor * SPACE.nominal[i]
            assert known.mean[i] == pytest.approx(wanted, rel=2e-3), name
    kp = names.index("cart_kp")
    assert known.std[kp] < 0.05 * known.mean[kp] < found.std[kp]
    assert known.depends(names.index("cart_speed_limit")) == []
    assert known.depends(kp)
    # The truth, settled in the same way, is the model with a quarter of the stiffness.
    settled = known.settle(SPACE, np.array(found.mean))
    np.testing.assert_allclose(
        np.delete(settled, LIMIT), np.delete(known.mean, LIMIT), rtol=1e-4
    )


def test_what_leaves_no_trace_stays_unknown() -> None:
    found = _found(np.zeros(SPACE.size), [np.eye(SPACE.size)[LIMIT]])
    assert found.relative is None
    assert found.flags[LIMIT] == "not determined"
    assert found.flags.count("determined") == SPACE.size - 1


def test_a_direction_without_a_mass_stays_open() -> None:
    drive = np.zeros(SPACE.size)
    drive[[SPACE.index("cart_kv"), SPACE.index("cart_friction")]] = 1.0, -0.4
    found = _found(0.2 * drive, [drive, _common()])
    known = found.relative
    assert known is not None and len(known.taken) == 1
    assert set(known.taken) < {"pole_mass", "cart_mass"}
    open_ = {"cart_kv", "cart_friction", *known.taken}
    for name, determined in zip(SPACE.names, known.determined, strict=True):
        assert determined == (name not in open_), name
    assert _found(0.2 * drive, [drive]).relative is None


def test_what_the_search_left_wide_is_not_called_known() -> None:
    info = _information([_common()], 0.01)
    mean = np.asarray(SPACE.to_unit(SPACE.nominal), float)
    wide = seed_result(SPACE, mean, np.eye(SPACE.size) / 12, info).relative
    assert wide is not None and not any(wide.determined)


def test_a_weak_direction_is_not_called_known() -> None:
    found = _found(np.zeros(SPACE.size), [_common()], std=0.6)
    assert found.relative is None and "determined" not in found.flags

"""The covariance of a result: single precision must not pass for knowledge."""

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.identify import _posterior

PRIOR = 12.0 * np.eye(11)


def rows(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities over 4.5 decades that two directions do not enter, and those."""
    rows = rng.normal(size=(400, 11)) * 10.0 ** rng.uniform(0, 4.5, 11)
    common = np.r_[0.0, np.ones(9), 0.0]
    trade = np.zeros(11)
    trade[[0, 1, 5, 2]] = 1.0, -1.0, -0.6, 0.33
    null = np.linalg.qr(np.stack([common, trade], 1))[0]
    return rows - rows @ null @ null.T, null


def test_what_no_data_determine_keeps_the_initial_spread() -> None:
    for seed in range(5):
        j, null = rows(np.random.default_rng(seed))
        single = j.astype(np.float32)
        cov, seen = map(np.asarray, jax.jit(_posterior)(jnp.asarray(single.T @ single)))
        np.testing.assert_allclose(null.T @ cov @ null, np.eye(2) / 12, atol=2e-3)
        assert np.abs(seen @ null).max() < 0.05
        # Nowhere surer than the exact inverse of the exact information.
        exact = np.sqrt(np.diag(np.linalg.inv(j.T @ j + PRIOR)))
        assert (np.sqrt(np.diag(cov)) > 0.97 * exact).all()
        assert np.linalg.eigvalsh(cov).min() > -1e-7


def test_what_the_data_determine_is_the_inverse() -> None:
    j = np.random.default_rng(0).normal(size=(400, 11)) * 100
    info = (j.T @ j).astype(np.float32)
    cov, seen = map(np.asarray, _posterior(jnp.asarray(info)))
    np.testing.assert_allclose(cov, np.linalg.inv(info + PRIOR), rtol=1e-3, atol=1e-11)
    np.testing.assert_allclose(seen, np.eye(11), atol=1e-4)


def test_no_data_leave_the_initial_spread() -> None:
    cov, seen = _posterior(jnp.zeros((3, 3)))
    np.testing.assert_allclose(cov, np.eye(3) / 12, rtol=1e-6)
    np.testing.assert_allclose(seen, np.zeros((3, 3)), atol=1e-6)

"""EASI-JAX: simulator identification and repair in JAX."""

from easi_jax import _moved
from easi_jax.devices import runtime

_moved.install()
runtime.prepare()

__version__ = "0.1.0"

"""EASI-JAX: simulator identification and repair in JAX."""

from easi_jax import _moved
from easi_jax.devices import runtime
from easi_jax.version import __version__

_moved.install()
runtime.prepare()

__all__ = ["__version__"]

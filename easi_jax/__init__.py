"""EASI-JAX: simulator identification and repair in JAX."""

from easi_jax import runtime

runtime.prepare()

__version__ = "0.1.0"

"""Readies jax as users get it, before any test imports it."""

import easi_jax  # noqa: F401

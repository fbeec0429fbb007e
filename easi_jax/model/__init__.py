"""What may vary in a robot, and how it is written into a model."""

from easi_jax.model.mjx_model import Model, put_model, with_parameters

__all__ = ["Model", "put_model", "with_parameters"]

"""All stages as one compiled program."""

from easi_jax.pipeline.stages import (
    Pipeline,
    PipelineConfig,
    seed_keys,
    stage_keys,
    target_parameters,
)

__all__ = [
    "Pipeline",
    "PipelineConfig",
    "seed_keys",
    "stage_keys",
    "target_parameters",
]

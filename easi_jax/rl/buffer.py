"""Replay memory: brax's uniform queue as a ring, so that inserting moves no data."""

from typing import Any

import jax
from brax.training import replay_buffers


class RingQueue(replay_buffers.UniformSamplingQueue[Any]):
    """Overwrites the oldest entries; sampling is brax's.

    brax's own insertion rolls the whole memory to make room, which under ``vmap``
    is paid at each step. Here both positions count up without end and brax's
    sampling takes them modulo the capacity. The capacity has to be a multiple of
    the number of samples inserted at a time (``SacConfig.capacity`` is).
    """

    def insert_internal(self, buffer_state: Any, samples: Any) -> Any:
        """Writes ``samples`` (leading axis: how many) over the oldest entries."""
        rows = self._flatten_fn(samples)
        capacity, count = len(buffer_state.data), len(rows)
        if capacity % count:
            raise ValueError(f"capacity {capacity} is no multiple of {count}")
        data = jax.lax.dynamic_update_slice_in_dim(
            buffer_state.data, rows, buffer_state.insert_position % capacity, axis=0
        )
        end = buffer_state.insert_position + count
        return buffer_state.replace(
            data=data,
            insert_position=end,
            sample_position=jax.lax.max(end - capacity, 0),
        )

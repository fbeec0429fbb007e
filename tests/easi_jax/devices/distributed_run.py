"""A run in small: chunks of one program over the mesh, checkpoints, a result.

    python -m tests.easi_jax.devices.distributed_run --out FOLDER --distributed

Written with what the commands are written with, so that tests of several processes
need not compile a robot.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from train._command import main, say


@dataclasses.dataclass(frozen=True)
class Config:
    """Walks many points at random, each chunk towards their common mean."""

    out: Path
    """Folder of the run."""
    steps: int = 6
    """Steps in all."""
    slow: float = 0.0
    """Seconds that a chunk takes at least."""
    resume: bool = False
    """Go on with the run in the folder."""
    overwrite: bool = False
    """Delete the run in the folder first."""
    distributed: bool = False
    """One of several processes."""


def run(config: Config) -> None:
    """Walks, and writes the last points."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import NamedSharding, PartitionSpec

    from easi_jax.devices.distributed import local, started
    from easi_jax.devices.mesh import make_mesh, sharded_map
    from easi_jax.io.runs import checkpoints
    from easi_jax.io.runs.folder import RunFolder
    from train._stages import jit_chunks, run_stage

    mesh = make_mesh()
    keys = jax.vmap(jax.random.key)(jnp.arange(5, dtype=jnp.uint32))

    def init() -> Any:
        points = sharded_map(lambda k: jax.vmap(jax.random.normal)(k), mesh, keys)
        return {"key": keys, "point": points, "step": jnp.zeros((), jnp.int32)}

    def advance(state: Any, n: int) -> Any:
        def one(state: Any, _: Any) -> Any:
            split = jax.vmap(jax.random.split)(state["key"])
            mean = state["point"].mean()

            def local(items: Any, mean: jax.Array) -> jax.Array:
                point, key = items
                noise = jax.vmap(jax.random.normal)(key)
                return 0.9 * point + 0.1 * jnp.tanh(mean) + 0.1 * noise

            point = sharded_map(local, mesh, (state["point"], split[:, 1]), mean)
            new = {"key": split[:, 0], "point": point, "step": state["step"] + 1}
            return new, point.std()

        return jax.lax.scan(one, state, None, length=n)

    step = jit_chunks(advance)

    def chunk(state: Any, n: int) -> Any:
        time.sleep(config.slow)
        return step(state, n)

    given = dataclasses.replace(config, slow=0.0)
    with RunFolder.open(
        config.out,
        given,
        command="walk",
        resume=config.resume,
        overwrite=config.overwrite,
    ) as folder:
        ready = started(lambda: jnp.ones(3) * 2)
        notes: list[str] = []
        state = run_stage(
            folder,
            "walk",
            config.steps,
            2,
            init,
            chunk,
            lambda first, info: [(first + len(info), {"spread": float(info[-1])})],
            notes,
        )
        # A later program may close over what a stage has found.
        mean = jax.jit(lambda: state["point"].mean() * ready()[0] / 2)()
        points = np.asarray(state["point"])
        # Spread over the devices: no process has all of it.
        spread = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        far = jax.jit(lambda: jnp.arange(8.0) + mean, out_shardings=spread)()
        place, stamp = folder.checkpoints / "far", folder.config_hash
        checkpoints.save(place, 1, {"far": far}, config_hash=stamp)
        shape = {"far": jax.ShapeDtypeStruct((8,), jnp.float32)}
        found = checkpoints.restore(place, shape, config_hash=stamp)
        assert found is not None
        far, again = np.asarray(local(far)), np.asarray(found.state["far"])
        folder.write_json(
            "results.json",
            {"points": points, "mean": float(mean), "far": far, "again": again},
        )
    for note in notes:
        say(f"note: {note}")
    say(f"devices: {jax.device_count()}, mean {float(mean):.4f}")


if __name__ == "__main__":
    main(Config, run, name="tests.easi_jax.devices.distributed_run")

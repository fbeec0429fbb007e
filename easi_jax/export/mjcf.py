"""An identified machine as MJCF that plain MuJoCo loads."""

import dataclasses
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.models.repaired_mjcf import Repaired, repaired_model
from easi_jax.model.found_effects import EffectEntry
from easi_jax.simulation.mujoco_c import InMujoco
from easi_jax.simulation.simulator import Simulator


def identified_model(
    source: Path,
    simulator: Simulator,
    theta: np.ndarray,
    entries: Sequence[EffectEntry] = (),
) -> Repaired:
    """The MJCF of ``source`` with parameters ``theta (n,)``, SI, and effects in it.

    Args:
        source: file that the machine's model came from.
        simulator: whose parameters they are.
        entries: effects that the machine has besides.

    Raises:
        UserError: ``source`` is another model than the machine's.
    """
    unit = np.asarray(simulator.space.to_unit(theta), float)
    write = InMujoco(simulator)
    model = write.at(unit)
    # MuJoCo writes numbers of a model back into the text that it read last.
    read = mujoco.MjModel.from_xml_path(str(source))
    if _sizes(read) != _sizes(model):
        raise UserError(f"{source} is not the model that these parameters are of")
    lost = [
        name
        for name, reached in zip(simulator.space.names, write.reaches, strict=True)
        if not reached
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        mujoco.mj_saveLastXML(str(path), model)
        # MuJoCo writes it and then warns that it is of no use.
        text = re.sub(r'\s*meaninertia="[^"]*"', "", path.read_text())
    model = repaired_model(source, entries, text)
    return dataclasses.replace(model, left=[*lost, *model.left])


def _sizes(m: mujoco.MjModel) -> tuple[object, ...]:
    return (m.nq, m.nv, m.nu, m.nbody, m.ngeom, m.names)

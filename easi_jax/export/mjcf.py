"""An identified machine as MJCF that plain MuJoCo loads."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.models.completed import as_read
from easi_jax.io.models.mjcf import mujoco_warnings
from easi_jax.io.models.repaired_mjcf import Repaired, repaired_model
from easi_jax.model.found_effects import EffectEntry, FoundEffects, set_by_none
from easi_jax.model.parameters import Parameter, ParameterSpace
from easi_jax.model.written_effects import Undo, is_written
from easi_jax.simulation.mujoco_c import InMujoco
from easi_jax.simulation.simulator import Simulator

# Numbers of a model's parts, and what MuJoCo calls those whose names are compared.
_COUNTS = {
    **{"nbody": mujoco.mjtObj.mjOBJ_BODY, "njnt": mujoco.mjtObj.mjOBJ_JOINT},
    **{"ngeom": mujoco.mjtObj.mjOBJ_GEOM, "nsite": mujoco.mjtObj.mjOBJ_SITE},
    **{"ncam": mujoco.mjtObj.mjOBJ_CAMERA, "nlight": mujoco.mjtObj.mjOBJ_LIGHT},
    **{"nmesh": mujoco.mjtObj.mjOBJ_MESH, "nhfield": mujoco.mjtObj.mjOBJ_HFIELD},
    **{"ntex": mujoco.mjtObj.mjOBJ_TEXTURE, "nmat": mujoco.mjtObj.mjOBJ_MATERIAL},
    **{"npair": mujoco.mjtObj.mjOBJ_PAIR, "nexclude": mujoco.mjtObj.mjOBJ_EXCLUDE},
    **{"neq": mujoco.mjtObj.mjOBJ_EQUALITY, "ntendon": mujoco.mjtObj.mjOBJ_TENDON},
    **{"nu": mujoco.mjtObj.mjOBJ_ACTUATOR, "nsensor": mujoco.mjtObj.mjOBJ_SENSOR},
    **{"nnumeric": mujoco.mjtObj.mjOBJ_NUMERIC, "ntext": mujoco.mjtObj.mjOBJ_TEXT},
    **{"ntuple": mujoco.mjtObj.mjOBJ_TUPLE, "nkey": mujoco.mjtObj.mjOBJ_KEY},
    **{"nflex": mujoco.mjtObj.mjOBJ_FLEX, "nskin": mujoco.mjtObj.mjOBJ_SKIN},
    "nplugin": mujoco.mjtObj.mjOBJ_PLUGIN,
}


def identified_model(
    source: Path,
    simulator: Simulator,
    theta: np.ndarray,
    entries: Sequence[EffectEntry] = (),
    undo: Undo | None = None,
) -> Repaired:
    """The MJCF of ``source`` with parameters ``theta (n,)``, SI, and effects in it.

    Args:
        source: file that the machine's model came from.
        simulator: whose parameters they are.
        entries: effects that the machine has besides.
        undo: what the text keeps of effects that are in its numbers.

    Raises:
        UserError: ``source`` is another model than the machine's, or MuJoCo cannot
            write it.
    """
    with mujoco_warnings():
        read = as_read(source, simulator.mj_model).compile()
    if not _is_named(read, simulator.mj_model):
        raise UserError(f"{source} is not the model that these parameters are of")
    write = InMujoco(simulator)
    with jax.enable_x64(True):  # a space of its own, as in `InMujoco`
        space = dataclasses.replace(simulator.space)
        unit = np.asarray(space.to_unit(np.asarray(theta, np.float64)))
    model = repaired_model(source, entries, write.at(unit), undo)
    lost = [
        name
        for name, reached in zip(simulator.space.names, write.reaches, strict=True)
        if not reached
    ]
    return dataclasses.replace(model, left=[*lost, *model.left])


def _is_named(m: mujoco.MjModel, given: mujoco.MjModel) -> bool:
    """Whether ``m`` is of ``given``'s size, with its names, and perhaps more."""
    if any(getattr(m, n) != getattr(given, n) for n in ("nq", "nv", *_COUNTS)):
        return False
    return all(
        name in (None, mujoco.mj_id2name(m, kind, i))
        for n, kind in _COUNTS.items()
        for i in range(getattr(m, n))
        for name in [mujoco.mj_id2name(given, kind, i)]
    )


def written_machine(
    source: Path,
    mj_model: mujoco.MjModel,
    dt: float | None,
    parameters: Sequence[Parameter],
    values: Mapping[str, float],
    effects: FoundEffects,
) -> Repaired:
    """`identified_model` of a machine some of whose parameters are those of effects.

    Args:
        source: file that the model came from.
        mj_model: the model as given.
        dt: control step [s]; None: the model's timestep.
        parameters: of the model and of its effects.
        values: of each, by name, SI.
        effects: as they were given.

    Raises:
        UserError: as `identified_model`.
    """
    by_address = {a: values[p.name] for p in parameters for a in p.addresses}
    entries = [
        dataclasses.replace(
            e,
            columns={c: by_address.get(e.address(c), v) for c, v in e.columns.items()},
        )
        for e in effects.entries
    ]
    # An entry says what its numbers are; other effects are parameters of the model.
    said = {e.address(c) for e in entries for c in e.columns}
    space = ParameterSpace(tuple(p for p in parameters if not said & {*p.addresses}))
    own = set_by_none(mj_model, space.addresses, effects.own or {})
    theta = np.array([values[name] for name in space.names], float)
    simulator = Simulator(mj_model, space, dt, fixed=own)
    held = {e.address(c): v for e in entries for c, v in e.columns.items()} | by_address
    held = {a: v for a, v in held.items() if is_written(a)}
    if not held:
        return identified_model(source, simulator, theta, entries)
    less = [p.name for p in space.parameters if not held.keys() & {*p.addresses}]
    plain = identified_model(
        *(source, Simulator(mj_model, space.select(less), dt, fixed=own)),
        np.array([values[name] for name in less], float),
        [e for e in entries if not any(e.address(c) in held for c in e.columns)],
    )
    return identified_model(source, simulator, theta, entries, Undo(plain.model, held))

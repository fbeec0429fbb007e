"""Recordings as PACE makes them: ``torch.save`` of time, positions and targets."""

from pathlib import Path

import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.importers.streams import (
    Recording,
    Role,
    Selection,
    Stream,
    listed,
    stream,
)
from easi_jax.io.importers.torch_zip import read_tensors

_STATE, _COMMAND, _VELOCITY = "dof_pos", "des_dof_pos", "dof_vel"


def read_pace(path: Path, selection: Selection) -> Recording:
    """Reads a ``.pt`` file with ``time`` ``(T,)``, ``dof_pos`` and ``des_dof_pos``.

    The two, each ``(T, n)``, and ``dof_vel``, if there, have one order of joints.

    Raises:
        UserError: the file asks for more than tensors, lacks one, or they differ in
            length.
    """
    if selection.episodes:
        raise UserError(f"{path}: this recording has no episodes to choose from")
    tensors = read_tensors(path)
    states = selection.state or (_STATE,)
    commands = selection.command or (_COMMAND,)
    for key in ("time", *states, *commands):
        if key not in tensors:
            raise UserError(
                f'{path}: no tensor "{key}"{nearest(key, tensors)} '
                f"(it has {listed(list(tensors))})"
            )
    time = tensors["time"].astype(float)
    if time.ndim != 1:
        raise UserError(f"{path}: time is {time.ndim}-dimensional, not a row of times")
    roles: dict[str, Role] = dict.fromkeys(states, "qpos")
    roles |= dict.fromkeys(commands, "ctrl")
    if _VELOCITY in tensors:
        roles.setdefault(_VELOCITY, "qvel")
    streams: list[Stream] = []
    for key, role in roles.items():
        values = tensors[key].astype(float)
        if not values.size:
            raise UserError(f"{path}: {key} is empty")
        if values.ndim not in (1, 2):
            shape = "x".join(map(str, values.shape))
            raise UserError(f"{path}: {key} is {shape}, not rows by joints")
        try:
            streams.append(stream(key, role, time, values.reshape(len(values), -1)))
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
    others = [
        stream(key, "", time, values.astype(float).reshape(len(time), -1))
        for key, values in tensors.items()
        if key not in roles
        and key != "time"
        and values.size
        and values.ndim in (1, 2)
        and len(values) == len(time)
        and np.issubdtype(values.dtype, np.number)
    ]
    return Recording(str(path), path.stem, (*streams, *others))

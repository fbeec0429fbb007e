"""``model.xml``: a model with other numbers and effects, that plain MuJoCo loads.

Numbers are set in the compiled model, as the simulator sets them, and MuJoCo writes
them back into the text. What it derives from others when it compiles (inertias, gains
of a damping ratio, inherited ranges) is made explicit first. The text is loaded again
and every number compared with what was meant.
"""

import contextlib
import ctypes
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.models.completed import as_read
from easi_jax.io.models.mjcf import mujoco_warnings, ways
from easi_jax.model.effect_catalog import CATALOG
from easi_jax.model.effect_numbers import EffectEntry
from easi_jax.model.found_laws import public_name
from easi_jax.model.joint_space import joint_name
from easi_jax.model.written_effects import Undo, forget, keep, numbers

_ASSETS = "assets"  # folder beside the model
_DIGITS = 17  # of a double, so that it is read as it was
_LONG_NUMBER = re.compile(r'(?<=[\s"])-?(?=[\d.]{16})\d*\.?\d+(?:e[-+]?\d+)?(?=[\s"])')
_RELATIVE = 1e-9  # of a number that is read again: far above rounding, below any use
_ABSOLUTE = 1e-12  # of one that is about zero, in its own unit
_TOLD = 20  # deviations that are listed one by one
_OBJECTS = {
    **{"body": "nbody", "jnt": "njnt", "geom": "ngeom", "actuator": "nu"},
    **{"dof": "nv", "tendon": "ntendon", "eq": "neq", "sensor": "nsensor"},
    **{"site": "nsite", "cam": "ncam", "mesh": "nmesh", "key": "nkey"},
}


@dataclass(frozen=True)
class Repaired:
    """A model that loads in plain MuJoCo.

    Attributes:
        xml: its text.
        assets: files that it names (meshes, textures, height fields), by the names
            that it has for them; they belong beside it.
        left: what is not in it: effects that MJCF has no word for (a constant torque
            at a joint, torque ripple, late sensors ...), and numbers that are not
            those that were meant, each with both values.
        model: the text, compiled.
    """

    xml: str
    assets: dict[str, Path]
    left: list[str]
    model: mujoco.MjModel

    def files(self) -> dict[str, str | bytes]:
        """Contents by name: the assets, then ``model.xml``."""
        assets = {name: place.read_bytes() for name, place in self.assets.items()}
        return {**assets, "model.xml": self.xml}


def repaired_model(
    path: Path,
    entries: Sequence[EffectEntry],
    meant: mujoco.MjModel | None = None,
    undo: Undo | None = None,
) -> Repaired:
    """A model with effects.

    Args:
        path: the model as given.
        entries: effects.
        meant: a compiled model with the numbers that it shall have before effects;
            those of ``path`` where not given.
        undo: what the text keeps of effects that are in its numbers.

    Raises:
        UserError: MuJoCo cannot write this model.
    """
    try:
        with mujoco_warnings(), _all_digits():
            return _repaired(path, entries, meant, undo)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"{path}: MuJoCo cannot write this model with other numbers ({reason}); "
            "state what it derives (inertias, ranges, gains) as numbers"
        ) from None


def _repaired(
    path: Path,
    entries: Sequence[EffectEntry],
    meant: mujoco.MjModel | None,
    undo: Undo | None,
) -> Repaired:
    spec, given, assets = _explicit(path, meant)
    off = _set_all(spec, given if meant is None else meant)
    left = []
    for e in entries:
        before = spec.copy()
        before.assets = spec.assets
        try:
            added = _add(spec, e)
        except (ValueError, mujoco.FatalError):
            added = None
        if added is None:
            left.append(public_name(f"{e.effect}@{e.at}" if e.at else e.effect))
            spec = before
        else:
            off += added
    forget(spec)
    if undo is not None:
        keep(spec, spec.compile(), undo)
    wanted = spec.compile()
    xml = _LONG_NUMBER.sub(lambda n: repr(float(n[0])), spec.to_xml())
    read = mujoco.MjSpec.from_string(xml, assets=spec.assets).compile()
    off += deviations(read, wanted)
    off = list(dict.fromkeys(off))
    more = [f"and {len(off) - _TOLD} more numbers"] if len(off) > _TOLD else []
    return Repaired(xml, assets, [*left, *off[:_TOLD], *more], read)


@contextlib.contextmanager
def _all_digits() -> Iterator[None]:
    """MuJoCo writes numbers with 6 digits unless told by a function of its own."""
    folder = Path(mujoco.__file__).parent
    library = next(folder.glob("*mujoco*.so*"), None) or next(
        folder.glob("*mujoco*.d[yl]*l*"), None
    )
    if library is None:
        raise RuntimeError(f"no MuJoCo library in {folder}")
    private: Any = ctypes.CDLL(str(library))
    before = private._mjPRIVATE__get_xml_precision()
    private._mjPRIVATE__set_xml_precision(_DIGITS)
    try:
        yield
    finally:
        private._mjPRIVATE__set_xml_precision(before)


def _explicit(
    path: Path, meant: mujoco.MjModel | None
) -> tuple[mujoco.MjSpec, mujoco.MjModel, dict[str, Path]]:
    """A model in which nothing is derived that can be stated, its numbers as given,
    and its files."""
    spec = as_read(path, meant)
    given = spec.compile()  # says where files named by included ones are, too
    assets = _gathered(spec, given, path.parent)
    spec.compile()
    own = spec.compiler
    infer = own.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    least = (own.boundmass, own.boundinertia, own.settotalmass)
    if infer or own.balanceinertia or any(x > 0 for x in least):
        own.saveinertial = True
    out = mujoco.MjSpec.from_string(spec.to_xml(), assets=spec.assets)
    out.assets = spec.assets
    stated = out.compiler
    stated.boundmass = stated.boundinertia = stated.settotalmass = 0.0
    stated.balanceinertia = False
    stated.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    return out, given, assets


def _set_all(spec: mujoco.MjSpec, meant: mujoco.MjModel) -> list[str]:
    """Gives a model all numbers of another one of the same structure.

    Returns:
        What could not be set.
    """
    fields = [n for n, x in numbers(spec.compile()) if np.size(x)]
    try:
        _changed(spec, lambda m: _copy(m, meant, fields))
    except ValueError:
        for name in fields:
            # One by one: what cannot be said is found by comparing.
            with contextlib.suppress(ValueError):
                _changed(spec, lambda m, name=name: _copy(m, meant, [name]))
    return deviations(spec.compile(), meant)


def _copy(m: mujoco.MjModel, other: mujoco.MjModel, fields: Sequence[str]) -> None:
    theirs = dict(numbers(other))
    for name, value in numbers(m):
        wanted = theirs[name]
        if name not in fields or np.array_equal(value, wanted):
            continue
        *path, last = name.split(".")
        owner = getattr(m, path[0]) if path else m
        if np.ndim(value):
            getattr(owner, last)[:] = wanted
        else:
            setattr(owner, last, wanted)


def _changed(
    spec: mujoco.MjSpec, change: Callable[[mujoco.MjModel], None]
) -> mujoco.MjModel:
    """The compiled model after a change of its numbers, which ``spec`` then has.

    Raises:
        ValueError: MJCF cannot say it; ``spec`` is as before.
    """
    m = spec.compile()
    change(m)
    mujoco.mj_setConst(m, mujoco.MjData(m))
    spec.copy_back(m)
    return m


def deviations(got: mujoco.MjModel, meant: mujoco.MjModel) -> list[str]:
    """Numbers of a compiled model that are not those of another one, as text.

    Every size and every array is compared, to 1e-9 of its value.
    """
    out = []
    theirs = dict(numbers(meant))
    for name, value in numbers(got):
        a, b = np.asarray(value), np.asarray(theirs[name])
        if a.shape != b.shape:
            out.append(f"{name}: {len(a)} in place of {len(b)}")
            continue
        if a.dtype.kind not in "fiub":
            continue
        a, b = a.astype(float), b.astype(float)
        near = np.isclose(a, b, _RELATIVE, _ABSOLUTE, equal_nan=True)
        for index in np.argwhere(~near):
            at = tuple(index)
            where = _place(got, name, at)
            out.append(f"{name}{where}: {a[at]:.9g} in place of {b[at]:.9g}")
    return out


def _place(m: mujoco.MjModel, name: str, index: tuple[int, ...]) -> str:
    """`` of NAME`` where an array has a row for each of something that has a name."""
    if not index:
        return ""
    kind = name.split("_")[0]
    if kind == "dof":
        return f" of {joint_name(m, int(m.dof_jntid[index[0]]))}"
    count = _OBJECTS.get(kind)
    access: Any = getattr(m, {"jnt": "joint", "cam": "camera"}.get(kind, kind), None)
    if count is None or getattr(m, count) <= index[0] or access is None:
        return f"[{', '.join(map(str, index))}]"
    return f" of {access(int(index[0])).name or f'{kind} {index[0]}'}"


def _gathered(spec: mujoco.MjSpec, m: mujoco.MjModel, folder: Path) -> dict[str, Path]:
    """Files of a model, of which ``m`` was compiled; it is changed to name them beside
    it."""
    out: dict[str, Path] = {}

    def renamed(file: str, below: str, read: str = "") -> str:
        place = _found(file, folder, below, read) if file else None
        if place is None:
            return file
        count, name = 1, f"{_ASSETS}/{place.name}"
        while out.setdefault(name, place) != place:
            count += 1
            name = f"{_ASSETS}/{place.stem}_{count}{place.suffix}"
        return name

    for items, adr in (
        (spec.meshes, m.mesh_pathadr),
        (spec.hfields, m.hfield_pathadr),
        (spec.skins, m.skin_pathadr),
    ):
        for item in items:
            read = _path(m, int(adr[item.id]))
            item.file = renamed(item.file, item.compiler.meshdir, read)
    for texture in spec.textures:
        below, read = texture.compiler.texturedir, _path(m, m.tex_pathadr[texture.id])
        texture.file = renamed(texture.file, below, read)
        for i, file in enumerate(texture.cubefiles):
            texture.cubefiles[i] = renamed(file, below)
    spec.meshdir = spec.texturedir = ""
    spec.assets = {name: place.read_bytes() for name, place in out.items()}
    return out


def _path(m: mujoco.MjModel, start: int) -> str:
    """A file that MuJoCo read; ``""`` where none is told."""
    return m.paths[start : m.paths.index(b"\0", start)].decode() if start >= 0 else ""


def _found(file: str, folder: Path, below: str, read: str) -> Path | None:
    """The file that MuJoCo read, where it tells; of the sides of a cube in an attached
    model their names alone are left."""
    tried = [Path(read)] if read else []
    tried += [
        folder / part / way
        for way in sorted(ways(file), key=len, reverse=True)
        for part in (below, "")
    ]
    tried += [folder / below / Path(file).name]
    tried += sorted(folder.rglob(Path(file).name))
    return next((place.resolve() for place in tried if place.is_file()), None)


def _add(spec: mujoco.MjSpec, e: EffectEntry) -> list[str] | None:
    """Adds an effect.

    Returns:
        Numbers that are not as meant; None: MJCF has no word for the effect.

    Raises:
        ValueError: as before, found only when it was written.
    """
    mjcf = CATALOG[e.effect].mjcf
    if mjcf is None or not mjcf.build(spec, spec.compile(), e):
        return None
    meant = _changed(spec, lambda m: mjcf.write(m, e))
    return deviations(spec.compile(), meant)

"""Reads MJCF, and keeps the files that it names inside the model's folder."""

import contextlib
import itertools
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.files import os_reason, regular_file
from easi_jax.io.models.completed import (
    as_read,
    held_joint,
    hold,
    names_note,
    new_names,
)
from easi_jax.model.mjx_model import put_model, simulated
from easi_jax.model.mujoco_warnings import warnings_to
from easi_jax.simulation import engine

_FOLDERS = ("meshdir", "texturedir", "assetdir")
_NESTED = ("include", "model")  # elements whose file is MJCF as well
_MOST = 100_000  # places that a model may name
# Elements whose numbers make MuJoCo build as much as they say, and what is sane.
_COPIES = {"replicate": "count", "composite": "count", "flexcomp": "count"}
_CELLS = {"texture": ("width", "height"), "hfield": ("nrow", "ncol")}
_MOST_COPIES = 100_000
_MOST_CELLS = 1 << 27
_MOST_SIZES = 100_000  # of key frames, and of numbers for users at an element
# What tinyxml2, MuJoCo's parser, skips: these may hold anything, quotes included.
_SKIPPED = (("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>"), ("<!", ">"))
_TAG = re.compile(r"<((?:[^\"'>]++|\"[^\"]*+\"|'[^']*+')*+)>")
_NAME = re.compile(r"[^\s/\"'=]+")
_ATTRIBUTE = re.compile(
    r"(?<![^\s\"'/])([^\s\"'=/]++)\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')"
)
_REFERENCE = re.compile(r"&(?:#x([0-9a-fA-F]{1,6})|#([0-9]{1,7})|(\w{2,4}));")
_ENTITIES = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=5)


def read_mjcf(
    path: Path,
    allowed: Sequence[Path] = (),
    tell: Callable[[str], None] = _warn,
    held: Callable[[mujoco.MjModel], np.ndarray] | None = None,
) -> mujoco.MjModel:
    """The compiled model in ``path``; its bodies, joints and actuators without a name
    get one.

    Files that it includes, and its meshes, textures and height fields, must lie in
    its folder or below, symbolic links followed: a model from elsewhere cannot read
    other files.

    Args:
        path: MJCF or URDF.
        allowed: further files, or folders with all below them, that it may name.
        tell: takes what the user should know, a line each; warns where not given.
        held: where the base was held, its pose ``(7,)`` given the free model; the free
            joint is then removed (`easi_jax.io.models.completed.hold`).

    Raises:
        UserError: the file cannot be read, it names a file outside, or MuJoCo does
            not accept it.
    """
    check_assets(path, allowed)
    with mujoco_warnings() as said:
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
            model.names.decode()
            simulated(model)
            note = names_note(model)
            if any(new_names(model).values()) or held:
                spec = as_read(path)
                model = spec.compile()
                if held and not held_joint(model):
                    model = hold(spec, model, held(model))
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        except UnicodeDecodeError:
            raise UserError(
                f"{path}: a name in it is not UTF-8 text; save the file as UTF-8"
            ) from None
        except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
            reason = " ".join(f"{error} {' '.join(said)}".split())
            raise UserError(
                f"{path}: MuJoCo cannot read this model: {reason}"
            ) from None
    for text in dict.fromkeys([*said, note] if note else said):
        tell(f"{path}: {text}")
    return model


@contextlib.contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collects what MuJoCo warns of, which otherwise goes to a file in the working
    folder."""
    said: list[str] = []
    with warnings_to(said.append), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield said


def check_assets(path: Path, allowed: Sequence[Path] = ()) -> list[Path]:
    """The files that a model names, directly or in files that it includes; none may lie
    outside of its folder and of ``allowed``.

    Every place where MuJoCo may look is tried: relative to the model, to the file
    that names it, and to each folder of a ``compiler`` element.

    Raises:
        UserError: such a file, a folder or a device in place of a file, a file that
            includes itself, or no XML.
    """
    if not os.path.isfile(path):  # Path.is_file raises in folders that may not be read
        raise UserError(f"{path}: no such model file, or not to be read")
    roots = [path.parent.resolve(), *(place.resolve() for place in allowed)]
    folders, below, named = {path.parent}, {""}, set[tuple[Path | None, str]]()
    todo, seen, tried = [path], {path.resolve()}, set[tuple[Path | None, Path]]()
    leads: dict[Path, set[Path]] = {}
    found: dict[Path, Path] = {}  # the first place of each, by what it is
    while todo:
        document = todo.pop()
        folders.add(document.parent)
        tags = list(_tags(document))
        _refuse_huge(document, tags)
        for element, attributes in tags:
            for key, value in attributes.items():
                if key in _FOLDERS:
                    below.add(value)
                elif key.startswith("file"):
                    nested = element in _NESTED
                    if nested and not value:
                        raise UserError(f'{path}: "{element}" without a file name')
                    named.add((document.resolve() if nested else None, value))
        if len(folders) * len(below) * len(named) > _MOST:
            raise UserError(f"{path}: names too many files and folders")
        for folder, part, (parent, value) in itertools.product(folders, below, named):
            for text in ways(value):
                place = folder / part / text
                if (parent, place) in tried or not os.path.lexists(place):
                    continue
                tried.add((parent, place))
                real = _confined(path, value, place, roots)
                found.setdefault(real, place)
                if parent is None:
                    continue
                leads.setdefault(parent, set()).add(real)
                if real not in seen:
                    seen.add(real)
                    todo.append(place)
    _refuse_circles(path, leads)
    return sorted(found.values())


def _refuse_circles(path: Path, leads: dict[Path, set[Path]]) -> None:
    """Refuses a file that leads back to itself, which ends MuJoCo's process."""
    left = {file: set(named) for file, named in leads.items()}
    while left:
        ends = {file for file, named in left.items() if not named & left.keys()}
        if not ends:
            raise UserError(f"{path}: {min(left).name} includes itself")
        left = {file: named for file, named in left.items() if file not in ends}


def ways(value: str) -> set[str]:
    """Ways in which MuJoCo may read a file name; URDF's have a scheme before them."""
    plain = re.sub(r"^\w+://", "", value)
    return {value, plain, value.replace("\\", "/"), plain.replace("\\", "/")} - {""}


def _confined(path: Path, value: str, place: Path, roots: Sequence[Path]) -> Path:
    try:
        real = place.resolve(strict=True)
    except (OSError, RuntimeError):
        raise UserError(f"{path}: {value} is a link that leads nowhere") from None
    if not any(real.is_relative_to(root) for root in roots):
        raise UserError(
            f"{path}: {value} lies outside of the model's folder ({real}): copy it "
            "there, or say --allow-assets with that file or a folder above it"
        )
    if not real.is_file():
        raise UserError(f"{path}: {value} is no file")
    return real


def _refuse_huge(path: Path, tags: Sequence[tuple[str, dict[str, str]]]) -> None:
    """Refuses numbers for which MuJoCo would build until memory or patience ends."""
    copies, opened = 0.0, [1.0]
    cells = 0.0
    for element, attributes in tags:
        if element == "/replicate" and len(opened) > 1:
            opened.pop()
        elif element in _COPIES:
            count = opened[-1] * _product([attributes.get(_COPIES[element], "")])
            copies += count
            if element == "replicate":
                opened.append(count)
        elif element in _CELLS:
            cells += _product([attributes.get(key, "") for key in _CELLS[element]])
        user = [v for k, v in attributes.items() if k == "nkey" or k[:6] == "nuser_"]
        sizes = _product(user) if element == "size" else 0.0
        for what, much, most in (
            ("copies of elements", copies, _MOST_COPIES),
            ("pixels and cells", cells, _MOST_CELLS),
            ("key frames or user numbers", sizes, _MOST_SIZES),
        ):
            if much > most:
                raise UserError(f"{path}: {much:.3g} {what}, more than {most:,}")


def _product(texts: Sequence[str]) -> float:
    """Product of all numbers in them; what is no number is left to MuJoCo."""
    out = 1.0
    for number in " ".join(texts).split():
        with contextlib.suppress(ValueError):
            out *= max(float(number), 1.0)
    return out


def _tags(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Each tag of an XML file: element and attributes (lower case).

    An element that ends comes as ``/name`` without attributes; one that is empty does
    both at once.
    """
    broken = UserError(f"{path}: not an XML text")
    try:
        regular_file(path)
        text = os.fsdecode(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({os_reason(error)})") from None
    if "\0" in text:
        raise broken
    at = text.find("<")
    while at >= 0:
        end = next((e for b, e in _SKIPPED if text.startswith(b, at)), None)
        if end is not None:
            stop = text.find(end, at + 2)
            if stop < 0:
                raise broken
            at = text.find("<", stop + len(end))
            continue
        tag = _TAG.match(text, at)
        if tag is None:
            raise broken
        match = _NAME.search(tag[1])
        name = match[0] if match else ""
        attributes = {}
        for key, double, single in _ATTRIBUTE.findall(tag[1]):
            value = _REFERENCE.sub(_character, double or single)
            if "\0" in value:
                raise broken
            attributes[key.lower()] = value
        if tag[1].startswith("/"):
            yield f"/{name}", {}
        else:
            yield name, attributes
            if tag[1].endswith("/"):
                yield f"/{name}", {}
        at = text.find("<", tag.end())


def _character(reference: re.Match[str]) -> str:
    sixteen, ten, name = reference.groups()
    if name:
        return _ENTITIES.get(name, reference[0])
    code = int(sixteen, 16) if sixteen else int(ten)
    return chr(code) if code <= 0x10FFFF else reference[0]


def read_machine(
    path: Path,
    allowed: Sequence[Path] = (),
    tell: Callable[[str], None] = _warn,
    held: Callable[[mujoco.MjModel], np.ndarray] | None = None,
    logged: bool = False,
) -> mujoco.MjModel:
    """`read_mjcf` of something that moves and that the engine in use can simulate
    (`easi_jax.simulation.engine`).

    Args:
        path, allowed, tell, held: as `read_mjcf` takes them.
        logged: whether logs are read next: the engine is then chosen at their states
            (`easi_jax.simulation.simulator.Simulator`), and here it is only seen
            whether there is one.

    Raises:
        UserError: as `read_mjcf`, `easi_jax.simulation.engine.resolved` and
            `easi_jax.model.mjx_model.put_model`; or the model has no joint.
    """
    model = read_mjcf(path, allowed, tell, held)
    if model.nv == 0:
        raise UserError(f"{path}: the model has no joint, so nothing can be identified")
    try:
        if not logged:
            native = engine.resolved(None, model) == "mujoco"
            put_model(model, sensors=False, native=native)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return model

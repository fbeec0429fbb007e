"""Reads MJCF, and keeps the files that it names inside the model's folder."""

import itertools
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco

from easi_jax.errors import UserError
from easi_jax.io.files import os_reason, regular_file

_FOLDERS = ("meshdir", "texturedir", "assetdir")
_NESTED = ("include", "model")  # elements whose file is MJCF as well
_MOST = 100_000  # places that a model may name
# What tinyxml2, MuJoCo's parser, skips: these may hold anything, quotes included.
_SKIPPED = (("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>"), ("<!", ">"))
_TAG = re.compile(r"<((?:[^\"'>]++|\"[^\"]*+\"|'[^']*+')*+)>")
_NAME = re.compile(r"[^\s/\"'=]+")
_ATTRIBUTE = re.compile(
    r"(?<![^\s\"'/])([^\s\"'=/]++)\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')"
)
_REFERENCE = re.compile(r"&(?:#x([0-9a-fA-F]{1,6})|#([0-9]{1,7})|(\w{2,4}));")
_ENTITIES = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}


def read_mjcf(path: Path, allowed: Sequence[Path] = ()) -> mujoco.MjModel:
    """The compiled model in ``path``.

    Files that it includes, and its meshes, textures and height fields, must lie in
    its folder or below, symbolic links followed: a model from elsewhere cannot read
    other files.

    Args:
        path: MJCF or URDF.
        allowed: further files, or folders with all below them, that it may name.

    Raises:
        UserError: the file cannot be read, it names a file outside, or MuJoCo does
            not accept it.
    """
    check_assets(path, allowed)
    said: list[str] = []
    # Without a handler MuJoCo writes warnings to a file in the working folder.
    mujoco.set_mju_user_warning(said.append)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RecursionError, MemoryError, mujoco.FatalError) as error:
        reason = " ".join(f"{error} {' '.join(said)}".split())
        raise UserError(f"{path}: MuJoCo cannot read this model: {reason}") from None
    finally:
        mujoco.set_mju_user_warning(None)
    for text in said:
        warnings.warn(f"{path}: {text}", stacklevel=2)
    return model


def check_assets(path: Path, allowed: Sequence[Path] = ()) -> None:
    """Refuses a model that names a file outside of its folder and of ``allowed``.

    Every place where MuJoCo may look is tried: relative to the model, to the file
    that names it, and to each folder of a ``compiler`` element.

    Raises:
        UserError: such a file, a folder or a device in place of a file, a file that
            includes itself, or no XML.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such model file")
    roots = [path.parent.resolve(), *(place.resolve() for place in allowed)]
    folders, below, named = {path.parent}, {""}, set[tuple[Path | None, str]]()
    todo, seen, tried = [path], {path.resolve()}, set[tuple[Path | None, Path]]()
    leads: dict[Path, set[Path]] = {}
    while todo:
        document = todo.pop()
        folders.add(document.parent)
        for element, key, value in _attributes(document):
            if key in _FOLDERS:
                below.add(value)
            elif key.startswith("file"):
                if element in _NESTED and not value:
                    raise UserError(f'{path}: "{element}" without a file name')
                named.add((document.resolve() if element in _NESTED else None, value))
        if len(folders) * len(below) * len(named) > _MOST:
            raise UserError(f"{path}: names too many files and folders")
        for folder, part, (parent, value) in itertools.product(folders, below, named):
            for text in ways(value):
                place = folder / part / text
                if (parent, place) in tried or not os.path.lexists(place):
                    continue
                tried.add((parent, place))
                real = _confined(path, value, place, roots)
                if parent is None:
                    continue
                leads.setdefault(parent, set()).add(real)
                if real not in seen:
                    seen.add(real)
                    todo.append(place)
    _refuse_circles(path, leads)


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


def _attributes(path: Path) -> Iterator[tuple[str, str, str]]:
    """Element, attribute (lower case) and value of each attribute in an XML file."""
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
        name = _NAME.match(tag[1])
        for key, double, single in _ATTRIBUTE.findall(tag[1]):
            value = _REFERENCE.sub(_character, double or single)
            if "\0" in value:
                raise broken
            yield name[0] if name else "", key.lower(), value
        at = text.find("<", tag.end())


def _character(reference: re.Match[str]) -> str:
    sixteen, ten, name = reference.groups()
    if name:
        return _ENTITIES.get(name, reference[0])
    code = int(sixteen, 16) if sixteen else int(ten)
    return chr(code) if code <= 0x10FFFF else reference[0]

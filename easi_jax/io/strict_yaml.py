"""Plain data from YAML, strictly: no tags, no key twice, no aliases that explode."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError
from yaml.scanner import ScannerError

from easi_jax.errors import UserError, nearest
from easi_jax.io.files import os_reason, regular_file

_MOST = 1_000_000  # values in a file, what aliases repeat counted each time
_DEEPEST = 100


class _Loader(yaml.SafeLoader):
    def fetch_tag(self) -> None:
        # the standard ones too: their constructors raise anything on a wrong value
        raise ScannerError(None, None, "tags (!...) are not allowed", self.get_mark())

    def fetch_more_tokens(self) -> None:
        # before the scanner, whose time goes with the square of the depth
        if self.flow_level + len(self.indents) > _DEEPEST:
            raise ScannerError(None, None, "nested too deeply", self.get_mark())
        super().fetch_more_tokens()

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConstructorError(
                    None, None, "a key is no plain value", key.start_mark
                )
            text = str(key.value)
            if text in seen:
                raise ConstructorError(
                    None, None, f'key "{text}" is there twice', key.start_mark
                )
            seen.add(text)
        return super().construct_mapping(node, deep)


def number_of(value: Any) -> float:
    """What was read as a number; NaN where it is none. YAML 1.1 takes 1e-3 for text."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf
    except (TypeError, ValueError):
        return math.nan


def read_yaml(path: Path) -> Any:
    """The content of a YAML file.

    Raises:
        UserError: it cannot be read, is not UTF-8 or not YAML, has a tag or a key
            twice, or its aliases repeat too much; names file and line.
    """
    try:
        regular_file(path)
        # _Loader derives from SafeLoader: plain data only
        loader = _Loader(path.read_text(encoding="utf-8"))
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _count(node, {})
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({os_reason(error)})") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = " ".join(str(getattr(error, "problem", None) or "").split())
        where = f" in line {mark.line + 1}" if mark else ""
        raise UserError(
            f"{path}: not valid YAML{where}{f' ({problem})' if problem else ''}"
        ) from None


def check_keys(where: object, keys: Iterable[object], known: Sequence[str]) -> None:
    """Refuses what is not among the known keys.

    Raises:
        UserError: ``where``, the first unknown key, and the nearest known one.
    """
    for key in keys:
        if key not in known:
            raise UserError(
                f'{where}: unknown key "{key}"{nearest(str(key), known)} '
                f"(known: {', '.join(known)})"
            )


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Values below ``node`` as it would be written without aliases.

    Raises:
        ComposerError: more than can be meant, or an alias inside of its own anchor.
    """
    if id(node) in known:
        count = known[id(node)]
    else:
        known[id(node)] = _MOST + 1  # while it is counted
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        count = 1
        for part in parts:
            for child in part if isinstance(part, tuple) else (part,):
                count += _count(child, known)
        known[id(node)] = count
    if count > _MOST:
        raise ComposerError(None, None, "its aliases repeat too much", node.start_mark)
    return count

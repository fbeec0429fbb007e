"""Plain data from YAML, strictly: no tags, no key twice."""

from pathlib import Path
from typing import Any

import yaml

from easi_jax.errors import UserError
from easi_jax.io.files import os_reason


class _Loader(yaml.SafeLoader):
    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            text = str(key.value)
            if text in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f'key "{text}" is there twice', key.start_mark
                )
            seen.add(text)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """The content of a YAML file.

    Raises:
        UserError: it cannot be read, is not UTF-8 or not YAML, or has a key twice;
            names file and line.
    """
    try:
        # _Loader derives from SafeLoader: plain data only
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
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

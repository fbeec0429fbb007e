"""What a long analysis has worked out so far, so that it can go on after a stop.

An analysis is the same computation every time. So the results of its long steps are
kept in order, each in a file, and one that goes on reads them back in that order in
place of working them out; what lies between is quick and done again.
"""

import hashlib
import io
import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from easi_jax.errors import UserError
from easi_jax.io.files import atomic_write

Arrays = Mapping[str, np.ndarray]
_KEY = "key"


class Journal:
    """Results in order, in a folder; without a folder it keeps nothing.

    Args:
        folder: its own, made where it is missing.
        key: of all that the results depend on.

    Raises:
        UserError: the folder holds results of something else.
    """

    def __init__(self, folder: Path | None = None, key: str = "") -> None:
        self._folder, self._key = folder, key
        self._count = 0
        found = self._read(0)
        if found is not None and found[_KEY].item() != key:
            raise UserError(
                f"{folder} is of another model, other logs or other versions than "
                "these: --overwrite starts anew"
            )

    @property
    def kept(self) -> int:
        """Results that can be read back."""
        if self._folder is None:
            return 0
        return sum(1 for _ in self._folder.glob("*.npz"))

    def remember(self, make: Callable[[], Arrays]) -> Arrays:
        """The next result: read back where it is there, else made and kept."""
        found = self._read(self._count)
        if found is None or found[_KEY].item() != self._key:
            found = make()
            self._write(found)
        self._count += 1
        # Sums depend on how numbers lie in memory, which a file does not keep.
        return {k: np.asarray(v, order="C") for k, v in found.items()}

    def clear(self) -> None:
        """Forgets everything: the analysis is finished."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, n: int) -> Path:
        assert self._folder is not None
        return self._folder / f"step_{n:06d}.npz"

    def _read(self, n: int) -> Arrays | None:
        """None where there is none that is whole: then this step is made again."""
        if self._folder is None or not self._path(n).is_file():
            return None
        try:
            raw = io.BytesIO(self._path(n).read_bytes())
            with np.load(raw, allow_pickle=False) as file:
                found = {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None
        return found if _KEY in found else None

    def _write(self, arrays: Arrays) -> None:
        if self._folder is None:
            return
        raw = io.BytesIO()
        np.savez(raw, allow_pickle=False, **{**arrays, _KEY: np.array(self._key)})
        atomic_write(self._path(self._count), raw.getvalue())


def key_of(*parts: object) -> str:
    """A digest of arrays, and of what prints as text."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            head, raw = f"{part.dtype}{part.shape}", part.tobytes()
        else:
            head, raw = "text", repr(part).encode()
        digest.update(f"{head} {len(raw)} ".encode() + raw)
    return digest.hexdigest()[:32]

"""Tables of named columns from CSV, NPZ and Parquet files, and back."""

import contextlib
import csv
import io
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from easi_jax.errors import UserError
from easi_jax.io.files import atomic_write, os_reason, regular_file
from easi_jax.io.logs.cure import cure

_SEPARATOR = re.compile(r"\Asep=.\r?\n", re.IGNORECASE)

# The cells of a CSV, a 1-D array, or why the column cannot be used.
Cells = list[str] | np.ndarray | str
EXTENSIONS = (".csv", ".npz", ".parquet")
_LARGEST = 4_000_000_000  # bytes


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of one file, converted when asked for.

    Attributes:
        path: the file.
        columns: by name.
        notes: what looked odd.
        decimal: decimal sign of cells.
    """

    path: Path
    columns: Mapping[str, Cells]
    notes: tuple[str, ...] = ()
    decimal: str = "."

    def rows(self, name: str) -> int:
        """Number of rows of column ``name``."""
        return len(self._column(name))

    def numbers(self, name: str) -> np.ndarray:
        """Column ``name`` as float64, ``(rows,)``; an empty cell is NaN.

        Raises:
            UserError: the column holds text or has no plain rows.
        """
        column = self._column(name)
        if isinstance(column, np.ndarray) and column.dtype.kind in "biuf":
            return column.astype(np.float64)
        values = np.empty(len(column))
        for i, cell in enumerate(column):
            try:
                plain = cell.replace(self.decimal, ".")
                values[i] = float(plain) if cell.strip() else np.nan
            except ValueError:
                hint = ""
                if _is_number(cell.replace(",", ".")):
                    line = cure('decimal: ","')
                    hint = f"; {line} reads decimal commas"
                text = " ".join(cell.split())[:40]
                raise UserError(
                    f'{self.path}: row {i + 1}, column "{name}" holds "{text}" '
                    f"instead of a number{hint}"
                ) from None
        return values

    def counts_rows(self, name: str) -> bool:
        """Whether column ``name`` counts its rows by ones, as an index does."""
        try:
            values = self.numbers(name)
        except UserError:
            return False
        return len(values) > 2 and bool(np.all(np.diff(values) == 1))

    def labels(self, name: str) -> np.ndarray:
        """Column ``name`` as text, ``(rows,)``; whole numbers without a point."""
        column = self._column(name)
        if isinstance(column, np.ndarray) and column.dtype.kind == "f":
            texts = [f"{x:.17g}" for x in column.tolist()]
        else:
            texts = [str(cell).strip() for cell in column]
        missing = [i + 1 for i, text in enumerate(texts) if text in ("", "nan")]
        if missing:
            raise UserError(
                f'{self.path}: row {missing[0]} has no value in column "{name}"'
            )
        return np.array(texts)

    def _column(self, name: str) -> list[str] | np.ndarray:
        column = self.columns[name]
        if isinstance(column, str):
            raise UserError(
                f'{self.path}: column "{name}" holds {column}; '
                "a log has one number per row and column"
            )
        return column


def read_table(path: str | os.PathLike[str]) -> Table:
    """Reads a CSV, NPZ or Parquet file, told apart by the extension.

    Nothing is ever unpickled.

    Raises:
        UserError: no such file, another extension, empty, unreadable, cut short,
            not UTF-8, or two columns of one name.
    """
    path = Path(path)
    extension = path.suffix.lower()
    if os.path.isdir(path):  # Path.is_dir raises where a folder may not be entered
        raise UserError(f"{path} is a folder; give the log files in it")
    if extension not in EXTENSIONS:
        raise UserError(f"{path}: a log ends in {', '.join(EXTENSIONS)}")
    try:
        regular_file(path)
        if path.stat().st_size == 0:
            raise UserError(f"{path} is empty")
        if extension == ".csv":
            return Table(path, *_read_csv(path))
        if extension == ".npz":
            return Table(path, _read_npz(path))
        return Table(path, _read_parquet(path))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({os_reason(error)})") from None


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    digits: int | None = None,
) -> None:
    """Writes 1-D columns of one length; the file appears whole or not at all.

    Args:
        path: ends in ``.csv``, ``.npz`` or ``.parquet``.
        columns: by name, numbers or text.
        digits: significant digits of a CSV; None for all that round-trip.

    Raises:
        UserError: another extension, or a place that cannot be written.
    """
    path = Path(path)
    extension = path.suffix.lower()
    if extension not in EXTENSIONS:
        raise UserError(f"{path}: a log ends in {', '.join(EXTENSIONS)}")
    if extension == ".csv":
        atomic_write(path, _csv_text(columns, digits))
        return
    buffer = io.BytesIO()
    if extension == ".npz":
        # entry by entry, since savez refuses a column named "file"
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in columns.items():
                with archive.open(f"{name}.npy", "w") as entry:
                    np.lib.format.write_array(entry, array, allow_pickle=False)
    else:
        pyarrow.parquet.write_table(pyarrow.table(dict(columns)), buffer)
    atomic_write(path, buffer.getvalue())


def _csv_text(columns: Mapping[str, np.ndarray], digits: int | None) -> str:
    def cells(column: np.ndarray) -> list[str]:
        if column.dtype.kind != "f" or digits is None:
            return [str(x) for x in column.tolist()]
        return [f"{x:.{digits}g}" for x in column.tolist()]

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(cells(c) for c in columns.values()), strict=True))
    return text.getvalue()


def _read_csv(path: Path) -> tuple[dict[str, list[str]], tuple[str, ...]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            text = _without_comments(file.read())
        lines = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text))
        rows = [row for row in lines if row]
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text; save it as UTF-8 CSV") from None
    except csv.Error as error:
        raise UserError(f"{path}: not a CSV file ({error})") from None
    if not rows:
        raise UserError(f"{path} is empty")
    header = [name.strip() for name in rows.pop(0)]
    if all(_is_number(name) for name in header):
        raise UserError(f"{path}: the first row must name the columns")
    if _has_index(header, rows):
        header = ["", *header]
    # such as an index, or what follows a separator at the end of each line
    header = [name or f"unnamed column {i + 1}" for i, name in enumerate(header)]
    _refuse_duplicates(path, header)
    for i, row in enumerate(rows):
        if len(row) != len(header):
            cut = "; is the file cut short?" if i + 1 == len(rows) else ""
            if len(row) >= 2 * len(header):
                cut = '; with decimal commas, separate columns by ";"'
            raise UserError(
                f"{path}: row {i + 1} has {len(row)} cells "
                f"where the header has {len(header)}{cut}"
            )
    columns = {name: [row[i] for row in rows] for i, name in enumerate(header)}
    if rows and not text.endswith(("\n", "\r")):
        return columns, (
            "the last line has no line end; if the file was cut short, "
            "its last number is wrong",
        )
    return columns, ()


def _read_npz(path: Path) -> dict[str, list[str] | np.ndarray | str]:
    broken = UserError(f"{path}: not an NPZ file, damaged or cut short")
    try:
        # opened here, since numpy leaves a file that it cannot read open
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise broken
            _refuse_duplicates(path, archive.files)
            with zipfile.ZipFile(path) as unread:
                _refuse_bomb(path, sum(x.file_size for x in unread.infolist()))
            return {name: _npz_column(archive, name) for name in archive.files}
    except (UserError, OSError):
        raise
    # zipfile, its codecs and numpy's header raise whatever the bytes lead them to.
    except Exception:
        raise broken from None


def _npz_column(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray | str:
    try:
        array = archive[name]
    except ValueError as error:
        if "allow_pickle" in str(error):
            return "pickled objects"
        raise
    if not isinstance(array, np.ndarray):
        return "something that is no array"
    if array.ndim != 1:
        return f"a {array.ndim}-dimensional array"
    if array.dtype.kind == "S":
        with contextlib.suppress(UnicodeDecodeError):
            return np.char.decode(array, "utf-8")
    if array.dtype.kind not in "biufU":
        return f"values of type {array.dtype}"
    return array


def _read_parquet(path: Path) -> dict[str, list[str] | np.ndarray | str]:
    with parquet_file(path) as file:
        _refuse_duplicates(path, file.schema_arrow.names)
        cells = file.metadata.num_rows * file.metadata.num_columns
        _refuse_bomb(path, 8 * cells)
        table = file.read()
        return {
            name: _parquet_column(column)
            for name, column in zip(table.column_names, table.columns, strict=True)
        }


@contextlib.contextmanager
def parquet_file(path: Path) -> Iterator[pyarrow.parquet.ParquetFile]:
    """An opened file.

    Raises:
        UserError: no Parquet, or what is read of it is damaged.
    """
    broken = UserError(f"{path}: not a Parquet file, damaged or cut short")
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            yield file
    except OSError as error:
        if error.errno:
            raise
        raise broken from None
    except (pyarrow.ArrowException, ValueError, MemoryError):
        raise broken from None


def _parquet_column(column: pyarrow.ChunkedArray) -> np.ndarray | str:
    kind = column.type
    types = pyarrow.types
    if types.is_dictionary(kind):
        kind = kind.value_type
        column = column.cast(kind)
    if types.is_binary(kind) or types.is_large_binary(kind):
        with contextlib.suppress(pyarrow.ArrowInvalid):  # no text
            column = column.cast(pyarrow.string())
            kind = column.type
    texts = types.is_string, types.is_large_string, types.is_string_view
    if any(is_text(kind) for is_text in texts):
        return np.array([text or "" for text in column.to_pylist()], dtype=np.str_)
    if types.is_integer(kind) and not column.null_count:
        return column.to_numpy()  # as labels of runs they have no room in a float
    if types.is_boolean(kind) or types.is_null(kind):
        column = column.cast(pyarrow.int8())
    elif not any(
        of(kind) for of in (types.is_integer, types.is_floating, types.is_decimal)
    ):
        return f"values of type {kind}"
    return column.cast(pyarrow.float64(), safe=False).to_numpy()


def _without_comments(text: str) -> str:
    """``text`` from its header on: lines that begin with ``#`` may come before it, and
    the line by which a spreadsheet names its separator (``sep=;``). The last comment is
    the header where as many numbers follow, as NumPy writes it."""
    last, rest = "", _SEPARATOR.sub("", text, count=1)
    while rest.startswith("#"):
        last, _, rest = rest.partition("\n")
    named = last.lstrip("#").strip()
    delimiter = _delimiter(named)
    first = rest.partition("\n")[0].split(delimiter)
    alike = len(first) == len(named.split(delimiter))
    if alike and all(map(_is_number, first)):
        return f"{named}\n{rest}"
    return rest


def _delimiter(text: str) -> str:
    header = text.partition("\n")[0]
    if "," not in header:
        for other in (";", "\t"):
            if other in header:
                return other
    return ","


def _has_index(header: list[str], rows: list[list[str]]) -> bool:
    """Whether each row begins with its number, for which the header has no cell."""
    if len(rows) < 2 or any(len(row) != len(header) + 1 for row in rows):
        return False
    first = [row[0] for row in rows]
    if not all(_is_number(cell) for cell in first):
        return False
    return bool(np.all(np.diff([float(cell) for cell in first]) == 1))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _refuse_bomb(path: Path, size: int) -> None:
    """Refuses compressed files that would fill the memory; ``size`` in bytes."""
    if size > _LARGEST:
        raise UserError(
            f"{path}: {size / 1e9:.3g} GB when unpacked, more than a log has "
            f"({_LARGEST / 1e9:.3g} GB); split it"
        )


def _refuse_duplicates(path: Path, names: list[str]) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UserError(f'{path}: column "{twice[0]}" is there more than once')

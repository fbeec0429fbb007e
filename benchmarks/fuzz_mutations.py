"""Hostile input: mutations of good files, and odd things in a file's place."""

import dataclasses
import io
import os
import random
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Files = dict[str, bytes]  # content by path, relative to the case's folder

_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_HUGE = (
    *(b"1e308", b"-1e308", b"1e400", b"9" * 400, b"9" * 5000, b"0x" + b"f" * 400),
    *(b"nan", b"NaN", b".nan", b"inf", b"-Infinity", b".inf", b"1e-320", b"-0", b"0"),
    *(b"-1", b"4294967296", b"18446744073709551616", b"99999999", b"1_0", b"0b", b""),
)
_TEXTS = (
    *(b"", b"null", b"true", b"[]", b"{}", b'""', b"[[]]", b"{a: {b: c}}", b"\x00"),
    *("\N{SUPERSCRIPT TWO}".encode(), "\N{FULLWIDTH DIGIT ONE}".encode(), b"\xff\xfe"),
    *(b'"\\ud800"', b"<script>alert(1)</script>", b"\x1b[31m", b"../../../etc/passwd"),
    *(b"/etc/passwd", b"%s%n", b"{0}", b"$(touch x)", b"*", b"?*[", b"a" * 200_000),
)
_YAML = (
    b"!!python/object/apply:os.system ['touch CANARY']",
    b"!!python/object/new:os.system [touch CANARY]",
    b"!!python/name:os.system",
    *(
        b"!!int ''",
        b"!!bool x",
        b"!!timestamp x",
        b"!!float x",
        b"!!set {a}",
        b"!!map x",
    ),
    *(b"!!binary x", b"!!omap 3", b"!!pairs 3", b"!local 3", b"<<: 3", b"=", b"0x_"),
    *(b"[" * 5000, b"{a: " * 5000, b"- " * 5000, b"&a [*a]", b"&a {b: *a}", b"*none"),
    b"{? [a] : b}",
    b"2001-99-99",
    b"1:9" + b":9" * 3000,
)
_JSON = (
    *(b"[" * 50_000, b'{"a":' * 50_000, b"NaN", b"Infinity", b"1e999", b'"\\ud800"'),
    *(b"[]", b"3", b'"text"', b"null", b"true", b"9" * 400, b"9" * 5000, b"[[]]"),
)


def bomb() -> bytes:
    """YAML of 20 lines whose aliases stand for 9**20 values."""
    lines = [b"b0: &b0 [x, x, x, x, x, x, x, x, x]"]
    for i in range(1, 20):
        many = b", ".join([b"*b%d" % (i - 1)] * 9)
        lines.append(b"b%d: &b%d [%s]" % (i, i, many))
    return b"\n".join(lines)


class Evil:
    """Unpickled, it makes the file ``canary``."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, int]]:
        return os.mkdir, (str(self.canary), 0o700)


def mutated(rng: random.Random, raw: bytes) -> bytes:
    """``raw`` with one to four changes."""
    for _ in range(rng.randint(1, 4)):
        raw = rng.choice(_CHANGES)(rng, raw)
    return raw


def _flip(rng: random.Random, raw: bytes) -> bytes:
    out = bytearray(raw)
    for _ in range(rng.choice((1, 1, 2, 8))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(rng: random.Random, raw: bytes) -> bytes:
    return raw[: rng.randint(0, len(raw))]


def _lose(rng: random.Random, raw: bytes) -> bytes:
    a, b = sorted(rng.randint(0, len(raw)) for _ in range(2))
    return raw[:a] + raw[b:]


def _repeat(rng: random.Random, raw: bytes) -> bytes:
    a, b = sorted(rng.randint(0, len(raw)) for _ in range(2))
    return raw[:b] + raw[a:b] * rng.choice((1, 1, 3)) + raw[b:]


def _lines(rng: random.Random, raw: bytes) -> bytes:
    lines = raw.split(b"\n")
    way = rng.randrange(4)
    if way == 0:
        rng.shuffle(lines)
    elif way == 1:
        lines.insert(rng.randint(0, len(lines)), rng.choice(lines))
    elif way == 2:
        del lines[rng.randrange(len(lines))]
    else:
        lines = [rng.choice(lines) for _ in lines]
    return b"\n".join(lines)


def _number(rng: random.Random, raw: bytes) -> bytes:
    found = list(_NUMBER.finditer(raw))
    if not found:
        return raw
    match = rng.choice(found)
    return raw[: match.start()] + rng.choice(_HUGE) + raw[match.end() :]


def _word(rng: random.Random, raw: bytes) -> bytes:
    """A value, a name or a cell becomes something else."""
    found = list(re.finditer(rb"[^\s,:\[\]{}\"'<>=/]+", raw))
    if not found:
        return raw
    match = rng.choice(found)
    other = rng.choice((*_TEXTS, *_HUGE, *_YAML, *_JSON, rng.choice(found)[0]))
    return raw[: match.start()] + other + raw[match.end() :]


def _insert(rng: random.Random, raw: bytes) -> bytes:
    at = rng.randint(0, len(raw))
    what = rng.choice(
        (*_TEXTS, *_HUGE, *_YAML, *_JSON, b"\n" + bomb() + b"\nx: *b19\n")
    )
    return raw[:at] + what + raw[at:]


def _encode(rng: random.Random, raw: bytes) -> bytes:
    text = raw.decode("utf-8", "replace") + rng.choice(("", "µ°é", "\ufeff"))
    kind = rng.choice(("utf-16", "utf-32", "latin-1", "cp1252", "utf-8-sig", "utf-7"))
    return text.encode(kind, "replace")


def _bom(rng: random.Random, raw: bytes) -> bytes:
    return rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff")) * 2 + raw


def _columns(rng: random.Random, raw: bytes) -> bytes:
    """Cells of one column emptied, doubled or lost; commas as decimal points."""
    rows = [line.split(b",") for line in raw.split(b"\n")]
    i, way = rng.randrange(max(map(len, rows))), rng.randrange(4)
    for row in rows:
        if i < len(row):
            row[i : i + 1] = ([b""], [row[i]] * 2, [], [row[i].replace(b".", b",")])[
                way
            ]
    return b"\n".join(b",".join(row) for row in rows)


def _constant(rng: random.Random, raw: bytes) -> bytes:
    what = (b"", b"\x00" * 100, raw * 30, bomb(), b"\n" * 1000, *_YAML, *_JSON)
    return rng.choice(what)


_CHANGES = (
    *(_flip, _flip, _cut, _lose, _repeat, _lines, _lines, _number, _number, _number),
    *(_word, _word, _word, _insert, _insert, _encode, _bom, _columns, _constant),
)


@dataclasses.dataclass(frozen=True)
class Case:
    """What lies in a folder.

    Attributes:
        files: contents.
        odd: what stands in a file's place: ``folder``, ``pipe``, ``loop`` (a link to
            itself), ``outside`` (a link out of the folder), ``device``, ``none``.
    """

    files: Files
    odd: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def write(self, folder: Path, outside: Path) -> None:
        """Puts it into ``folder``."""
        for name, raw in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            kind = self.odd.get(name, "")
            if kind == "folder":
                path.mkdir()
            elif kind == "pipe":
                os.mkfifo(path)
            elif kind == "loop":
                path.symlink_to(path.name)
            elif kind == "outside":
                path.symlink_to(outside)
            elif kind == "device":
                path.symlink_to("/dev/zero")
            elif kind != "none":
                path.write_bytes(raw)


ODD = ("folder", "pipe", "loop", "outside", "device", "none")


def mutation(rng: random.Random, files: Files) -> Case:
    """A case from good files: one of them changed, now and then one is no file."""
    name = rng.choice(sorted(files))
    if rng.random() < 0.03:
        return Case(files, {name: rng.choice(ODD)})
    raw = files[name]
    if name.endswith(".npz") and rng.random() < 0.7:
        raw = _npz(rng, raw)
    if not name.endswith(".npz") or rng.random() < 0.3:
        raw = mutated(rng, raw)
    return Case({**files, name: raw})


def _npz(rng: random.Random, raw: bytes) -> bytes:
    """An archive that is whole, with one entry that is not what it should be."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(entries))
    entry = entries[name]
    way = rng.randrange(5)
    if way == 0:
        entry = mutated(rng, entry)
    elif way == 1:  # another header
        text = rng.choice(_HEADERS).encode().ljust(117) + b"\n"
        entry = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + entry[128:]
    elif way == 2:
        name = rng.choice(("../../evil.npy", "/evil.npy", "x", "run.npy", "\x01.npy"))
    elif way == 3:
        shape = rng.choice(((3, 4), (), (0,), (1,), (100_000,)))
        kind = rng.choice((np.float16, np.complex128, np.bool_, "U7", "S3", "M8[s]"))
        out = io.BytesIO()
        np.lib.format.write_array(out, np.zeros(shape, kind), allow_pickle=False)
        entry = out.getvalue()
    else:
        entry = entry[: rng.randint(0, len(entry))]
    entries[name] = entry
    out = io.BytesIO()
    kind = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(out, "w", kind) as archive:
        for key, content in entries.items():
            archive.writestr(key, content)
    return out.getvalue()


_HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999999999999,)}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (40,)}",
    "{'descr': [], 'fortran_order': False, 'shape': (40,)}",
    "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (40,)}",
    "{'descr': None, 'fortran_order': False, 'shape': (40,)}",
    "{'descr': '<f8', 'fortran_order': 3, 'shape': 'x'}",
    "{'descr': ((((", "[[[[[[[[", "{{}: 1}", "__import__('os')", "'a' 'b", "\x00", "1L",
)  # fmt: skip

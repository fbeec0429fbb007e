"""The readers that ``benchmarks.fuzz`` feeds, with good files to start from."""

import dataclasses
import functools
import io
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz_mutations import Case, Evil, Files, bomb

ARM = Path(__file__).parents[1] / "examples" / "lift_arm"
SECRET = "secret_of_another_folder"

CART = """<mujoco model="cart"><option timestep="0.01"/><worldbody>
<body name="cart"><joint name="slider" type="slide" range="-1 1" damping="0.1"/>
<geom name="box" size=".1"/><body name="pole"><joint name="hinge" type="hinge"/>
<geom size=".1" pos="0 0 .3"/></body></body></worldbody><actuator>
<motor name="drive" joint="slider" ctrlrange="-5 5"/></actuator></mujoco>"""
PARTS = """<mujoco model="parts"><compiler meshdir="meshes" strippath="false"/>
<include file="part.xml"/><asset><mesh name="m" file="tetra.stl"/></asset>
<worldbody><body name="b"><joint name="j"/><geom type="mesh" mesh="m"/></body>
</worldbody></mujoco>"""
PART = """<mujocoinclude><worldbody><body name="c"><joint name="k" range="-1 1"/>
<geom size=".1" pos="0 0 2"/></body></worldbody></mujocoinclude>"""
# What hides a way out of the folder; ROUND stands for the folder beside it.
_PATHS = (
    *("ROUND/x.xml", "../outside/x.xml", "meshes/../../outside/x.xml", "link/x.xml"),
    *("link.xml", "/etc/passwd", "/dev/zero", "..\\outside\\x.xml"),
    "&#46;./outside/x.xml",
    *("package://ROUND/t.stl", "ROUND/t.stl", "../../outside/t.stl", "", ".", "/", "~"),
    *("model.xml", "part.xml", "tetra.stl", "file://ROUND/x.xml", "a" * 5000),
)  # fmt: skip
_PLACES = (
    '<include file="{}"/>',
    '<asset><mesh name="n" file="{}"/></asset>',
    '<asset><texture name="n" type="2d" file="{}"/></asset>',
    '<asset><texture name="n" type="cube" fileup="{}"/></asset>',
    '<asset><hfield name="n" size="1 1 1 1" file="{}"/></asset>',
    '<asset><model name="n" file="{}"/></asset>',
    '<compiler meshdir="{}"/><asset><mesh name="n" file="t.stl"/></asset>',
    '<compiler assetdir="{}"/><asset><mesh name="n" file="../t.stl"/></asset>',
    "<!-- {} --><include file='{}' />",
    '<option a=">"/><include file="{}"/>',
)


@dataclasses.dataclass(frozen=True)
class Reader:
    """One reader of files.

    Attributes:
        name: of the kind of file.
        share: of all cases.
        good: makes files that it accepts.
        read: reads a case's folder; raises UserError for what it refuses.
        drawn: makes a hypothesis strategy of cases; a canary's path is given.
        special: cases that are always run; the canary's path and the folder outside
            are given.
        writes: names in the case's folder that it may write.
        prepare: is called with a case's folder before it is read.
    """

    name: str
    share: float
    good: Callable[[], list[Files]]
    read: Callable[[Path], object]
    drawn: Callable[[], Any] | None = None
    special: Callable[[Path, Path], list[Case]] | None = None
    writes: tuple[str, ...] = ()
    prepare: Callable[[Path], None] | None = None


@functools.cache
def _cart() -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string(CART)


@functools.cache
def _columns() -> dict[str, np.ndarray]:
    time = 0.01 * np.arange(40)
    return {
        "time": time,
        "run": np.repeat([1.0, 2.0], 20),
        "qpos.slider": 0.3 * np.sin(3 * time),
        "qpos.hinge": 0.5 * np.cos(2 * time),
        "qvel.slider": 0.9 * np.cos(3 * time),
        "ctrl.drive": np.arange(40) / 10.0,
        "temperature": np.full(40, 21.5),
    }


def _table(extension: str, columns: dict[str, Any] | None = None) -> bytes:
    from easi_jax.io.logs.tables import write_table

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{extension}"
        write_table(path, columns or _columns(), digits=6)
        return path.read_bytes()


def _logs(extension: str) -> Callable[[], list[Files]]:
    def good() -> list[Files]:
        few = {k: v for k, v in _columns().items() if k not in ("run", "qvel.slider")}
        return [
            {f"log{extension}": raw}
            for raw in (_table(extension), _table(extension, few))
        ]

    return good


def _read_log(extension: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        from easi_jax.io.logs.reader import read_logs

        return read_logs(folder / f"log{extension}", _cart())

    return read


def _arm_logs() -> list[Files]:
    """The example's log, its first second and all."""
    lines = (ARM / "moves.csv").read_bytes().splitlines(keepends=True)
    return [{"log.csv": b"".join(part)} for part in (lines[:60], lines)]


@functools.cache
def _arm() -> Any:
    from easi_jax.io.models.mjcf import read_mjcf

    return read_mjcf(ARM / "model.xml")


def _read_arm_log(folder: Path) -> object:
    from easi_jax.io.logs.reader import read_logs

    return read_logs(folder / "log.csv", _arm())


def _arm_parameters() -> list[Files]:
    return [{"p.yaml": (ARM / "parameters.yaml").read_bytes()}]


def _read_arm_parameters(folder: Path) -> object:
    from easi_jax.io.models.parameter_file import read_parameter_file

    return read_parameter_file(folder / "p.yaml", _arm())


def _evil_npz(canary: Path, outside: Path) -> list[Case]:
    out = []
    for name in ("time", "qpos.slider", "temperature", "run"):
        columns: dict[str, Any] = dict(_columns())
        columns[name] = np.array([Evil(canary)] * 40, object)
        raw = io.BytesIO()
        np.savez(raw, **columns)
        out.append(Case({"log.npz": raw.getvalue()}))
    import pickle

    raw = io.BytesIO()
    np.save(raw, np.array([Evil(canary)], object), allow_pickle=True)
    out += [Case({"log.npz": raw.getvalue()})]
    out += [Case({"log.npz": pickle.dumps(Evil(canary), p)}) for p in (0, 2, 4)]
    return out


def _evil_parquet(canary: Path, outside: Path) -> list[Case]:
    import pickle

    import pyarrow
    import pyarrow.parquet

    evil = pickle.dumps(Evil(canary))
    kinds = [
        (pyarrow.binary(), [evil] * 3),
        (pyarrow.decimal128(9, 2), [None, None, None]),
        (pyarrow.timestamp("ns"), [1, 2, 3]),
        (pyarrow.list_(pyarrow.float64()), [[1.0], [], None]),
        (pyarrow.struct([("a", pyarrow.int8())]), [{"a": 1}, None, {"a": 2}]),
        (pyarrow.dictionary(pyarrow.int8(), pyarrow.string()), ["a", "b", None]),
        (pyarrow.large_string(), ["1", "nan", None]),
        (pyarrow.uint64(), [2**64 - 1, 0, None]),
        (pyarrow.float16(), [np.float16(1), None, np.float16(2)]),
        (pyarrow.map_(pyarrow.string(), pyarrow.int8()), [[("a", 1)], [], None]),
        (pyarrow.bool_(), [True, False, None]),
        (pyarrow.null(), [None, None, None]),
    ]
    told = {
        b"ARROW:extension:name": b"arrow.py_extension_type",
        b"ARROW:extension:metadata": evil,
    }
    out = []
    for name in ("time", "qpos.slider", "run", "temperature"):
        for kind, values in kinds:
            for metadata in (None, told):
                columns = {k: pyarrow.array(v[:3]) for k, v in _columns().items()}
                columns[name] = pyarrow.array(values, kind)
                fields = [
                    pyarrow.field(k, v.type, metadata=metadata if k == name else None)
                    for k, v in columns.items()
                ]
                table = pyarrow.Table.from_arrays(
                    list(columns.values()), schema=pyarrow.schema(fields)
                )
                raw = io.BytesIO()
                pyarrow.parquet.write_table(table, raw)
                out.append(Case({"log.parquet": raw.getvalue()}))
    # text that is no UTF-8, under a text type
    bad = pyarrow.array([b"\xff\xfe", b"1", b"2"]).view(pyarrow.string())
    columns = {k: pyarrow.array(v[:3]) for k, v in _columns().items()}
    for name in ("time", "run"):
        raw = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.table({**columns, name: bad}), raw)
        out.append(Case({"log.parquet": raw.getvalue()}))
    return out


def _drawn_csv() -> Any:
    """Tables of any cells under names that mean something."""
    from hypothesis import strategies as st

    cell = st.one_of(
        st.floats(width=32).map(repr),
        st.integers(-5, 5).map(str),
        st.sampled_from(["", "nan", "1e999", "0x1", "1_0", '"', "1,5", "\x00", "-"]),
        st.text(max_size=4),
    )
    names = [*_columns(), "qpos.hinge.0", "ctrl.other", "sensor.x", "", "time "]
    head = st.lists(st.sampled_from(names), min_size=1, max_size=9)

    def rows(names: list[str]) -> Any:
        row = st.lists(cell, min_size=len(names) - 1, max_size=len(names) + 1)
        return st.lists(row, max_size=6).map(
            lambda body: "\n".join(",".join(r) for r in [names, *body])
        )

    end = st.sampled_from(["\n", "", "\r\n", "\r"])
    return st.builds(
        lambda t, e: Case({"log.csv": (t + e).encode("utf-8", "replace")}),
        head.flatmap(rows),
        end,
    )


def _plain(words: Sequence[str]) -> Any:
    """Plain data whose keys and texts are mostly ``words``."""
    from hypothesis import strategies as st

    word = st.one_of(st.sampled_from(list(words)), st.text(max_size=5))
    leaf = st.one_of(
        word, st.none(), st.booleans(), st.integers(), st.floats(), st.dates().map(str)
    )
    return st.recursive(
        leaf,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4), st.dictionaries(word, inner, max_size=6)
        ),
        max_leaves=20,
    )


def _drawn_yaml(name: str, words: Sequence[str], also: Files) -> Callable[[], Any]:
    def drawn() -> Any:
        import yaml
        from hypothesis import strategies as st

        section = st.dictionaries(
            st.sampled_from(list(words)), _plain(words), max_size=6
        )
        body = st.one_of(
            _plain(words),
            section,
            st.lists(section, max_size=3).map(lambda x: {words[0]: x}),
        )
        return body.map(
            lambda x: Case(
                {**also, name: yaml.safe_dump(x, allow_unicode=True).encode()}
            )
        )

    return drawn


def _evil_yaml(name: str, good: Callable[[], list[Files]]) -> Callable[..., list[Case]]:
    def special(canary: Path, outside: Path) -> list[Case]:
        call = f"!!python/object/apply:os.mkdir ['{canary}']"
        texts = [
            call,
            f"parameters: {call}",
            f"effects: [{call}]",
            f"columns: {{a: {call}}}",
            f"? {call}\n: 1",
            f"a: !!python/object/new:os.mkdir ['{canary}']",
            *(
                f"b0: &b0 [x]\n{bomb().decode().partition(chr(10))[2]}\n{key}: {use}"
                for key in ("parameters", "effects", "columns", "scale")
                for use in ("*b19", "[*b19]", "{name: *b19}", "[{name: *b19}]")
            ),
        ]
        files = good()[0]
        return [Case({**files, name: text.encode()}) for text in texts]

    return special


_CSV = "\n".join(["t,x,y,u", *(f"{i},{i % 7},{i % 5},{i % 3}" for i in range(30))])
_MAP = """columns: {t: time, x: qpos.slider, y: qpos.hinge, u: ctrl.drive}
scale: {time: 0.01, qpos.slider: 1e-3, y: 0.0174533}
offset: {u: -1.5}
"""


def _mappings() -> list[Files]:
    return [{"log.csv": _CSV.encode(), "map.yaml": _MAP.encode()}]


def _read_mapping(folder: Path) -> object:
    from easi_jax.io.logs.reader import read_logs

    return read_logs(folder / "log.csv", _cart(), folder / "map.yaml")


_PARAMETERS = """parameters:
  - {name: mass, address: body.cart.mass, nominal: 0.3, initial: [0.1, 0.9]}
  - name: damping
    address: [joint.slider.damping, "joint.sl*.damping"]
    bounds: [1e-3, .inf]
    scale: linear
    unit: N s/m
  - {name: gain, address: actuator.drive.gain, unit: 1}
"""
_EFFECTS = """model: cart.xml
effects:
- effect: coulomb_friction
  at: hinge
  kind: joint
  parameters: {torque: {value: 0.12, std: 0.004, unit: N m}}
  columns: {coulomb: 0.12}
  std: {coulomb: 0.004}
- {effect: actuator_delay, at: drive, kind: actuator, columns: {delay: 0.02}}
- {effect: gravity_tilt, at: "", kind: model, columns: {tilt.0: 0.01, tilt.1: 0.0}}
- {effect: com_offset, at: pole, kind: body, columns: {com.0: 0.01, com.2: 0.1}}
refitted:
- {address: joint.slider.damping, value: 0.11}
"""


def _read_parameters(folder: Path) -> object:
    from easi_jax.io.models.parameter_file import read_parameter_file

    return read_parameter_file(folder / "p.yaml", _cart())


def _read_effects(folder: Path) -> object:
    from easi_jax.io.models.effects_file import read_effects
    from easi_jax.model.found_effects import FoundEffects, joined, named
    from easi_jax.model.parameters import ParameterSpace

    entries, own = read_effects(folder / "effects.yaml")
    found = FoundEffects(tuple(entries), own)
    return named(entries), joined(_cart(), ParameterSpace(()), found)


_HEAD = {
    "format": 1,
    "command": "train.udr",
    "config": {
        **{"robot": "cartpole", "env_steps": 1000, "seeds": [0, 1], "env": None},
        **{"option": [], "algorithm": "sac", "effects": None, "target": ["mass*2"]},
    },
}
POLICIES_CONTENT = {
    **{"robot": "cartpole", "env": None, "methods": ["UDR", "EASI"], "seeds": [0, 1]},
    **{"env_steps": 1000, "algorithm": "sac", "returns": {"UDR": {"0": 1.5}}},
}
DISTRIBUTION_CONTENT = {
    "schema": 1,
    "parameters": [
        {
            **{"name": "mass", "addresses": ["body.cart.mass"], "unit": "kg"},
            **{"nominal": 0.3, "initial": [0.1, 0.9], "scale": "log"},
            "bounds": [0.001, "Infinity"],
        },
        {
            **{"name": "tilt", "addresses": ["joint.hinge.damping"], "unit": ""},
            **{"nominal": 0.0, "initial": [-1, 1.0], "scale": "linear"},
            "bounds": ["-Infinity", "Infinity"],
        },
    ],
    "best_seed": 1,
    "seeds": {
        str(s): {
            **{"mean": [0.3, 0.1], "unit_mean": [0.5, 0.55]},
            "unit_covariance": [[0.01, 0.0], [0.0, 0.02]],
        }
        for s in (0, 1)
    },
}
_GAP = {
    "schema": 1,
    "effects": [
        {
            **{"effect": "coulomb_friction", "at": "hinge", "kind": "joint"},
            "indistinguishable": ["viscous_damping@hinge"],
        }
    ],
}


def _json(content: Any) -> bytes:
    return json.dumps(content, indent=1).encode()


def _metrics() -> bytes:
    lines = [
        json.dumps({"stage": s, "step": i, "time": 0.1 * i, "loss": "NaN", "r": 1.5})
        for s in ("train", "search")
        for i in range(4)
    ]
    return ("\n".join(lines) + "\n").encode()


def _runs() -> list[Files]:
    return [
        {
            **{"config.json": _json(_HEAD), "results.json": _json(POLICIES_CONTENT)},
            "metrics.jsonl": _metrics(),
        }
    ]


def _read_run(folder: Path) -> object:
    from easi_jax.io.runs.folder import RunFolder, read_config
    from easi_jax.io.runs.metrics import read_metrics
    from easi_jax.io.runs.schemas import TRAINED, checked
    from train._robots import read_policies

    if not (folder / "versions.json").exists():  # else git is asked for the commit
        (folder / "versions.json").write_text("{}")
    config = checked(read_config(folder), TRAINED, "config")
    read_metrics(folder / "metrics.jsonl")
    with RunFolder.open(folder, config, command="train.udr", resume=True) as run:
        run.rewind("train", 2)
    return read_policies(folder / "results.json")


def _read_found(folder: Path) -> object:
    from easi_jax.export.randomization import read_randomization, to_yaml
    from easi_jax.io.runs.schemas import GAP, read_checked, read_distribution

    read_checked(folder / "gap.json", GAP, "a gap.json of train.gap")
    found = read_distribution(folder / "distribution.json")
    to_yaml(found, str(found.get("best_seed", next(iter(found["seeds"])))), "cart")
    return read_randomization(folder / "randomization.yaml")


def _founds() -> list[Files]:
    from easi_jax.export.randomization import to_yaml

    return [
        {
            **{
                "gap.json": _json(_GAP),
                "distribution.json": _json(DISTRIBUTION_CONTENT),
            },
            "randomization.yaml": to_yaml(
                _read_numbers(DISTRIBUTION_CONTENT), "1", "cart"
            ).encode(),
        }
    ]


def _read_numbers(content: Any) -> Any:
    from easi_jax.io.runs.schemas import DISTRIBUTION, checked

    return checked(content, DISTRIBUTION, "here")


def _drawn_json(names: Sequence[str], good: Callable[[], list[Files]]) -> Any:
    """Good files with any plain data in place of one value anywhere in one file."""

    def drawn() -> Any:
        from hypothesis import strategies as st

        files = good()[0]

        def put(name: str, at: float, new: Any) -> Case:
            content = json.loads(files[name])
            places = list(_places(content))
            holder, key = places[int(at * (len(places) - 1))]
            holder[key] = new
            return Case({**files, name: json.dumps(content).encode()})

        words = [
            *_HEAD,
            *POLICIES_CONTENT,
            *DISTRIBUTION_CONTENT,
            "mean",
            "0",
            "-1",
            "NaN",
        ]
        return st.builds(
            put, st.sampled_from(list(names)), st.floats(0, 1), _plain(words)
        )

    return drawn


def _places(content: Any) -> Any:
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


def _state() -> Any:
    import jax
    import jax.numpy as jnp

    return {
        "w": jnp.arange(6.0).reshape(3, 2),
        "step": jnp.int32(7),
        "key": jax.random.key(3),
        "none": jnp.zeros((0, 2)),
    }


@functools.cache
def _target() -> Any:
    import jax

    return jax.eval_shape(_state)


def _checkpoints() -> list[Files]:
    from easi_jax.io.runs import checkpoints

    folder = Path(tempfile.mkdtemp())
    try:
        checkpoints.save(folder, 7, _state(), config_hash="a")
        files = [p for p in folder.rglob("*") if p.is_file()]
        return [{str(p.relative_to(folder)): p.read_bytes() for p in files}]
    finally:
        shutil.rmtree(folder)


def _read_checkpoint(folder: Path) -> object:
    from easi_jax.errors import UserError
    from easi_jax.io.runs import checkpoints

    found = checkpoints.restore(folder, _target(), config_hash="a")
    if found is None:
        raise UserError("no checkpoint")
    return found


def _reseal_half(folder: Path) -> None:
    """Half of the cases get digests that fit, as an editor of the files would write."""
    (place,) = folder.glob("step_*")
    meta = place / "meta.json"
    plain = not any(p.is_symlink() or p.is_fifo() for p in place.rglob("*"))
    if plain and meta.is_file() and sum(map(len, _contents(place))) % 2:
        reseal(place)


def _contents(place: Path) -> Iterator[bytes]:
    return (p.read_bytes() for p in place.rglob("*") if p.is_file())


def reseal(place: Path) -> None:
    """Writes digests of the files as they are, where there is a description."""
    import hashlib

    meta = place / "meta.json"
    try:
        content = json.loads(meta.read_bytes())
        content["files"] = {
            p.relative_to(place / "state").as_posix(): hashlib.sha256(
                p.read_bytes()
            ).hexdigest()
            for p in sorted((place / "state").rglob("*"))
            if p.is_file()
        }
    except (ValueError, TypeError, RecursionError):
        return  # the description is what was changed
    meta.write_text(json.dumps(content))


def tetrahedron() -> bytes:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    out = bytes(80) + np.uint32(4).tobytes()
    for face in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]):
        out += bytes(12) + corners[face].tobytes() + bytes(2)
    return out


def _models() -> list[Files]:
    parts = {
        **{"model.xml": PARTS.encode(), "part.xml": PART.encode()},
        "meshes/tetra.stl": tetrahedron(),
    }
    return [{"model.xml": CART.encode()}, parts, parts]


def _read_model(folder: Path) -> object:
    from easi_jax.io.models.mjcf import read_mjcf

    m = read_mjcf(folder / "model.xml")
    if SECRET.encode() in m.names:
        raise AssertionError("a file outside of the model's folder was read")
    return m


def _evil_models(canary: Path, outside: Path) -> list[Case]:
    part = (
        f'<mujocoinclude><worldbody><body name="{SECRET}"/></worldbody></mujocoinclude>'
    )
    (outside / "x.xml").write_text(part)
    (outside / "t.stl").write_bytes(tetrahedron())
    (outside / f"{SECRET}.stl").write_bytes(tetrahedron())
    body = '<worldbody><body><joint name="a"/><geom size=".1"/></body></worldbody>'
    out = []
    for path in _PATHS:
        path = path.replace("ROUND", str(outside))
        for place in _PLACES:
            text = place.replace("{}", path)
            whole = f"<mujoco>{text}{body}</mujoco>".encode()
            through = f"<mujoco><include file='part.xml'/>{body}</mujoco>".encode()
            inner = f"<mujocoinclude>{text}</mujocoinclude>".encode()
            parts = {"link.xml": b"", "meshes/tetra.stl": tetrahedron()}
            odd = {"link.xml": "outside"}
            out.append(Case({"model.xml": whole, **parts}, odd))
            out.append(Case({"model.xml": through, "part.xml": inner, **parts}, odd))
    return out


def _drawn_report() -> Any:
    from hypothesis import strategies as st

    hostile = st.sampled_from(
        [
            *(
                "<script>alert(1)</script>",
                '"><img src=x onerror=alert(1)>',
                "$\\frac{",
            ),
            *("</svg><script>alert(1)</script>", "{{ 7*7 }}", "]]>", "<!--", "&lt;"),
            *("javascript:alert(1)", "' onload='alert(1)", "\ud800", "$$", "\x00"),
        ]
    )
    name = st.one_of(hostile, st.text(max_size=8))
    return st.lists(name, min_size=6, max_size=6).map(
        lambda names: Case({"names.json": json.dumps(names).encode()})
    )


def _read_report(folder: Path) -> object:
    from easi_jax.io.files import read_json
    from easi_jax.io.report.html import (
        Diagnostic,
        ParameterRow,
        Picture,
        Report,
        Table,
        write_report,
    )

    a, b, c, d, e, f = read_json(folder / "names.json")
    report = Report(
        title=a,
        headline=[b],
        command=c,
        parameters=[ParameterRow(d, (e,), f, (0.1, 1.0), 0.5, 0.1, "determined")],
        undetermined=[f],
        tables=[Table(b, (c, d), [(e, f), (a, 1.5)], a)],
        pictures=[Picture(a, "<svg><text/></svg>", b, c)],
        diagnostics=[Diagnostic(d, e, note=f)],
        notes=[a, b],
        config={c: d, e: [f, 1.0]},
        versions={a: b},
    )
    write_report(folder / "report.html", report)
    harmless((folder / "report.html").read_text(encoding="utf-8"))
    return report


def harmless(page: str) -> None:
    """Raises AssertionError where a page has what could run, or asks the network."""
    import html.parser

    class Reader(html.parser.HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[Any]) -> None:
            assert tag not in ("script", "img", "iframe", "object", "base", "a"), tag
            for name, value in attrs:
                assert not name.startswith("on"), name
                assert not (name in ("src", "href") and value[:1] != "#"), value

    Reader().feed(page)
    assert "<script" not in page.lower()


_WORDS = {
    "p.yaml": (
        *("parameters", "name", "address", "nominal", "initial", "bounds", "scale"),
        *("unit", "log", "linear", "body.cart.mass", "joint.*.damping", "mass"),
    ),
    "effects.yaml": (
        *("effects", "effect", "at", "kind", "columns", "parameters", "std", "model"),
        *("coulomb_friction", "hinge", "joint", "coulomb", "delay", "tilt.9", "com.x"),
        *("refitted", "address", "value", "actuator_delay", "drive", "actuator"),
    ),
    "map.yaml": ("columns", "scale", "offset", "time", "t", "x", "qpos.slider", "y"),
}

READERS = (
    Reader("CSV logs", 0.13, _logs(".csv"), _read_log(".csv"), _drawn_csv),
    Reader("CSV log of the example", 0.06, _arm_logs, _read_arm_log),
    Reader(
        "parameter file of the example", 0.03, _arm_parameters, _read_arm_parameters
    ),
    Reader(
        "NPZ logs", 0.11, _logs(".npz"), _read_log(".npz"), special=_evil_npz
    ),
    Reader(
        "Parquet logs", 0.11, _logs(".parquet"), _read_log(".parquet"),
        special=_evil_parquet,
    ),
    Reader(
        "mapping files", 0.1, _mappings, _read_mapping,
        _drawn_yaml("map.yaml", _WORDS["map.yaml"], {"log.csv": _CSV.encode()}),
        _evil_yaml("map.yaml", _mappings),
    ),
    Reader(
        "parameter files", 0.07, lambda: [{"p.yaml": _PARAMETERS.encode()}],
        _read_parameters, _drawn_yaml("p.yaml", _WORDS["p.yaml"], {}),
        _evil_yaml("p.yaml", lambda: [{}]),
    ),
    Reader(
        "effects files", 0.09, lambda: [{"effects.yaml": _EFFECTS.encode()}],
        _read_effects, _drawn_yaml("effects.yaml", _WORDS["effects.yaml"], {}),
        _evil_yaml("effects.yaml", lambda: [{}]),
    ),
    Reader(
        "run folders", 0.08, _runs, _read_run,
        _drawn_json(("config.json", "results.json"), _runs),
        writes=(".lock", "versions.json", "metrics.jsonl"),
    ),
    Reader(
        "results of searches", 0.08, _founds, _read_found,
        _drawn_json(("gap.json", "distribution.json"), _founds),
        _evil_yaml("randomization.yaml", _founds),
    ),
    Reader("checkpoints", 0.04, _checkpoints, _read_checkpoint, prepare=_reseal_half),
    Reader("models (MJCF)", 0.08, _models, _read_model, special=_evil_models),
    Reader(
        "names in reports", 0.02, lambda: [{"names.json": _json(["a"] * 6)}],
        _read_report, _drawn_report, writes=("report.html",),
    ),
)  # fmt: skip

import dataclasses
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.io.files import atomic_write, number, to_json
from easi_jax.io.report.html import Report, write_report
from easi_jax.io.report.video import write_video
from easi_jax.io.runs.folder import RunFolder, config_hash, has_changed, read_config
from easi_jax.io.runs.metrics import MetricsLog, read_metrics


@dataclasses.dataclass(frozen=True)
class Search:
    population: int = 8


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path
    seed: int = 0
    rate: float = 3e-4
    search: Search = dataclasses.field(default_factory=Search)
    resume: bool = False


def _contents(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file()
    }


@pytest.fixture
def run_at(tmp_path):
    def start(name="run", **kwargs):
        options = {
            k: kwargs.pop(k) for k in ("resume", "overwrite", "command") if k in kwargs
        }
        config = Config(out=tmp_path / name, **kwargs)
        return RunFolder.open(config.out, config, **options)

    return start


def test_new_run_writes_config_and_versions(run_at, tmp_path):
    with run_at(seed=3, command="train.easi") as run:
        assert not run.resumed
    assert read_config(run.path) == {
        "seed": 3,
        "rate": 3e-4,
        "search": {"population": 8},
    }
    text = (run.path / "versions.json").read_text()
    assert {"jax", "mujoco", "mujoco-mjx"} <= json.loads(text)["packages"].keys()
    assert str(Path.home()) not in text
    assert str(tmp_path) not in text


@pytest.mark.fault("two runs into one folder, a folder of something else")
def test_second_run_into_a_used_folder_is_refused_while_the_first_lives(run_at):
    with run_at() as run:
        code = (
            "from easi_jax.io.runs.folder import RunFolder\n"
            "from easi_jax.errors import UserError\n"
            "import sys\n"
            "try:\n"
            "    RunFolder.open(sys.argv[1], {}, overwrite=True)\n"
            "except UserError as error:\n"
            "    print(error)\n"
        )
        found = subprocess.run(
            [sys.executable, "-c", code, str(run.path)],
            capture_output=True,
            text=True,
            timeout=60,
            cwd=Path(__file__).parents[4],
            check=True,
        )
        assert "another run is writing" in found.stdout
        assert (run.path / "config.json").exists()
        with pytest.raises(UserError, match="another run is writing"):
            run_at(resume=True)
    with run_at(resume=True) as again:
        assert again.resumed


def test_existing_run_is_left_alone_without_a_word(run_at):
    with run_at() as run:
        run.write_json("distribution.json", {"mean": [1.0]})
    before = _contents(run.path)
    with pytest.raises(UserError, match="already holds a run: --resume"):
        run_at()
    with pytest.raises(UserError, match="exclude each other"):
        run_at(resume=True, overwrite=True)
    assert _contents(run.path) == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 1}, r"seed = 0, not 1: resume"),
        ({"search": Search(9)}, r"search\.population = 8, not 9: resume"),
        ({"seed": 1, "rate": 1.0}, r"seed = 0, not 1 \(and 1 more\)"),
        ({"command": "train.udr"}, r"a run of train\.easi, not of train\.udr"),
    ],
)
def test_resume_with_other_settings_names_the_difference(run_at, change, said):
    with run_at(command="train.easi") as run:
        pass
    before = _contents(run.path)
    with pytest.raises(UserError, match=said):
        run_at(resume=True, **{"command": "train.easi", **change})
    assert _contents(run.path) == before


def test_resume_of_nothing_starts_and_overwrite_clears(run_at):
    with run_at(resume=True) as run:
        assert not run.resumed
        run.write("figures/a.svg", "<svg/>")
        run.log("search", 1, {"loss": 1.0})
    with run_at(seed=5, overwrite=True) as run:
        assert not run.resumed
    assert read_config(run.path)["seed"] == 5
    assert set(_contents(run.path)) == {".lock", "config.json", "versions.json"}


def test_run_without_versions_is_completed_on_resume(run_at):
    with run_at() as run:
        pass
    (run.path / "versions.json").unlink()
    with run_at(resume=True):
        assert (run.path / "versions.json").exists()


@pytest.mark.fault("two runs into one folder, a folder of something else")
def test_foreign_folder_is_never_touched(tmp_path, run_at):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    for word in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(UserError, match="not empty and holds no run"):
            run_at(**word)
    assert _contents(tmp_path / "run") == {"thesis.tex": b"years of work"}


@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_config_of_another_format_is_refused(run_at):
    with run_at() as run:
        pass
    head = json.loads((run.path / "config.json").read_text())
    (run.path / "config.json").write_text(json.dumps({**head, "format": 99}))
    with pytest.raises(UserError, match="another format"):
        run_at(resume=True)
    (run.path / "config.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        run_at(resume=True)


@pytest.mark.fault("disk full, folder read-only")
def test_folder_that_cannot_be_written(tmp_path, run_at):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Not a directory; choose another --out"):
        run_at("file")
    with pytest.raises(UserError, match="Not a directory; choose another --out"):
        run_at("file/run")
    if os.geteuid() != 0:  # root may write anywhere
        (tmp_path / "locked").mkdir(mode=0o500)
        with pytest.raises(UserError, match="Permission denied"):
            run_at("locked/run")


def test_metrics_survive_resume_without_doubles(run_at):
    with run_at() as run:
        for step in range(4):
            run.log("search", step, {"fitness": np.float32(step), "spread": np.nan})
        run.log("policy", 9, {"return": np.inf})
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "search", "st')  # killed while writing
    with run_at(resume=True) as run:
        run.rewind("search", 1)
        run.log("search", 2, {"fitness": 20.0})
    lines = read_metrics(run.path / "metrics.jsonl", "search")
    assert [(x["step"], x["fitness"]) for x in lines] == [(0, 0), (1, 1), (2, 20)]
    assert np.isnan(lines[0]["spread"])
    assert read_metrics(run.path / "metrics.jsonl", "policy")[0]["return"] == np.inf
    assert sorted(p.name for p in (run.path / "tensorboard").iterdir()) == [
        "policy",
        "search",
    ]


def test_foreign_metrics_line_is_named(tmp_path):
    (tmp_path / "m.jsonl").write_text('{"stage": "a", "step": 1}\nhello\n')
    with pytest.raises(UserError, match="line 2: not a metrics line"):
        read_metrics(tmp_path / "m.jsonl")


def test_config_hash_ignores_where_a_run_is_written():
    a, b = Config(out=Path("a")), Config(out=Path("b"), resume=True)
    assert config_hash(a) == config_hash(b)
    assert config_hash(a) != config_hash(dataclasses.replace(a, rate=1e-3))


def test_json_keeps_what_is_not_finite():
    text = to_json({"x": [1.5, np.float32(np.nan), -np.inf], "n": np.arange(2)})
    plain = json.loads(text)
    assert plain["n"] == [0, 1]
    values = [number(x) for x in plain["x"]]
    assert values[0] == 1.5
    assert np.isnan(values[1])
    assert values[2] == -np.inf
    with pytest.raises(TypeError, match="object cannot be written"):
        to_json(object())


@pytest.mark.fault("disk full, folder read-only")
def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    atomic_write(path, "old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"cannot write .*a\.json: No space left"):
        atomic_write(path, "new")
    assert _contents(tmp_path) == {"a.json": b"old"}


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EROFS, errno.EACCES])
@pytest.mark.fault("disk full, folder read-only")
def test_metrics_on_a_disk_that_takes_no_more(tmp_path, monkeypatch, reason):
    log = MetricsLog(tmp_path)
    log.write("train", 1, {"loss": 1.0})

    class Full:
        def write(self, _):
            raise OSError(reason, os.strerror(reason))

    with monkeypatch.context() as patch:
        patch.setattr(log, "_file", Full())
        with pytest.raises(UserError, match=f"{os.strerror(reason)}.*--resume"):
            log.write("train", 2, {"loss": 1.0})
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", _fails(reason))
        with pytest.raises(UserError, match=os.strerror(reason)):
            log.rewind("train", 0)
    # As before, and still open.
    log.write("train", 3, {"loss": 1.0})
    log.close()
    lines = read_metrics(tmp_path / "metrics.jsonl")
    assert [line["step"] for line in lines] == [1, 3]


@pytest.mark.fault("disk full, folder read-only")
def test_curves_on_a_disk_that_takes_no_more(tmp_path, monkeypatch):
    log = MetricsLog(tmp_path)
    monkeypatch.setattr(log, "_board", _fails(errno.ENOSPC))
    with pytest.raises(UserError, match=r"cannot write .*tensorboard: No space left"):
        log.write("train", 1, {"loss": 1.0})
    log.close()


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EROFS])
@pytest.mark.fault("disk full, folder read-only")
def test_results_and_videos_on_a_full_or_read_only_disk(tmp_path, monkeypatch, reason):
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    write_report(tmp_path / "report.html", Report("old", []))
    write_video(tmp_path / "a.gif", frames, 10)
    before = _contents(tmp_path)
    said = os.strerror(reason)
    with RunFolder.open(tmp_path / "run", {}) as run:
        run.write_json("results.json", {"a": 1})
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", _fails(reason))
            patch.setattr(Path, "replace", _fails(reason))
            with pytest.raises(UserError, match=rf"results\.json: {said}"):
                run.write_json("results.json", {"a": 2})
            with pytest.raises(UserError, match=rf"report\.html: {said}"):
                write_report(tmp_path / "report.html", Report("new", []))
            with pytest.raises(UserError, match=rf"a\.gif: {said}"):
                write_video(tmp_path / "a.gif", frames + 9, 10)
    kept = _contents(tmp_path)
    assert {name: kept[name] for name in before} == before
    assert json.loads(kept["run/results.json"]) == {"a": 1}
    assert not [name for name in kept if "part" in name or ".results" in name]


def test_names_that_are_no_utf8_are_written(tmp_path):
    atomic_write(tmp_path / "a.txt", "log \udcff.csv")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "log \\udcff.csv"


def _fails(reason):
    def fails(*_args, **_kwargs):
        raise OSError(reason, os.strerror(reason))

    return fails


@pytest.mark.fault("a file that a run reads has changed before --resume")
def test_a_run_does_not_go_on_with_another_file(tmp_path):
    log, missing = tmp_path / "log.csv", tmp_path / "none.csv"
    log.write_text("1")
    out, files = tmp_path / "run", [log, missing]
    RunFolder.open(out, {"data": str(log)}, files=files).close()
    with RunFolder.open(out, {"data": str(log)}, files=files, resume=True) as run:
        assert run.resumed
    log.write_text("2")
    assert has_changed(out, log) and not has_changed(out, missing)
    before = _contents(out)
    with pytest.raises(UserError, match=r"log\.csv has changed since"):
        RunFolder.open(out, {"data": str(log)}, files=files, resume=True)
    assert _contents(out) == before
    (out / "files.json").unlink()  # a run of an older version
    assert not has_changed(out, log)
    RunFolder.open(out, {"data": str(log)}, files=files, resume=True).close()

import json
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import envs
from easi_jax.devices import runtime
from easi_jax.io.runs.folder import RunFolder
from easi_jax.simulation.step import control_step
from train import info
from train._command import main
from train.info import measures

ROOT = Path(__file__).parents[2]


def _info(**changes):
    dropped = ("NPROC", "XLA_FLAGS", "JAX_NUM_CPU_DEVICES")
    env = {k: v for k, v in os.environ.items() if k not in dropped}
    return subprocess.run(
        [sys.executable, "-m", "train.info"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        env={**env, **changes},
        check=True,
    )


def test_fresh_process_has_every_measure_in_force():
    found = _info()
    assert found.stderr == ""
    assert version("jax") in found.stdout
    assert version("mujoco-mjx") in found.stdout
    assert "quiet imports" in found.stdout
    assert "│ NO" not in found.stdout


def test_a_run_says_its_engine_and_why(tmp_path, capsys):
    with RunFolder.open(tmp_path / "run", {}, command="train.easi"):
        show = ("--run", str(tmp_path / "run"))
        main(info.Config, info.run, name="train.info", args=show)
        assert "not known" in capsys.readouterr().out
    why = "29 degrees of freedom on a CPU"
    text = json.dumps({"engine": "mujoco", "why": why})
    (tmp_path / "run" / "engine.json").write_text(text)
    main(info.Config, info.run, name="train.info", args=show)
    said = capsys.readouterr().out
    assert re.search(r"engine +│ mujoco", said) and re.search(rf"why +│ {why}", said)
    with pytest.raises(SystemExit) as left:
        none = ("--run", str(tmp_path))
        main(info.Config, info.run, name="train.info", args=none)
    assert left.value.code == 2 and "holds no run" in capsys.readouterr().err


def test_what_the_environment_took_away_is_shown():
    found = _info(NPROC="1", JAX_NUM_CPU_DEVICES="1")
    rows = [line for line in found.stdout.splitlines() if "│ NO" in line]
    missing = ["deadlock cure"] + ["one device per core"] * (runtime.cores() > 1)
    assert len(rows) == len(missing)
    for row, name in zip(rows, missing, strict=True):
        assert name in row


@pytest.mark.parametrize(
    ("change", "printed", "name"),
    [
        ({"compilation_cache": None}, "", "compilation cache"),
        ({"matmul_precision": None}, "", "full float32 products"),
        ({"prepared_before_backend": False}, "", "set before jax starts"),
        ({}, "Failed to import warp", "quiet imports"),
    ],
)
def test_each_lost_measure_is_a_no(change, printed, name):
    state = {
        "cores": 2,
        "nproc": 8,
        "deadlock_cure": True,
        "platform": "cpu",
        "devices": 2,
        "one_device_per_core": True,
        "compilation_cache": "/cache",
        "matmul_precision": "highest",
        "prepared_before_backend": True,
    }
    assert state.keys() <= runtime.status().keys()
    rows = measures({**state, **change}, printed)
    assert [row[0] for row in rows if row[1] == "NO"] == [name]


_known_jax = pytest.mark.skipif(
    jax.__version_info__[:2] != (0, 10), reason="flags of this jax are unknown"
)


@_known_jax
def test_a_batch_of_simulations_runs_in_one_piece(monkeypatch):
    """Else each step of each substep is many calls, and takes five times as long."""
    env = envs.make("cartpole")
    simulator = env.simulator
    model = env.model()
    start = env.reset(model, jax.random.key(0)).physics
    batch = jax.tree.map(lambda x: jnp.stack([x] * simulator.batch), start)

    @jax.jit
    def go(states, ctrl):
        step = jax.vmap(lambda s: control_step(model, s, ctrl, simulator.substeps))
        return jax.lax.scan(lambda s, _: (step(s), None), states, None, length=20)[0]

    program = go.lower(batch, jnp.zeros(simulator.mj_model.nu))
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    text = program.compile(runtime.fast_loops()).as_text()
    assert text is not None
    assert "xla_cpu_small_call" in text


@_known_jax
def test_who_says_how_far_to_optimize_is_not_overruled(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
    assert runtime.fast_loops() == runtime.quick_compile() == {}
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
    assert runtime.fast_loops() == {"xla_cpu_use_fusion_emitters": True}
    assert runtime.quick_compile() == {"xla_backend_optimization_level": 1}


_LOOP = """
import jax, jax.numpy as jnp
from easi_jax import runtime
{before}
runtime.larger_loops()
step = lambda x, _: (jnp.sin(x) + x[::-1], None)
go = jax.jit(lambda x: jax.lax.scan(step, x, None, length=9)[0])
print("xla_cpu_small_call" in go.lower(jnp.ones({size})).compile().as_text())
"""


@_known_jax
@pytest.mark.parametrize(
    ("before", "size", "one_piece"),
    [
        ("", 400_000, True),  # about 5 MB a round
        ("", 4_000_000, False),
        ("jax.devices()", 400_000, False),  # too late
    ],
)
def test_larger_loops_run_in_one_piece_where_asked_in_time(before, size, one_piece):
    env = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", _LOOP.format(before=before, size=size)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        env=env,
        check=True,
    )
    assert done.stdout.strip() == str(one_piece)


def test_larger_loops_leave_what_the_environment_says(monkeypatch):
    mine = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1"
    monkeypatch.setenv("XLA_FLAGS", mine)
    monkeypatch.setattr(runtime, "backend_started", lambda: False)
    runtime.larger_loops()
    assert os.environ["XLA_FLAGS"] == mine

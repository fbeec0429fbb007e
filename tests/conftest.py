"""Readies jax before any test imports it: quick to compile, one cache for the run.

Three quarters of the default tests' time is compiling (`benchmarks.where_tests_spend`).
So they compile without LLVM's optimizations, and Python looks for cycles of garbage
seldom: a program that is traced makes millions of objects that live.
``EASI_JAX_TESTS=optimized`` compiles as users get it; `make test-slow` sets it.
"""

import atexit
import gc
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest

if os.environ.get("EASI_JAX_TESTS") != "optimized":
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_optimization_level" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_optimization_level=0".strip()
    gc.set_threshold(100_000, 20, 50)
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # The workers of pytest-xdist and the commands that tests start inherit it.
    _cache = tempfile.mkdtemp(prefix="easi_jax_tests_")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)

import easi_jax  # noqa: F401

# A shell that starts the tests in the background lets them ignore Ctrl-C, and what
# they start as well; the tests of interruption need it.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What takes longest goes first, so that no worker is left with it at the end.
LONGEST = (
    *("train/test_killed_pipeline.py", "train/test_chain.py", "test_notebooks.py"),
    *("train/test_easi_from_logs.py", "envs/test_registry.py", "train/test_gap.py"),
    *("train/test_gap_shared.py", "train/test_gap_set.py", "train/test_gap_pairs.py"),
    *("examples/test_your_own_robot.py", "train/test_every_robot.py"),
    *("train/test_effects_option.py", "train/test_gap_details.py"),
    *("easi_jax/search/test_easi.py", "easi_jax/baselines/test_baselines.py"),
    "easi_jax/estimation/test_differences.py",
    "easi_jax/estimation/test_levenberg_marquardt.py",
    "easi_jax/estimation/test_profile_score.py",
    *("easi_jax/estimation/test_polish.py", "test_paper_twin.py"),
    *("easi_jax/model/test_found_effects.py", "easi_jax/estimation/test_posterior.py"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Orders files by `LONGEST`; within a file nothing changes."""
    here = Path(__file__).parent
    place = {here / name: i for i, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in place), "a file of LONGEST is gone"
    items.sort(key=lambda item: place.get(item.path, len(place)))

"""Readies jax as users get it, before any test imports it."""

import signal
from pathlib import Path

import pytest

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
    *("easi_jax/model/test_found_effects.py", "easi_jax/estimation/test_posterior.py"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Orders files by `LONGEST`; within a file nothing changes."""
    here = Path(__file__).parent
    place = {here / name: i for i, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in place), "a file of LONGEST is gone"
    items.sort(key=lambda item: place.get(item.path, len(place)))

"""What the tests of all methods share."""

import pytest

from easi_jax.baselines import Task
from easi_jax.data.segments import Segments
from tests.easi_jax.baselines.small import demonstrate, make_task


@pytest.fixture(scope="session")
def task() -> Task:
    return make_task()


@pytest.fixture(scope="session")
def demonstrations(task: Task) -> Segments:
    return demonstrate(task)

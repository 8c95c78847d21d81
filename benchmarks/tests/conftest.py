"""The seed of the benchmarks' tests, that of all tests where `pytest --seed` gives one."""

import pytest

from benchmarks.__main__ import DEFAULT_SEED


@pytest.fixture
def seed(request):
    return request.config.getoption("--seed", DEFAULT_SEED)

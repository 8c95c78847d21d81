"""Seed of the benchmarks' tests: that of `pytest --seed` if given."""

import pytest

from benchmarks.__main__ import DEFAULT_SEED


@pytest.fixture
def seed(request):
    return request.config.getoption("--seed", DEFAULT_SEED)

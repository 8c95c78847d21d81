"""Holds the trends as they are kept against a count of the current results."""

import sys

import pytest

from service.storage.projections import rollups


def assert_equal_to_a_recount(connection):
    for bucket in ("hour", "day"):
        stored = rollups.stored(connection, bucket)
        counted = rollups.recount(connection, bucket)
        assert stored.keys() == counted.keys()
        for key, row in stored.items():
            # Sums of floats depend on their order, the more so the more there are; counts and
            # extremes are exact.
            rel = max(1e-12, row["batches"] * sys.float_info.epsilon)
            assert row == {
                name: pytest.approx(value, rel=rel) if name.endswith("_sum") else value
                for name, value in counted[key].items()
            }

"""A file is written in the same memory, however many attitudes it holds."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from service.features.products.attitude_formats import attitude_formats, write_attitudes
from service.features.products.attitudes import series_of
from tests.features.products.series import ABOUT, rows, slew

PAGE, STEP_NS = 2_000, 10**9
MOST_BYTES = 40e6


def pages(count):
    """So many pages of one unbroken stretch, each made when it is asked for."""
    page = rows(slew(PAGE, rate_deg_per_s=(0.0, 0.0, 0.36)))
    for number in range(count):
        later = np.int64(number * PAGE * STEP_NS)
        yield dataclasses.replace(page, time_ns=page.time_ns + later)


def peak_bytes(name, count):
    tracemalloc.start()
    try:
        size = sum(len(piece) for piece in write_attitudes(name, series_of(ABOUT, pages(count))))
        return size, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in ("acm", "aem-xml", "csv") else [])
        for name in attitude_formats()
    ],
)
@pytest.mark.slow("json", "fits", "aem", "parquet")
def test_memory_does_not_grow_with_the_attitudes(name):
    peak_bytes(name, 1)
    size, peak = peak_bytes(name, 30)
    # An APM holds one attitude.
    assert size > (500 if name == "apm" else 500_000)
    assert peak < MOST_BYTES

"""A block is read whole, or refused with the field and the value."""

import json

import numpy as np
import pytest

from service.errors import BadBatch
from service.gyro.blocks import (
    MAX_SAMPLES,
    block_from_json,
    block_from_line,
    require_rates_within,
    texts_of,
)
from service.times import parse_utc, shifted
from tests.gyro.blocks import START, body


def read(told):
    return block_from_json(json.dumps(told), "XTE")


def faults(told):
    with pytest.raises(BadBatch) as caught:
        read(told)
    return [(each.field, each.message, each.value) for each in caught.value.faults]


def test_a_block_is_read_as_it_was_sent(rng):
    told = body(rng=rng, samples=100)
    block = read(told)
    assert block.rates_rad_per_s.tolist() == told["rates_rad_per_s"]
    assert block.times_s.tolist() == [k * 0.1 for k in range(100)]
    assert (block.spacecraft, block.run, block.block) == ("XTE", "live", "g1")
    assert not block.rates_rad_per_s.flags.writeable


def test_the_fingerprint_is_that_of_the_values_and_not_of_their_spelling():
    told = body(start="1999-03-01T00:00:00.000Z")
    same = json.dumps(dict(reversed(told.items())), indent=2).replace("1999-03-01T", "1999-060T")
    assert block_from_json(same, "XTE").fingerprint == read(told).fingerprint


@pytest.mark.parametrize(
    "change",
    [
        {"block": "g2"},
        {"run": "pass-7"},
        {"start": "1999-03-01T00:00:00.001Z"},
        {"step_s": 0.2},
        {"rates_rad_per_s": [[1e-3, 0.0, 1e-300]] * 5},
    ],
)
def test_any_other_value_makes_another_fingerprint(change):
    assert read(body() | change).fingerprint != read(body()).fingerprint


def test_times_are_seconds_of_tai_across_a_leap_second():
    block = read(body(start="1998-12-31T23:59:59.500Z", times_s=[0.0, 0.5, 1.0, 1.5, 2.25]))
    assert np.diff(block.tai_ns).tolist() == [5e8, 5e8, 5e8, 7.5e8]
    assert block.end.text == "1999-01-01T00:00:00.750Z"
    texts = texts_of(block.start, block.times_s)
    assert texts[1:3] == ["1998-12-31T23:59:60.000Z", "1998-12-31T23:59:60.500Z"]


def test_texts_of_many_times_are_those_of_each(rng):
    start = parse_utc("2016-12-31T23:59:58.123456789Z")
    times_s = np.sort(rng.uniform(0, 86_400, 300)).round(9)
    expected = [shifted(start, float(each)).text for each in times_s]
    assert texts_of(start, times_s) == expected


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        ({"rates_rad_per_s": []}, "rates_rad_per_s", "at least 1 entry"),
        ({"rates_rad_per_s": [[0.0] * 3] * (MAX_SAMPLES + 1)}, "rates_rad_per_s", "at most 10000"),
        ({"rates_rad_per_s": [[0.0, 0.0]]}, "rates_rad_per_s.0", "3 entries, not 2"),
        ({"rates_rad_per_s": [[0.0, "1e-3", 0.0]]}, "rates_rad_per_s.0.1", "must be a number"),
        ({"rates_rad_per_s": [[0.0, True, 0.0]]}, "rates_rad_per_s.0.1", "must be a number"),
        ({"rates_rad_per_s": [[0, 0, 0], [0, 0, float("nan")]]}, "rates_rad_per_s.1.2", "finite"),
        ({"rates_rad_per_s": [[float("-inf"), 0, 0]]}, "rates_rad_per_s.0.0", "finite"),
        ({"step_s": 0.0}, "step_s", "at least 1e-06"),
        ({"step_s": -0.1}, "step_s", "at least 1e-06"),
        ({"step_s": float("nan")}, "step_s", "finite"),
        ({"step_s": 30_000.0}, "step_s", "5 samples span 120000 s, at most 86400 s may"),
        ({"step_s": None}, "body", "needs either step_s or times_s"),
        ({"times_s": [0.0, 1.0, 2.0, 3.0, 4.0]}, "body", "needs either step_s or times_s"),
        ({"start": "noon"}, "start", "must be UTC"),
        ({"start": "1999-02-29T00:00:00Z"}, "start", "no such day"),
        ({"block": ""}, "block", "must not be empty"),
        ({"block": "a\nb"}, "block", "without control characters"),
        ({"run": "a b"}, "run", "letters, digits"),
        ({"colour": "red"}, "colour", "there is no such field"),
    ],
)
def test_a_bad_field_is_named_with_its_value(change, field, message):
    found = faults(body() | change)
    assert [each[0] for each in found] == [field]
    assert message in found[0][1]


@pytest.mark.parametrize(
    ("times_s", "field", "message", "value"),
    [
        ([0.0, 1.0, 0.5], "times_s.2", "1e-06 s after the time before it, 1", "0.5"),
        ([0.0, 1.0, 1.0], "times_s.2", "1e-06 s after the time before it, 1", "1.0"),
        ([0.0, 1e-7], "times_s.1", "1e-06 s after the time before it, 0", "1e-07"),
        ([0.5, 1.0], "times_s.0", "must be 0: start is the time of the first sample", "0.5"),
        ([0.0, -1.0], "times_s.1", "at least 0", "-1.0"),
        ([0.0, 86_401.0], "times_s.1", "at most 86400", "86401.0"),
    ],
)
def test_times_that_do_not_rise_from_the_start_are_named(times_s, field, message, value):
    ((found, said, shown),) = faults(body(times_s=times_s))
    assert (found, shown) == (field, value)
    assert message in said


def test_a_time_that_is_missing_is_told_by_the_numbers():
    told = body(times_s=[0.0, 1.0]) | {"rates_rad_per_s": [[0.0] * 3] * 3}
    assert faults(told) == [("times_s", "has 2 times for the 3 samples of rates_rad_per_s", None)]


@pytest.mark.parametrize("rate", [100.0, -100.0, 0.175])
def test_a_rate_in_another_unit_is_named_with_the_bound(rate):
    block = read(body() | {"rates_rad_per_s": [[0.0, 0.17, 0.0], [0.0, 0.0, rate]]})
    with pytest.raises(BadBatch) as caught:
        require_rates_within(block, 10.0)
    (fault,) = caught.value.faults
    assert (fault.field, fault.value) == ("rates_rad_per_s.1.2", str(rate))
    assert "largest rate of XTE, 0.174533 rad/s (10 deg/s)" in fault.message


def test_a_line_names_its_spacecraft_and_may_be_given_another_run():
    line = json.dumps(body() | {"spacecraft": "SWAS"})
    block = block_from_line(line, run="pass-7")
    assert (block.spacecraft, block.run) == ("SWAS", "pass-7")
    with pytest.raises(BadBatch, match="spacecraft"):
        block_from_line(json.dumps(body()))


def test_the_start_may_have_the_day_of_the_year():
    assert read(body(start="1999-060T00:00:00Z")).start.text == START

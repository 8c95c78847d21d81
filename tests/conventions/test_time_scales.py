"""UTC against TT and TAI, by numbers that stand in the bulletins."""

import pytest

from service.times import parse_utc

J2000_DAYS = 2451545.0


def seconds_from_utc_to_tt(text):
    """TT minus UTC from the two Julian dates of a day without a leap second."""
    utc = parse_utc(text)
    return ((utc.tt[0] - utc.jd1) + (utc.tt[1] - utc.jd2)) * 86400.0


@pytest.mark.parametrize(
    ("text", "leap_seconds"),
    [
        ("1972-01-01T00:00:00Z", 10),
        ("1972-07-01T00:00:00Z", 11),
        ("1995-12-02T08:08:01Z", 29),
        ("1996-01-10T12:00:00Z", 30),
        ("1999-01-01T00:00:00Z", 32),
        ("2006-01-01T00:00:00Z", 33),
        ("2017-01-01T00:00:00Z", 37),
        ("2026-11-21T00:00:00Z", 37),
    ],
)
def test_terrestrial_time_is_ahead_by_the_leap_seconds_and_32_184(text, leap_seconds):
    assert seconds_from_utc_to_tt(text) == pytest.approx(leap_seconds + 32.184, abs=1e-5)


def test_j2000_is_eleven_fifty_eight_and_fifty_five_in_utc():
    utc = parse_utc("2000-01-01T11:58:55.816Z")
    assert sum(utc.tt) == J2000_DAYS
    assert utc.tt[1] == pytest.approx(J2000_DAYS - utc.tt[0], abs=1e-15)
    assert utc.julian_year == 2000.0


def test_atomic_nanoseconds_count_from_noon_of_2000_tai():
    # TAI - UTC was 32 s: noon TAI is 11:59:28 UTC.
    assert parse_utc("2000-01-01T11:59:28Z").tai_ns == 0
    assert parse_utc("2000-01-01T12:00:00.000000001Z").tai_ns == 32_000_000_001


def test_a_day_with_a_leap_second_has_86401_seconds():
    start, end = parse_utc("2016-12-31T00:00:00Z"), parse_utc("2017-01-01T00:00:00Z")
    assert end.tai_ns - start.tai_ns == 86_401 * 10**9
    start, end = parse_utc("2015-12-31T00:00:00Z"), parse_utc("2016-01-01T00:00:00Z")
    assert end.tai_ns - start.tai_ns == 86_400 * 10**9


def test_the_leap_second_of_1995_ends_the_year():
    leap = parse_utc("1995-365T23:59:60.500Z")
    assert leap.text == "1995-12-31T23:59:60.500Z"
    # Half a second later 1996 begins, with one more second between the scales.
    assert parse_utc("1996-01-01T00:00:00Z").tai_ns - leap.tai_ns == 500_000_000


@pytest.mark.parametrize(
    ("calendar", "ordinal"),
    [
        ("1996-01-10T12:00:00.000Z", "1996-010T12:00:00.000Z"),
        ("1996-02-29T00:00:00.000Z", "1996-060T00:00:00.000Z"),
        ("1997-03-01T00:00:00.000Z", "1997-060T00:00:00.000Z"),
        ("1996-12-31T23:59:59.999Z", "1996-366T23:59:59.999Z"),
    ],
)
def test_day_of_year_and_calendar_are_the_same_day(calendar, ordinal):
    assert parse_utc(ordinal).text == calendar


@pytest.mark.parametrize(
    ("read", "shown"),
    [
        ("1996-01-10T12:00:00Z", "1996-01-10T12:00:00.000Z"),
        ("1996-01-10T12:00:00.5", "1996-01-10T12:00:00.500Z"),
        ("1996-01-10T12:00:00.123456Z", "1996-01-10T12:00:00.123456Z"),
        ("1996-01-10T12:00:00.1234567Z", "1996-01-10T12:00:00.1234567Z"),
        ("1996-01-10T23:59:59.999999999Z", "1996-01-10T23:59:59.999999999Z"),
    ],
)
def test_digits_below_the_microsecond_are_kept(read, shown):
    assert parse_utc(read).text == shown

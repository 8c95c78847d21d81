"""UTC text is read in both forms, kept to the nanosecond, and counted through leap seconds."""

from datetime import UTC, datetime, timedelta

import pytest
from erfa import ufunc
from hypothesis import example, given
from hypothesis import strategies as st

from service.errors import BadInput
from service.times import Utc, bucket_start, parse_utc, shifted

moments = st.datetimes(datetime(1972, 1, 1), datetime(2099, 12, 31, 23, 59, 59))
nanoseconds = st.integers(0, 999_999_999)


def text_of(moment, ns):
    fraction = f"{ns:09d}".rstrip("0").ljust(3, "0")
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction}Z"


@given(moments, nanoseconds)
def test_text_comes_back_to_the_last_digit(moment, ns):
    text = text_of(moment, ns)
    assert parse_utc(text).text == text
    assert str(parse_utc(text)) == text


@given(moments, nanoseconds)
def test_the_day_of_year_form_is_the_same_moment(moment, ns):
    calendar = text_of(moment, ns)
    ordinal = f"{moment:%Y-%j}T{calendar.partition('T')[2]}"
    assert parse_utc(ordinal) == parse_utc(calendar)
    assert parse_utc(ordinal).day_of_year == int(f"{moment:%j}")


@given(moments, nanoseconds, moments, nanoseconds)
def test_moments_sort_as_their_texts_do(first, first_ns, second, second_ns):
    one, two = text_of(first, first_ns), text_of(second, second_ns)
    earlier = (first, first_ns) < (second, second_ns)
    assert (parse_utc(one) < parse_utc(two)) == earlier
    assert (parse_utc(one).tai_ns < parse_utc(two).tai_ns) == earlier


@given(moments, st.integers(0, 999).map(lambda n: n * 1_000_000), st.floats(-1e7, 1e7))
def test_a_shifted_moment_is_as_far_off_in_atomic_time_as_was_asked(moment, ns, seconds):
    if not 1973 < moment.year < 2099:
        return
    start = parse_utc(text_of(moment, ns))
    end = shifted(start, seconds)
    assert end.tai_ns - start.tai_ns == pytest.approx(seconds * 1e9, abs=2.0)
    assert (end > start) == (end.tai_ns > start.tai_ns)


def test_a_shifted_moment_equals_the_one_that_is_read():
    assert shifted(parse_utc("1996-01-10T12:00:00Z"), 3 * 86400.0) == parse_utc(
        "1996-01-13T12:00:00Z"
    )
    assert shifted(parse_utc("2016-12-31T23:59:60.5Z"), 0.5) == parse_utc("2017-01-01T00:00:00Z")


def test_a_leap_second_is_a_second_like_any_other():
    before, leap, after = (
        parse_utc(text)
        for text in ("2016-12-31T23:59:59Z", "2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z")
    )
    assert before < leap < after
    assert leap.tai_ns - before.tai_ns == after.tai_ns - leap.tai_ns == 1_000_000_000
    assert parse_utc("2016-366T23:59:60Z") == leap
    assert parse_utc("2016-12-31T23:59:60.999999999Z").text == "2016-12-31T23:59:60.999999999Z"


@given(moments)
def test_hours_and_days_are_counted_in_utc_and_found_again(moment):
    utc = parse_utc(text_of(moment, 0))
    hour = moment.replace(minute=0, second=0, microsecond=0)
    assert bucket_start(utc.bucket(3600), 3600) == parse_utc(text_of(hour, 0))
    assert bucket_start(utc.bucket(86400), 86400) == parse_utc(text_of(hour.replace(hour=0), 0))
    begin = bucket_start(utc.bucket(3600), 3600)
    # Known by its fields, it is what ERFA makes of the same date.
    assert (begin.text, begin.tai_ns) == (
        Utc(begin.jd1, begin.jd2).text,
        Utc(begin.jd1, begin.jd2).tai_ns,
    )
    since_mjd_zero = moment.replace(tzinfo=UTC) - datetime(1858, 11, 17, tzinfo=UTC)
    assert utc.bucket(3600) == since_mjd_zero // timedelta(hours=1)


def test_a_leap_second_belongs_to_the_hour_that_it_ends():
    leap, before = parse_utc("2016-12-31T23:59:60.9Z"), parse_utc("2016-12-31T23:00:00Z")
    assert leap.bucket(3600) == before.bucket(3600)
    assert leap.bucket(86400) == before.bucket(86400)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1996-13-01T00:00:00Z", "no such day"),
        ("1996-02-30T00:00:00Z", "no such day"),
        ("1997-366T00:00:00Z", "no such day of the year"),
        ("1996-000T00:00:00Z", "no such day of the year"),
        ("1996-01-10T24:00:01Z", "no such time of day"),
        ("1996-01-10T12:60:00Z", "no such time of day"),
        ("1996-01-10T12:00:61Z", "no such time of day"),
        ("2016-12-30T23:59:60Z", "no leap second"),
        ("2016-12-31T22:59:60Z", "no leap second"),
        ("1971-12-31T23:59:59Z", "year"),
        ("2100-01-01T00:00:00Z", "year"),
        ("9999-12-31T00:00:00Z", "year"),
        ("1996-01-10 12:00:00Z", "must be UTC"),
        ("1996-01-10T12:00:00+1:00", "must be UTC"),
        ("1996-01-10T12:00:00Z+01:00", "must be UTC"),
        ("1996-01-10T12:00:00 +01:00", "must be UTC"),
        ("1996-01-10T12:00:00+01:00:00", "must be UTC"),
        ("1996-01-10T12:00:00CET", "must be UTC"),
        ("1996-01-10T12:00:00+24:00", "no such time zone"),
        ("1996-01-10T12:00:00+01:60", "no such time zone"),
        ("2016-12-31T23:59:60+01:00", "no leap second"),
        ("1996-01-10T12:00:00.1234567890Z", "must be UTC"),
        ("١٩٩٦-01-10T12:00:00Z", "must be UTC"),
        ("", "must be UTC"),
        (None, "must be UTC"),
        (830000000, "must be UTC"),
    ],
)
def test_a_time_that_does_not_exist_is_refused_with_its_reason(text, why):
    with pytest.raises(BadInput, match=why) as refusal:
        parse_utc(text, "observations.0.time")
    assert refusal.value.faults[0].field == "observations.0.time"


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("1996-01-10T12:54:30+00:00", "1996-01-10T12:54:30.000Z"),
        ("1996-01-10T12:54:30-00:00", "1996-01-10T12:54:30.000Z"),
        ("1996-01-10T12:54:30.25+01:00", "1996-01-10T11:54:30.250Z"),
        ("1996-01-10T00:30:00+0530", "1996-01-09T19:00:00.000Z"),
        ("1996-01-10T23:30:00-08", "1996-01-11T07:30:00.000Z"),
        ("1997-001T00:15:00+00:45", "1996-12-31T23:30:00.000Z"),
        ("1996-366T23:59:59.999999999-14:00", "1997-01-01T13:59:59.999999999Z"),
        ("2017-01-01T00:59:60.5+01:00", "2016-12-31T23:59:60.500Z"),
        ("2016-12-31T18:59:60-05:00", "2016-12-31T23:59:60.000Z"),
    ],
)
def test_the_offset_of_a_time_zone_is_converted(text, utc):
    moment = parse_utc(text)
    assert moment.text == utc
    assert moment == parse_utc(utc)
    assert moment.tai_ns == parse_utc(utc).tai_ns


def test_moments_hash_alike_where_they_are_equal():
    assert len({parse_utc("1996-010T12:00:00Z"), parse_utc("1996-01-10T12:00:00.000Z")}) == 1
    assert isinstance(parse_utc("1996-010T12:00:00"), Utc)


@given(moments, nanoseconds)
@example(datetime(1972, 6, 30, 23, 59, 59), 999_999_999)
@example(datetime(2016, 12, 31, 23, 59, 59), 5)
def test_the_julian_dates_are_those_of_erfa_to_the_last_bit(moment, ns):
    text = text_of(moment, ns)
    utc = parse_utc(text)
    second = moment.second + float(text[19:-1])
    day = moment.year, moment.month, moment.day
    jd1, jd2, _ = ufunc.dtf2d(b"UTC", *day, moment.hour, moment.minute, second)
    assert (utc.jd1, utc.jd2) == (jd1, jd2)
    tai1, tai2, _ = ufunc.utctai(jd1, jd2)
    assert utc.tt == tuple(ufunc.taitt(tai1, tai2)[:2])
    assert utc.julian_year == ufunc.epj(*utc.tt)

"""Times of packets are those of astropy: days of 1958, TAI and GPS seconds, leap seconds."""

from datetime import date, datetime

import numpy as np
import pytest
from astropy.time import Time

from service.features.packets.clock import moment_of
from service.features.packets.definition import PacketFault
from service.missions.packets import CdsTime, CucTime
from service.times import FIRST_YEAR, LAST_YEAR, parse_utc

CDS = CdsTime(kind="cds", day="D", millisecond="MS", microsecond="US")


def cuc(scale, epoch="1958-01-01T00:00:00", bits=16):
    return CucTime(
        kind="cuc",
        coarse="S",
        fine="F",
        fine_bits=bits,
        scale=scale,
        epoch=datetime.fromisoformat(epoch),
    )


def test_days_and_milliseconds_are_utc():
    rng = np.random.default_rng(1)
    start = date(1958, 1, 1).toordinal()
    for _ in range(500):
        day = int(rng.integers(6000, 25000))
        ms, us = int(rng.integers(86_400_000)), int(rng.integers(1000))
        found = moment_of(CDS, {"D": day, "MS": ms, "US": us})
        expected = Time(date.fromordinal(start + day).isoformat(), scale="utc", precision=9)
        seconds = ms // 1000
        clock = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
        text = f"{expected.iso[:10]}T{clock}.{ms % 1000:03d}{us:03d}"
        assert found.text.rstrip("Z").ljust(26, "0") == text
        assert found.tai_ns == parse_utc(found.text).tai_ns


def test_the_days_of_every_supported_year_are_read():
    start = date(1958, 1, 1)
    for day in (date(FIRST_YEAR, 1, 1), date(LAST_YEAR, 12, 31)):
        found = moment_of(CDS, {"D": (day - start).days, "MS": 86_399_999, "US": 0})
        assert found.text == f"{day}T23:59:59.999Z"
    for day in (date(FIRST_YEAR - 1, 12, 31), date(LAST_YEAR + 1, 1, 1)):
        with pytest.raises(PacketFault, match=f"not in {FIRST_YEAR} to {LAST_YEAR}"):
            moment_of(CDS, {"D": (day - start).days, "MS": 0, "US": 0})


def test_the_milliseconds_of_a_leap_second_are_read():
    day = (date(2016, 12, 31) - date(1958, 1, 1)).days
    found = moment_of(CDS, {"D": day, "MS": 86_400_250, "US": 0})
    assert found.text == "2016-12-31T23:59:60.250Z"
    after = moment_of(CDS, {"D": day + 1, "MS": 0, "US": 0})
    assert after.tai_ns - found.tai_ns == 750_000_000
    with pytest.raises(PacketFault, match="no such millisecond"):
        moment_of(CDS, {"D": day + 1, "MS": 86_400_250, "US": 0})


@pytest.mark.parametrize(
    ("scale", "epoch"),
    [
        ("tai", "1958-01-01T00:00:00"),
        ("tai", "2000-01-01T12:00:00"),
        ("gps", "1980-01-06T00:00:00"),
    ],
)
def test_seconds_on_the_clocks_of_tai_and_gps_count_leap_seconds(scale, epoch):
    rng = np.random.default_rng(2)
    tai_epoch = Time(epoch, scale="tai") if scale == "tai" else Time(epoch, scale="utc").tai
    for second in rng.integers(500_000_000, 1_500_000_000, 300):
        if epoch.startswith("2000"):
            second //= 2
        fine = int(rng.integers(65536))
        found = moment_of(cuc(scale, epoch), {"S": int(second), "F": fine})
        tai = (
            Time(tai_epoch.jd1, tai_epoch.jd2, format="jd", scale="tai") + float(second) * _second()
        )
        tai += fine / 65536 * _second()
        difference = Time(found.text.rstrip("Z"), scale="utc").tai - tai
        assert abs(difference.sec) < 2e-9
        assert found.tai_ns == parse_utc(found.text).tai_ns


def _second():
    from astropy import units

    return units.s


def test_seconds_of_posix_leave_leap_seconds_out():
    found = moment_of(cuc("utc", "1970-01-01T00:00:00"), {"S": 1_483_228_800, "F": 32768})
    assert found.text == "2017-01-01T00:00:00.500Z"


def test_the_last_second_before_and_after_a_leap_second():
    first = Time("2016-12-31T23:59:59", scale="utc").gps
    texts = [
        moment_of(cuc("gps", "1980-01-06T00:00:00"), {"S": round(first) + k, "F": 0}).text
        for k in range(3)
    ]
    assert texts == [
        "2016-12-31T23:59:59.000Z",
        "2016-12-31T23:59:60.000Z",
        "2017-01-01T00:00:00.000Z",
    ]


@pytest.mark.parametrize(
    ("time", "values", "parameter"),
    [
        (CDS, {"D": 0, "MS": 0, "US": 0}, "D"),
        (CDS, {"D": 65535, "MS": 0, "US": 0}, "D"),
        (CDS, {"D": 1 << 40, "MS": 0, "US": 0}, "D"),
        (CDS, {"D": 15000, "MS": 86_400_000, "US": 0}, "MS"),
        (CDS, {"D": 15000, "MS": -1, "US": 0}, "MS"),
        (CDS, {"D": 15000, "MS": 0, "US": 1000}, "US"),
        (CDS, {"D": 15000.5, "MS": 0, "US": 0}, "D"),
        (CDS, {"D": "15000", "MS": 0, "US": 0}, "D"),
        (CDS, {"D": 15000, "US": 0}, "MS"),
        (cuc("tai"), {"S": -(1 << 70), "F": 0}, "S"),
        (cuc("gps"), {"S": 1 << 70, "F": 0}, "S"),
        (cuc("utc"), {"S": 1 << 70, "F": 0}, "S"),
        (cuc("tai"), {"S": 1_500_000_000, "F": 65536}, "F"),
    ],
)
def test_a_time_that_is_none_is_named_by_its_parameter(time, values, parameter):
    with pytest.raises(PacketFault) as fault:
        moment_of(time, values)
    assert fault.value.parameter == parameter

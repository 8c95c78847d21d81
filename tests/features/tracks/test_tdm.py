"""A TDM, read by Orekit."""

import pytest

from service.features.tracks.tdm import TrackedObject, write_tdm
from service.times import parse_utc

TIMES = ("2016-12-31T23:59:59.500Z", "2016-12-31T23:59:60.250Z", "2017-01-01T00:00:01.125Z")
SEEN = TrackedObject(
    name="TRACK-1",
    comments=("Rate 1.5 arcsec/s",),
    time=TIMES,
    ra_deg=(359.999, 0.001, 0.003),
    dec_deg=(-10.5, -10.25, -10.125),
    magnitude=(5.5, None, 5.25),
)


@pytest.fixture
def message(orekit, tmp_path):
    def read(*objects):
        content = b"".join(write_tdm("1995-074A", "live", "2026-01-01T00:00:00Z", "1", objects))
        (tmp_path / "x.tdm").write_bytes(content)
        return orekit.read("tdm", tmp_path / "x.tdm")

    return read


def test_orekit_reads_the_angles_at_their_times_across_a_leap_second(message):
    (segment,) = message(SEEN)
    assert segment["participants"] == ["1995-074A", "TRACK-1"]
    assert (segment["angle_type"], segment["frame"]) == ("RADEC", "EME2000")
    assert segment["path"] == [2, 1]
    seconds = [parse_utc(each).tai_ns * 1e-9 for each in TIMES]
    for keyword, values, scale in (
        ("ANGLE_1", SEEN.ra_deg, 57.29577951308232),
        ("ANGLE_2", SEEN.dec_deg, 57.29577951308232),
    ):
        own = [each for each in segment["observations"] if each["type"] == keyword]
        assert [each["tai_s"] for each in own] == pytest.approx(seconds, abs=1e-6)
        assert [each["value"] * scale for each in own] == pytest.approx(values, abs=1e-12)
    own = [each for each in segment["observations"] if each["type"] == "MAG"]
    assert [each["value"] for each in own] == [5.5, 5.25]


def test_each_object_is_a_segment_of_its_own(message):
    assert len(message(SEEN, SEEN, SEEN)) == 3

"""The table `[packets]` names parameters of telemetry; a mistake in it is named with its key."""

import pytest

from service.errors import BadConfiguration
from service.missions.mission import SHIPPED_FOLDER, load_missions, parse_mission
from service.missions.packets import CdsTime, CucTime, element_names
from tests.missions.without_gyro import mission_without_gyro

XTE = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
TABLE = """
[packets]
batch = "ST_FRAME"
[packets.time]
kind = "cds"
day = "ST_DAY"
millisecond = "ST_MS"
[[packets.trackers]]
tracker = "STARTRACKER_1"
slots = 3
h = "ST1_H"
v = "ST1_V_{}"
magnitude = ["M1", "M2", "M3"]
[packets.prior]
quaternion = ["Q1", "Q2", "Q3", "Q4"]
[packets.gyro]
counts = "GYRO"
scale_deg = [1e-5, 1e-5, 2e-5]
"""
DIGESTS = {
    "IMAGER": "sha256:ab4d1f11e974b0d20336357b7841d71015c3f10a47755399a64c1152ae3645bf",
    "SOHO": "sha256:a5d685e627bf628044c1588d84c087b79717e54de5fa998f8f470e65e3213c13",
    "SWAS": "sha256:bac5cdf86331692437332393e572a334383f251de015e7fa7d40a2fab24ebf5f",
    "XTE": "sha256:1a499a850b01d14896a3cbb4a999e8c7c4fc00f57655296d0228dc9e6e019ca3",
}
"""Of the shipped missions before there was a table `[packets]`, and none of them had a gyro."""


def test_a_mission_without_the_table_has_the_digest_that_it_had():
    shipped = load_missions()
    plain = {
        name: each if each.gyro is None else mission_without_gyro(name)
        for name, each in shipped.items()
    }
    assert {name: each.digest for name, each in plain.items()} == DIGESTS
    assert "packets" not in shipped["XTE"].model_dump()


def test_the_table_is_read_and_counts_in_the_digest():
    mission = parse_mission(XTE + TABLE, "x.toml")
    assert mission.digest != DIGESTS["XTE"]
    packets = mission.packets
    assert packets is not None
    assert isinstance(packets.time, CdsTime)
    assert packets.time.epoch.isoformat() == "1958-01-01"
    assert packets.trackers[0].magnitude == ("M1", "M2", "M3")
    assert packets.gyro is not None
    assert packets.gyro.counter_bits == 16


def test_names_are_elements_of_an_array_numbered_names_or_a_list():
    assert element_names("ST1_H", 2, first=1) == ("ST1_H[0]", "ST1_H[1]")
    assert element_names("ST1_V_{}", 2, first=1) == ("ST1_V_1", "ST1_V_2")
    assert element_names(("A", "B"), 2) == ("A", "B")


def test_an_epoch_of_seconds_is_read_on_its_own_clock():
    cuc = 'kind = "cuc"\ncoarse = "S"\nscale = "gps"\nepoch = 1980-01-06T00:00:00\n'
    text = TABLE.replace('kind = "cds"\nday = "ST_DAY"\nmillisecond = "ST_MS"\n', cuc)
    packets = parse_mission(XTE + text, "x.toml").packets
    assert packets is not None
    assert isinstance(packets.time, CucTime)
    assert packets.time.epoch.isoformat() == "1980-01-06T00:00:00"


MISTAKES = [
    ('batch = "ST_FRAME"', 'frame = "ST_FRAME"', ("packets.frame", "batch", "join_within_s")),
    ('day = "ST_DAY"', 'days = "ST_DAY"', ("packets.time.days", "did you mean day?")),
    ('day = "ST_DAY"', 'day = "A"\nhour = "B"', ("packets.time.hour", "millisecond, microsecond")),
    ('kind = "cds"', 'kind = "sclk"', ("packets.time", "cds", "cuc", "sclk")),
    ('day = "ST_DAY"', 'day = "ST DAY"', ("packets.time.day", "ST DAY")),
    ('"STARTRACKER_1"', '"STARTRACKER_9"', ("packets", "STARTRACKER_9", "has STARTRACKER_1")),
    ('h = "ST1_H"\n', "", ("packets.trackers.0", "both h and v")),
    ("slots = 3", "slots = 4", ("packets.trackers.0", "magnitude names 3 parameters for 4 slots")),
    ("slots = 3", "slots = 0", ("packets.trackers.0.slots", "0")),
    ('"ST1_V_{}"', '"ST1_{}_{}"', ("packets.trackers.0.v", "with one {}", "ST1_{}_{}")),
    ('"Q1", ', "", ("packets.prior.quaternion", "must have 4 entries, not 3")),
    ('"Q1", ', '"Q0", "Q1", ', ("packets.prior.quaternion",)),
    ("scale_deg = [1e-5,", "scale_deg = [0.0,", ("packets.gyro", "scale_deg", "other than 0")),
    ("[packets.prior]\n", "[packets.prior]\nsun_pointed = true\n", ("packets.prior", "either")),
    ("[packets.gyro]", '[packets.rates]\ncomponents = "W"\n[packets.gyro]', ("packets", "either")),
]


@pytest.mark.parametrize(("old", "new", "words"), MISTAKES)
def test_a_mistake_names_the_file_the_key_and_what_is_allowed(old, new, words):
    assert old in TABLE
    with pytest.raises(BadConfiguration) as refusal:
        parse_mission(XTE + TABLE.replace(old, new, 1), "site/hubble.toml")
    for word in ("site/hubble.toml", *words):
        assert word in str(refusal.value)
    assert "constrained-str" not in str(refusal.value)

"""FITS files of other writers: where the image is, which way up, and when it was taken."""

import gzip
import io
import math

import numpy as np
import pytest
from astropy.io import fits

from service.errors import BadBatch, BadFile
from service.features.pictures.frames import files
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from service.features.pictures.tracker.submit import FrameIn, time_of

ROWS, COLUMNS = 24, 40
NOON = "2026-03-01T12:00:00"


def read(data, **limits):
    return read_frame(io.BytesIO(data), FrameLimits(max_pixels=100_000, **limits))


def written(*units):
    file = io.BytesIO()
    fits.HDUList(list(units)).writeto(file, output_verify="ignore")
    return file.getvalue()


def image(values, cards=(), kind=fits.ImageHDU, **more):
    unit = kind(values, **more)
    for key, value in dict(cards).items():
        unit.header[key] = value
    return unit


def header_time(extension=None, primary=None):
    """The frame of a file whose two headers hold some cards."""
    first = image(None, primary or {}, fits.PrimaryHDU)
    return read(written(first, image(np.zeros((3, 3), "u1"), extension or {})))


@pytest.fixture
def values(rng):
    return rng.integers(0, 60000, (ROWS, COLUMNS)).astype(np.uint16)


TIMES = {
    "start and exposure in the primary header": ({}, {"DATE-OBS": NOON, "EXPTIME": 4.0}, 2.0),
    "a Julian date within the exposure": (
        {"DATE-OBS": NOON, "JD": 2461101.00002, "EXPTIME": 4.0},
        {},
        2.0,
    ),
    "a stack with its end": (
        {"DATE-OBS": NOON, "DATE-END": "2026-03-01T12:00:04", "EXPTIME": 4.0, "NCOMBINE": 4},
        {},
        2.0,
    ),
    "the local time of Greenwich": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "LT": "12:00:00", "TIMEZONE": 0},
        {},
        2.0,
    ),
    "start with a Z": ({"DATE-OBS": NOON + ".000Z", "EXPTIME": 4.0}, {}, 2.0),
    "start in the extension": ({"DATE-OBS": NOON}, {"EXPTIME": 4.0}, 2.0),
    "the extension's own start": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0},
        {"DATE-AVG": "2026-03-01T18:00:00", "EXPTIME": 60.0},
        2.0,
    ),
    "EXPOSURE": ({"DATE-OBS": NOON, "EXPOSURE": 4.0}, {}, 2.0),
    "XPOSURE": ({"DATE-BEG": NOON, "XPOSURE": 4.0, "EXPTIME": 4.02}, {}, 2.0),
    "exposure as text": ({"DATE-OBS": NOON, "EXPTIME": "4.0"}, {}, 2.0),
    "exposure as text with its unit": ({"DATE-OBS": NOON, "EXPTIME": "4000 ms"}, {}, 2.0),
    "exposure in a unit": ({"DATE-OBS": NOON, "EXPTIME": (4000, "[ms] shutter")}, {}, 2.0),
    "exposure in brackets": ({"DATE-OBS": NOON, "EXPOSURE": (4.0, "(sec)")}, {}, 2.0),
    "start and end": ({"DATE-BEG": NOON, "DATE-END": "2026-03-01T12:00:08"}, {}, 4.0),
    "end and exposure": ({"DATE-END": "2026-03-01T12:00:08", "EXPTIME": 8.0}, {}, 4.0),
    "the average": ({"DATE-AVG": NOON, "EXPTIME": 4.0}, {}, 0.0),
    "MJD-OBS": ({"MJD-OBS": 61100.5, "EXPTIME": 4.0}, {}, 2.0),
    "MJD-AVG": ({"MJD-AVG": 61100.5}, {}, 0.0),
    "a whole date and its time of day": (
        {"DATE-OBS": NOON, "TIME-OBS": "12:00:01", "UT": ("04:00:00", "written"), "EXPTIME": 2.0},
        {},
        1.0,
    ),
    "a local date and its time of day": (
        {
            "DATE-OBS": ("2026-03-01T21:00:00", "local time"),
            "TIME-OBS": "21:00:00",
            "UTCOFFS": 9,
            "EXPTIME": 2.0,
        },
        {},
        1.0,
    ),
    "a date with TIME-OBS": (
        {"DATE-OBS": "2026-03-01", "TIME-OBS": "12:00:00.5", "EXPTIME": 1.0},
        {},
        1.0,
    ),
    "DATE-OBS of mid exposure": (
        {"DATE-OBS": (NOON, "UTC, middle of exposure"), "EXPTIME": 4.0},
        {},
        0.0,
    ),
    "DATE-OBS of the end": ({"DATE-OBS": (NOON, "end of exposure"), "EXPTIME": 4.0}, {}, -2.0),
    "zone east": ({"DATE-AVG": "2026-03-01T13:00:00+01:00"}, {}, 0.0),
    "zone west without colon": ({"DATE-AVG": "2026-03-01T06:30:00-0530"}, {}, 0.0),
    "Z": ({"DATE-AVG": NOON + ".000Z"}, {}, 0.0),
    "TAI": ({"DATE-AVG": "2026-03-01T12:00:37"}, {"TIMESYS": "TAI"}, 0.0),
    "TT": ({"DATE-AVG": "2026-03-01T12:01:09.184", "TIMESYS": "TT"}, {}, 0.0),
    "TT(BIPM)": ({"DATE-AVG": "2026-03-01T12:01:09.184", "TIMESYS": "TT(BIPM08)"}, {}, 0.0),
    "GPS": ({"DATE-AVG": "2026-03-01T12:00:18", "TIMESYS": "GPS"}, {}, 0.0),
    "an elapsed time in seconds beside milliseconds": (
        {"DATE-OBS": NOON, "EXPTIME": 4000, "EXPUNIT": "ms", "TELAPSE": 4.0},
        {},
        2.0,
    ),
    "an exposure with pauses": (
        {"DATE-OBS": NOON, "XPOSURE": 5.0, "TELAPSE": 10.0, "TIMEUNIT": "s"},
        {},
        5.0,
    ),
    "two exposures with units of their own": (
        {
            "DATE-OBS": NOON,
            "XPOSURE": 4.0 / 86400,
            "TIMEUNIT": "d",
            "EXPTIME": 4.0,
            "EXPUNIT": "[s]",
        },
        {},
        2.0,
    ),
    "a unit that is none of time": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "EXPUNIT": "electron/s"},
        {},
        2.0,
    ),
    "an elapsed time that is not given": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "TELAPSE": 0},
        {},
        2.0,
    ),
    "milliseconds in a card of the unit": (
        {"DATE-OBS": NOON, "EXPTIME": 4000, "EXPUNIT": "ms"},
        {},
        2.0,
    ),
    "milliseconds in words": (
        {"DATE-OBS": NOON, "EXPTIME": (4000, "exposure time in milliseconds")},
        {},
        2.0,
    ),
    "ms at the end of a comment": ({"DATE-OBS": NOON, "EXPTIME": (4000, "integration, ms")}, {}, 2),
    "microseconds in words": (
        {"DATE-OBS": NOON, "EXPTIME": (4e6, "Exposure Time in microseconds")},
        {},
        2.0,
    ),
    "minutes in parentheses": ({"DATE-OBS": NOON, "EXPOSURE": (0.5, "total (min)")}, {}, 15.0),
    "a word in parentheses": ({"DATE-OBS": NOON, "EXPTIME": (4.0, "exposure (total)")}, {}, 2.0),
    "the shutter closes": ({"DATE-OBS": (NOON, "UTC at shutter close"), "EXPTIME": 4.0}, {}, -2.0),
    "the shutter opens": ({"DATE-OBS": (NOON, "shutter opened"), "EXPTIME": 4.0}, {}, 2.0),
    "an MJD of the middle": ({"MJD-OBS": (61100.5, "MJD of mid exposure"), "EXPTIME": 4.0}, {}, 0),
    "local time and its offset": (
        {
            "DATE-OBS": ("2026-03-01T21:00:00", "Local time of start of exposure"),
            "UTCOFFS": 9.0,
            "EXPTIME": 4.0,
        },
        {},
        2.0,
    ),
    "a zone in the comment": (
        {"DATE-OBS": ("2026-03-01T06:30:00", "start, UTC-05:30"), "EXPTIME": 4.0},
        {},
        2.0,
    ),
    "local time beside UTC": (
        {
            "DATE-OBS": ("2026-03-01T21:00:00", "local time"),
            "MJD-OBS": (61100.5, "UTC"),
            "EXPTIME": 4.0,
        },
        {},
        2.0,
    ),
    "milliseconds in a COMMENT": (
        {"DATE-OBS": NOON, "EXPTIME": 4000, "COMMENT": "Exposure times are given in milliseconds"},
        {},
        2.0,
    ),
    "another time in milliseconds": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "HISTORY": "exposure corrected by 30 ms of shutter"},
        {},
        2.0,
    ),
    "a zone in a COMMENT": (
        {
            "DATE-OBS": "2026-03-01T21:00:00",
            "EXPTIME": 4.0,
            "COMMENT": "All times are in local time, UTC+9",
        },
        {},
        2.0,
    ),
    "local in another sense": (
        {"DATE-AVG": NOON, "COMMENT": "flat field of this date; local sky subtracted"},
        {},
        0.0,
    ),
    "UTC and a local sidereal time": (
        {"DATE-AVG": NOON, "COMMENT": "times are in UTC; local sidereal time is in LST"},
        {},
        0.0,
    ),
    "not local": ({"DATE-AVG": NOON, "HISTORY": "DATE-AVG is UTC, not local time"}, {}, 0.0),
    "TAI by the comment": ({"DATE-AVG": ("2026-03-01T12:00:37", "TAI")}, {}, 0.0),
    "UTC of a receiver of GPS": ({"DATE-AVG": (NOON, "UTC from GPS")}, {}, 0.0),
    "MJD in TT": ({"MJD-AVG": 61100.5 + 69.184 / 86400, "TIMESYS": "TT"}, {}, 0.0),
}


@pytest.mark.parametrize("case", TIMES)
def test_the_time_of_mid_exposure_follows_the_standard(case):
    extension, primary, after_noon_s = TIMES[case]
    frame = header_time(extension, primary)
    second = 12 * 3600 + after_noon_s
    hour, minute, second = int(second // 3600), int(second % 3600 // 60), second % 60
    assert frame.time is not None, frame.no_time
    read_s = float(frame.time[17:-1]) + 60 * int(frame.time[14:16]) + 3600 * int(frame.time[11:13])
    assert frame.time.startswith("2026-03-01T")
    assert read_s == pytest.approx(3600 * hour + 60 * minute + second, abs=2e-5)


NO_TIMES = {
    "nothing": ({}, "DATE-AVG, MJD-AVG, DATE-BEG, DATE-OBS"),
    "start alone": ({"DATE-OBS": NOON}, "no exposure (XPOSURE, EXPTIME, EXPOSURE)"),
    "a date without a time of day": ({"DATE-OBS": "2026-03-01", "EXPTIME": 1.0}, "time of day"),
    "local time": ({"DATE-AVG": NOON, "TIMESYS": "LOCAL"}, "TIMESYS is LOCAL"),
    "UT1": ({"DATE-AVG": NOON, "TIMESYS": "UT1"}, "TIMESYS is UT1"),
    "TCB": ({"DATE-AVG": NOON, "TIMESYS": "TCB"}, "TIMESYS is TCB"),
    "two starts": (
        {"DATE-OBS": NOON, "MJD-OBS": 61100.25, "EXPTIME": 1.0},
        "DATE-OBS and MJD-OBS lie",
    ),
    "two exposures": ({"DATE-OBS": NOON, "EXPTIME": 1.0, "EXPOSURE": 100.0}, "contradict"),
    "end before start": ({"DATE-BEG": NOON, "DATE-END": "2026-03-01T11:00:00"}, "apart"),
    "end far from start and exposure": (
        {"DATE-BEG": NOON, "DATE-END": "2026-03-01T12:30:00", "EXPTIME": 10.0},
        "apart",
    ),
    "average outside": (
        {"DATE-AVG": NOON, "DATE-BEG": "2026-03-01T12:30:00", "EXPTIME": 1.0},
        "not between",
    ),
    "a time of day on another day": (
        {"DATE-OBS": NOON, "TIME-OBS": "2026-02-28T12:00:00", "EXPTIME": 2.0},
        "DATE-OBS is 2026-03-01T12:00:00, and TIME-OBS 2026-02-28T12:00:00",
    ),
    "midnight for a date": (
        {"DATE-OBS": "2026-03-01T00:00:00", "UT": "05:04:58.4", "EXPTIME": 2.0},
        "DATE-OBS is 2026-03-01T00:00:00, and UT 05:04:58.4",
    ),
    "average behind start and exposure": (
        # A program may write the computer's clock into one, and the camera's into the other.
        {"DATE-OBS": NOON, "DATE-AVG": "2026-03-01T12:00:05", "EXPTIME": 2.0},
        "not between",
    ),
    "an exposure without a number": ({"DATE-OBS": NOON, "EXPTIME": None}, "no exposure"),
    "local time alone": ({"DATE-LOC": NOON, "EXPTIME": 2.0}, "none of DATE-AVG"),
    "local time by its comment": (
        {"DATE-OBS": (NOON, "Local time of start of exposure"), "EXPTIME": 1.0},
        "DATE-OBS is local time by its comment",
    ),
    "local time by a COMMENT": (
        {"DATE-OBS": NOON, "EXPTIME": 1.0, "COMMENT": "DATE-OBS is local time"},
        "DATE-OBS is local time by its comment (DATE-OBS is local time)",
    ),
    "local time in French": ({"DATE-AVG": (NOON, "heure locale")}, "is local time by its comment"),
    "the time of a zone": ({"DATE-AVG": (NOON, "CEST")}, "is local time by its comment (CEST)"),
    "local time with a Z": ({"DATE-AVG": (NOON + "Z", "local time")}, "UTC by its Z"),
    "local time and UTC": ({"DATE-AVG": (NOON, "UTC or local time")}, "not clearly UTC or local"),
    "local time with an offset in minutes": (
        {"DATE-AVG": (NOON, "local time"), "UTCOFFS": 540},
        "no offset from UTC is known",
    ),
    "an offset of the other sign": (
        {"DATE-AVG": (NOON, "local time"), "UTCOFFS": (-9, "hours to add to local time")},
        "no offset from UTC is known",
    ),
    "the time when the file was written": (
        {"DATE-OBS": (NOON, "when the file was written"), "EXPTIME": 1.0},
        "not clearly start, middle or end",
    ),
    "start and end at once": (
        {"DATE-OBS": (NOON, "start or end of the exposure"), "EXPTIME": 1.0},
        "not clearly start, middle or end",
    ),
    "GPS by the comment": ({"DATE-AVG": (NOON, "GPS time")}, "TIMESYS is not given"),
    "another scale in the comment": (
        {"DATE-AVG": (NOON, "TAI"), "TIMESYS": "UTC"},
        "TIMESYS is UTC, and the comment of DATE-AVG says TAI",
    ),
    "two units in a comment": (
        {"DATE-OBS": NOON, "EXPTIME": (5, "seconds, or ms in the other mode")},
        "its comment says otherwise",
    ),
    "a unit and another one": (
        {"DATE-OBS": NOON, "EXPTIME": ("500 s", "in milliseconds")},
        "EXPTIME is 500 s, and its comment says otherwise: in milliseconds",
    ),
    "a unit of all and another one": (
        {"DATE-OBS": NOON, "XPOSURE": (500, "in ms"), "TIMEUNIT": "s"},
        "its comment says otherwise",
    ),
    "an exposure without a unit beside a unit of times": (
        {"DATE-OBS": NOON, "EXPTIME": 500, "TIMEUNIT": "ms"},
        "EXPTIME is 500 without a unit, and TIMEUNIT is ms",
    ),
    "an elapsed time shorter than the exposure": (
        {"DATE-OBS": NOON, "XPOSURE": 10.0, "TELAPSE": 5.0, "TIMEUNIT": "s"},
        "TELAPSE is 5 s, and the exposure is 10 s",
    ),
    "exposures that a camera added": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "COADDS": 10},
        "it is a stack of 10 exposures (COADDS) without DATE-END",
    ),
    "another time of day at the start": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "UTSTART": "13:00:00.000"},
        "and UTSTART 13:00:00.000",
    ),
    "a unit in a card and another one in the comment": (
        {"DATE-OBS": NOON, "EXPTIME": (500, "[s]"), "EXPUNIT": "ms"},
        "EXPTIME is 500 ms, and its comment says otherwise",
    ),
    "two units of one exposure": (
        {"DATE-OBS": NOON, "EXPTIME": "500 s", "EXPUNIT": "ms"},
        "EXPTIME is 500 s ms: units that contradict each other",
    ),
    "exposures a thousand times apart": (
        {"DATE-OBS": NOON, "XPOSURE": 0.5, "EXPTIME": 500.0},
        "XPOSURE is 0.5 s and EXPTIME 500 s, which contradict each other",
    ),
    "an exposure of more than an hour": (
        {"DATE-OBS": NOON, "EXPTIME": 5000},
        "EXPTIME is 5000 s, which must be above 0 and at most 3600 s",
    ),
    "exposure in furlongs": ({"DATE-OBS": NOON, "EXPTIME": (1.0, "[furlong]")}, "no exposure"),
    "a Julian date of another day": (
        {"DATE-OBS": NOON, "JD": 2461102.0, "EXPTIME": 4.0},
        "JD 2461102.0 is 86400 s later",
    ),
    "a modified Julian date of another day": (
        {"DATE-OBS": NOON, "MJD": 61099.5, "EXPTIME": 4.0},
        "MJD 61099.5 is -86400 s later",
    ),
    "a stack without its end": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "STACKCNT": 30},
        "it is a stack of 30 exposures (STACKCNT) without DATE-END",
    ),
    "the clock of a zone": (
        {"DATE-OBS": NOON, "EXPTIME": 4.0, "LT": "12:00:00", "TIMEZONE": 9},
        "DATE-OBS is 2026-03-01T12:00:00, the local time of LT",
    ),
    "a day that is none": ({"DATE-AVG": "2026-02-30T12:00:00"}, "cannot be read"),
}


@pytest.mark.parametrize("case", NO_TIMES)
def test_a_header_that_tells_no_time_for_certain_is_asked_for_by_what_it_lacks(case):
    cards, word = NO_TIMES[case]
    frame = header_time(cards)
    assert frame.time is None
    with pytest.raises(BadBatch) as refusal:
        time_of(FrameIn(), frame)
    assert word in str(refusal.value)


SOURCES = {
    "an average": ({"DATE-AVG": NOON, "EXPTIME": 2.0}, "DATE-AVG (middle of the exposure)"),
    "a start": (
        {"DATE-OBS": NOON, "EXPTIME": (500, "in milliseconds")},
        "DATE-OBS (start of the exposure) and EXPTIME = 500 in the unit of its comment",
    ),
    "start and end": (
        {"DATE-BEG": NOON, "DATE-END": "2026-03-01T12:00:08"},
        "DATE-BEG (start of the exposure) and DATE-END (end of the exposure)",
    ),
}


@pytest.mark.parametrize("case", SOURCES)
def test_the_keywords_of_time_and_exposure_are_named(case):
    cards, source = SOURCES[case]
    frame = header_time(cards)
    told = f"time_of_file: {frame.time}, mid exposure, from {source}"
    assert frame.remarks[0].startswith(told)
    assert ("EXPTIME" in frame.remarks[-1]) == ("EXPTIME" in cards)


def test_a_time_that_is_not_taken_is_named_on_a_picture():
    frame = header_time({"DATE-OBS": (NOON, "local time"), "EXPTIME": 1.0})
    assert any(remark.startswith("no_time: DATE-OBS is local time") for remark in frame.remarks)
    assert not any("no_time" in remark for remark in header_time({}).remarks)


def test_rows_from_the_bottom_up_are_turned_to_the_way_they_are_shown(values):
    for order, truth in (
        ("BOTTOM-UP", values[::-1]),
        ("bottom_up", values[::-1]),
        ("TOP-DOWN", values),
        ("sideways", values),
    ):
        frame = read(written(image(values, {"ROWORDER": order}, fits.PrimaryHDU)))
        assert np.array_equal(frame.counts, truth)
        assert frame.is_turned == (truth is not values)
    behind = written(
        image(None, {"ROWORDER": "BOTTOM-UP"}, fits.PrimaryHDU),
        image(values),
    )
    assert np.array_equal(read(behind).counts, values[::-1])
    cube = np.stack([values // 4] * 3)
    frame = read(written(image(cube, {"ROWORDER": "BOTTOM-UP"}, fits.PrimaryHDU)))
    assert np.array_equal(frame.counts, cube.sum(axis=0)[::-1])


@pytest.mark.parametrize("kind", ["u1", "i2", "u2", "f4"])
def test_the_planes_of_a_colour_cube_are_summed(rng, kind):
    cube = rng.integers(0, 200, (3, ROWS, COLUMNS)).astype(kind)
    total = cube.astype(np.float64).sum(axis=0)
    for written_as in (cube, np.moveaxis(cube, 0, 2), cube[None]):
        frame = read(written(image(np.ascontiguousarray(written_as), kind=fits.PrimaryHDU)))
        assert np.array_equal(frame.counts, total)
        assert frame.full_scale == (math.inf if kind == "f4" else 3.0 * np.iinfo(kind).max)


def test_of_a_cube_of_frames_one_is_chosen(rng):
    cube = rng.integers(0, 200, (5, ROWS, COLUMNS)).astype("i2")
    data = written(image(cube, kind=fits.PrimaryHDU))
    for number in range(1, 6):
        assert np.array_equal(read(data, image=f":{number}").counts, cube[number - 1])
    for choice, word in ((None, "5 planes"), (":6", "planes 1 to 5"), (":x", "by number")):
        with pytest.raises(BadFile, match=word):
            read(data, image=choice)


def test_of_several_images_the_first_is_taken_or_one_is_chosen(values):
    others = image(values // 2, name="ERR"), image(values // 3, name="DQ")
    data = written(image(None, kind=fits.PrimaryHDU), image(values, name="SCI"), *others)
    first = read(data)
    assert np.array_equal(first.counts, values)
    assert first.remarks == ("image: 1 SCI was taken, the first of 1 SCI, 2 ERR, 3 DQ",)
    for choice, number in (("SCI", 1), ("err", 2), ("3", 3), ("DQ:1", 3)):
        assert np.array_equal(read(data, image=choice).counts, values // number)
    with pytest.raises(BadFile, match="1 SCI, 2 ERR, 3 DQ"):
        read(data, image="WHT")


def test_a_gzipped_file_is_read_in_bounded_memory(values, monkeypatch):
    monkeypatch.setattr(files, "MORE_BYTES", 1 << 20)
    plain = written(image(values, {"DATE-AVG": NOON}, fits.PrimaryHDU))
    frame = read(gzip.compress(plain))
    assert np.array_equal(frame.counts, values)
    assert frame.time == NOON + ".000Z"
    for data, word in (
        (gzip.compress(plain)[:-400], "gzip"),
        (gzip.compress(plain + bytes(4 << 20), 1), "unfolds into more than"),
        (gzip.compress(gzip.compress(plain)), "more than once"),
        (gzip.compress(b"no frame"), "is not FITS"),
    ):
        with pytest.raises(BadFile, match=word):
            read(data)


@pytest.mark.parametrize("method", ["RICE_1", "GZIP_1", "GZIP_2"])
@pytest.mark.parametrize("kind", ["u2", "i2", "i4", "f4"])
def test_an_image_in_compressed_tiles_is_read_as_astropy_reads_it(rng, method, kind):
    stored = rng.integers(0, 200, (ROWS, COLUMNS)).astype(kind)
    cards = {"DATE-OBS": NOON, "EXPTIME": 2.0, "ROWORDER": "BOTTOM-UP"}
    unit = image(stored, cards, fits.CompImageHDU, compression_type=method)
    data = written(image(None, kind=fits.PrimaryHDU), unit)
    with fits.open(io.BytesIO(data)) as opened:
        truth = opened[1].data[::-1]
    frame = read(data)
    assert np.array_equal(frame.counts, truth)
    assert frame.time == "2026-03-01T12:00:01.000Z"
    with pytest.raises(BadFile, match="at most 100 pixels"):
        read_frame(io.BytesIO(data), FrameLimits(max_pixels=100))
    with pytest.raises(BadFile):
        read(data[:-2880])


@pytest.mark.parametrize("method", ["HCOMPRESS_1", "PLIO_1"])
def test_a_method_whose_decoder_is_unsafe_is_refused_by_its_name(rng, method):
    unit = fits.CompImageHDU(rng.integers(0, 200, (32, 32)).astype("i2"), compression_type=method)
    with pytest.raises(BadFile, match=method):
        read(written(image(None, kind=fits.PrimaryHDU), unit))


def test_a_compressed_colour_cube_is_summed(rng):
    cube = rng.integers(0, 200, (3, ROWS, COLUMNS)).astype("i2")
    unit = fits.CompImageHDU(cube, compression_type="RICE_1")
    frame = read(written(image(None, kind=fits.PrimaryHDU), unit))
    assert np.array_equal(frame.counts, cube.sum(axis=0))


def with_card(data, card):
    """A file with one more card in its first header, in place of a blank one behind the last."""
    end = b"END" + b" " * 77
    assert end + b" " * 80 in data
    return data.replace(end + b" " * 80, card.ljust(80) + end, 1)


@pytest.mark.parametrize("key", ["BSCALE", "BZERO"])
def test_a_keyword_without_a_value_counts_as_absent(values, key):
    """FITS Standard 4.0, section 4.1.2.3."""
    pixels = values.astype("f4")
    data = with_card(written(fits.PrimaryHDU(pixels)), f"{key:8}=      / undefined".encode())
    np.testing.assert_array_equal(read(data).counts, pixels)


def test_a_header_moves_no_terminal_s_cursor(values):
    """What a file says is shown in messages, on terminals and in logs."""
    card = b"BSCALE  = '\x1b[31m\x07'"
    with pytest.raises(BadFile, match="impossible BSCALE") as caught:
        read(with_card(written(fits.PrimaryHDU(values.astype("f4"))), card))
    assert str(caught.value).isprintable()
    assert r"\x1b[31m\x07" in str(caught.value)


def test_a_blank_that_the_pixels_cannot_hold_marks_none_of_them(values):
    counts = read(
        written(image(values.astype("i4"), {"BLANK": -(1 << 63)}, fits.PrimaryHDU))
    ).counts
    assert np.array_equal(counts, values)

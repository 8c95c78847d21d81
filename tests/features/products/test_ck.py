"""C-kernels, read by CSPICE."""

import dataclasses
import io
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from service.times import parse_utc
from service.vectors import attitude_matrices
from tests import scale
from tests.features.products.series import (
    ABOUT,
    GOLDEN,
    random_quaternions,
    rows,
    slew,
    whole,
    written,
)

READER = """
import json, sys
import numpy as np, spiceypy as s
asked = json.load(sys.stdin)
s.furnsh("xte.tm")
out = {}
out["found"] = []
for ticks in asked["ticks"]:
    try:
        a, w, at = s.ckgpav(-999000, ticks, 0.0, "J2000")
        out["found"].append([a.tolist(), w.tolist(), at])
    except s.NotFoundError:
        out["found"].append(None)
    except s.stypes.SpiceyError:
        out["found"].append(None)
out["poses"] = [s.ckgp(-999000, t, 0.0, "J2000")[0].tolist() for t in asked["lone"]]
window = s.ckcov("xte.bc", -999000, False, "INTERVAL", 0.0, "SCLK")
out["intervals"] = [list(s.wnfetd(window, k)) for k in range(s.wncard(window))]
out["matrices"] = [s.pxform("J2000", "XTE_BODY", s.str2et(t)).tolist() for t in asked["utc"]]
out["ticks"] = [s.sce2c(-999, s.str2et(t)) for t in asked["utc"]]
json.dump(out, sys.stdout)
"""


@pytest.fixture
def read(tmp_path):
    """What CSPICE finds in a kernel of pages: in a process of its own, as it is global."""

    def read(*pages, ticks=(), utc=(), lone=(), about=ABOUT):
        packed = written("ck", *pages, about=about)
        zipfile.ZipFile(io.BytesIO(packed)).extractall(tmp_path)
        asked = {"ticks": list(ticks), "utc": list(utc), "lone": list(lone)}
        done = subprocess.run(
            [sys.executable, "-c", READER],
            input=json.dumps(asked),
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=False,
        )
        assert not done.returncode, done.stderr[-2000:]
        return json.loads(done.stdout)

    return read


def ticks_of(block):
    """Microseconds of TAI since 1972-01-01, by the definition of the clock."""
    zero = parse_utc("1972-01-01T00:00:00Z").tai_ns - 10 * 10**9
    return ((block.time_ns - zero) // 1000).astype(float)


def test_thirty_degrees_about_z_is_the_rotation_of_the_frame(read):
    found = read(rows([GOLDEN] * 2), utc=["1996-01-10T12:00:00.5"])
    (a,) = np.array(found["matrices"])
    assert a @ [1.0, 0.0, 0.0] == pytest.approx([np.sqrt(0.75), -0.5, 0.0], abs=1e-15)


@pytest.mark.torture
def test_random_attitudes_are_read_at_their_records(read, rng):
    page = rows(random_quaternions(rng, scale.size(100_000, 200)))
    block = whole(page)
    found = read(page, ticks=ticks_of(block))["found"]
    a = np.array([each[0] for each in found])
    assert np.abs(a - attitude_matrices(block.quaternion)).max() < 1e-12


def test_a_slew_is_that_of_the_body_between_records_and_its_rate_is_in_j2000(read):
    rate = np.array([0.4, -0.5, 0.76])
    page = rows(slew(500, rate_deg_per_s=rate))
    found = read(page, ticks=ticks_of(whole(page))[:-1] + 500_000)["found"]
    middles = slew(1_000, step_s=0.5, rate_deg_per_s=rate)[1:-1:2]
    a, w = (np.array([each[k] for each in found]) for k in (0, 1))
    wanted = attitude_matrices(middles)
    assert np.abs(a - wanted).max() < 1e-9
    np.testing.assert_allclose(np.degrees(w), np.einsum("nji,j->ni", wanted, rate), atol=1e-9)


def test_intervals_are_the_stretches_and_nothing_is_found_between(read):
    pages = [
        rows(slew(10)),
        rows(slew(3), "1996-01-10T12:30:00Z"),
        rows([GOLDEN], "1996-01-10T13:00:00Z"),
    ]
    block = whole(*pages)
    ticks = ticks_of(block)
    found = read(*pages, ticks=[ticks[9] + 1e6, ticks[12] + 5e5], lone=[ticks[13]])
    spans = [ticks[a:b] for a, b in ((0, 10), (10, 13), (13, 14))]
    assert found["intervals"] == [[each[0], each[-1]] for each in spans]
    assert found["found"] == [None, None]
    assert np.array(found["poses"][0]) == pytest.approx(
        attitude_matrices(block.quaternion)[13], abs=1e-15
    )


def test_a_leap_second_is_a_second_like_any_other(read):
    page = rows(slew(10), "2016-12-31T23:59:55Z")
    block = whole(page)
    found = read(page, utc=["2016-12-31T23:59:60", "2017-01-01T00:00:00"])
    assert found["ticks"] == pytest.approx(ticks_of(block)[5:7].tolist(), abs=0.5)
    assert (
        np.abs(np.array(found["matrices"]) - attitude_matrices(block.quaternion)[5:7]).max() < 1e-7
    )


def test_a_stretch_longer_than_a_segment_is_one_interval(read, rng):
    page = rows(slew(60_001, step_s=0.1), step_s=0.1)
    block = whole(page)
    ticks = ticks_of(block)
    around = [49_998, 49_999, 50_000]
    found = read(page, ticks=[*ticks[around], *(ticks[around] + 5e4)])
    assert found["intervals"] == [[ticks[0], ticks[-1]]]
    a = np.array([each[0] for each in found["found"]])
    assert np.abs(a[:3] - attitude_matrices(block.quaternion[around])).max() < 1e-12
    middles = slew(120_002, step_s=0.05)[[2 * k + 1 for k in around]]
    assert np.abs(a[3:] - attitude_matrices(middles)).max() < 1e-9


CLOCK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID            = ( @1996-01-01 )
SCLK_DATA_TYPE_999        = ( 1 )
SCLK01_TIME_SYSTEM_999    = ( 1 )
SCLK01_N_FIELDS_999       = ( 2 )
SCLK01_MODULI_999         = ( 4294967296 65536 )
SCLK01_OFFSETS_999        = ( 0 0 )
SCLK01_OUTPUT_DELIM_999   = ( 1 )
SCLK_PARTITION_START_999  = ( 0.0 )
SCLK_PARTITION_END_999    = ( 2.8147497671065E+14 )
SCLK01_COEFFICIENTS_999   = ( 0.0 -189345600.0 1.00000002 )
\\begintext
"""
"""A clock that drifts, in units of 1/65536 s since 1994-01-01 TDB."""


def test_a_mission_s_own_clock_times_the_kernel(read, tmp_path):
    (tmp_path / "own.tsc").write_text(CLOCK)
    about = dataclasses.replace(ABOUT, sclk_kernel=tmp_path / "own.tsc")
    page = rows(slew(100))
    moments = ["1996-01-10T12:00:00.5", "1996-01-10T12:01:38.5"]
    found = read(page, utc=moments, about=about)
    assert (tmp_path / "xte.tsc").read_text() == CLOCK
    ((begin, end),) = found["intervals"]
    assert (end - begin) / 65536 == pytest.approx(99.0 / 1.00000002, abs=1e-5)
    middles = slew(200, step_s=0.5)[[1, 197]]
    assert np.abs(np.array(found["matrices"]) - attitude_matrices(middles)).max() < 1e-8

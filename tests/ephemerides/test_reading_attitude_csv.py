"""Attitudes as CSV: those that the service exports are read again, and files of no format named."""

import gzip

import numpy as np
import pytest

from service.ephemerides import files
from service.ephemerides.files import read_attitudes, read_ephemeris
from service.errors import BadFile
from tests.ephemerides.test_reading_aem import V2
from tests.features.products.series import GOLDEN, random_quaternions, rows, slew, whole, written
from tests.features.products.test_spinners import about_z, off_deg

ROWS = """\
time,q1,q2,q3,qc,rate_x,rate_y,rate_z
1996-01-10T12:00:00.000Z,0,0,0,1,0,0,24
1996-01-10T12:00:10.000Z,{},0,0,24
"""
SPUN = ROWS.format(",".join(map(repr, about_z(240.0).tolist())))


def read(data, tmp_path):
    (tmp_path / "a.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_attitudes(tmp_path / "a.csv", "FILE")


def test_what_the_service_exports_is_read_again(rng, tmp_path):
    pages = [rows(random_quaternions(rng, 400)), rows(slew(30), "2018-01-10T12:00:00Z")]
    pages.append(rows([GOLDEN], "2019-01-10T12:00:00Z"))
    known, wanted = read(written("csv", *pages), tmp_path), whole(*pages)
    assert (len(known.segments), len(known)) == (3, len(wanted))
    np.testing.assert_allclose(known.at(wanted.time_ns), wanted.quaternion, rtol=0, atol=3e-16)


@pytest.mark.parametrize("status", [False, True])
def test_a_file_appended_to_itself_is_refused_with_that_reason(tmp_path, status):
    """A header is no row that is not good."""
    lines = SPUN.splitlines()
    if status:
        lines = [
            f"{line},{'status' if number == 0 else 'good'}" for number, line in enumerate(lines)
        ]
    with pytest.raises(BadFile, match=r"line 4: row: repeats the header"):
        read("\n".join(lines * 2), tmp_path)


def test_rates_of_a_row_tell_how_often_the_body_turned(tmp_path):
    """24 deg/s and ten seconds: the shorter way would be 120 degrees, the other way round."""
    known = read(SPUN, tmp_path)
    (segment,) = known.segments
    middle = known.at(segment.time_ns[:1] + 5 * 10**9)[0]
    assert off_deg(middle, about_z(120.0)) < 1e-6
    without = read(SPUN.replace(",rate_", ",other_"), tmp_path)
    assert np.isnan(without.at(segment.time_ns[:1] + 5 * 10**9)).all()


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (-0.5, "in 6 of 6 steps, and do if they are of the opposite sign"),
        (0.5 * np.pi / 180.0, "in 6 of 6 steps, and do if they are in rad/s"),
        (0.5, None),
        # Rates that fit in no way are left to the interpolation.
        (2.0, None),
    ],
)
def test_rates_that_lead_elsewhere_than_the_attitudes_are_refused(rate, words, tmp_path):
    """Half a degree a second and ten seconds: neither way round is in doubt."""
    text = rows_of(5.0 * np.arange(7), rate)
    if words is None:
        assert len(read(text, tmp_path)) == 7
        return
    with pytest.raises(BadFile, match=f"line 2, rates: do not lead from one .* {words}"):
        read(text, tmp_path)


def rows_of(angles_deg, rate):
    """CSV rows each ten seconds, turned about z, with one rate in deg/s."""
    cells = [
        f"1996-01-10T12:{k // 6:02d}:{10 * k % 60:02d}Z,"
        + ",".join(map(repr, (*about_z(angle).tolist(), 0.0, 0.0, float(rate))))
        for k, angle in enumerate(angles_deg)
    ]
    return "\n".join([ROWS.splitlines()[0], *cells])


def test_attitudes_that_stand_still_while_the_rates_turn_are_refused(tmp_path):
    with pytest.raises(BadFile, match="record 4: repeats the attitude before it"):
        read(rows_of([0.0, 5.0, 10.0, 10.0, 20.0, 25.0, 30.0], 0.5), tmp_path)
    with pytest.raises(BadFile, match="record 2: repeats the attitude before it"):
        read(rows_of([30.0] * 7, 0.5), tmp_path)
    assert len(read(rows_of([30.0] * 7, 0.0), tmp_path)) == 7


def test_a_frozen_attitude_is_found_over_small_steps_and_a_biased_gyro_is_not_one(tmp_path):
    """At ten records a second and 0.4 deg/s no step is large; a bias of 0.005 deg/s adds up."""

    def rows_at(angles_deg, rate, step_s):
        cells = (
            f"1996-01-10T12:{int(k * step_s) // 60:02d}:{k * step_s % 60:06.3f}Z,"
            + ",".join(map(repr, (*about_z(angle).tolist(), 0.0, 0.0, float(rate))))
            for k, angle in enumerate(angles_deg)
        )
        return "\n".join([ROWS.splitlines()[0], *cells])

    turning = 0.04 * np.arange(600)
    assert len(read(rows_at(turning, 0.4, 0.1), tmp_path)) == 600
    frozen = np.where(turning < 8.0, turning, 8.0)
    with pytest.raises(BadFile, match="record 202: repeats the attitude before it"):
        read(rows_at(frozen, 0.4, 0.1), tmp_path)
    assert len(read(rows_at([30.0] * 600, 0.005, 1.0), tmp_path)) == 600
    rng = np.random.default_rng(5)
    for noise, step_s in ((0.05, 1.0), (0.003, 10.0), (0.001, 60.0)):
        text = rows_at([30.0] * 50, 0.0, step_s)
        noisy = [f"{line[:-3]}{noise * rng.standard_normal()}" for line in text.splitlines()[1:]]
        assert len(read("\n".join([text.splitlines()[0], *noisy]), tmp_path)) == 50


def test_rows_that_are_there_twice_are_refused_by_name(tmp_path):
    text = rows_of(5.0 * np.arange(7), 0.5)
    head, *body = text.splitlines()
    with pytest.raises(BadFile, match="repeats line 2: the file was appended to itself"):
        read("\n".join([text, *body]), tmp_path)
    with pytest.raises(BadFile, match="line 4: time: repeats the row before it"):
        read("\n".join([head, body[0], body[1], *body[1:]]), tmp_path)
    with pytest.raises(BadFile, match="must be later than that of the row before"):
        read("\n".join([text, body[3]]), tmp_path)


def test_the_identity_is_an_attitude_where_the_rates_lead_there(tmp_path):
    """Half a turn a step: every second record is the identity."""
    known = read(rows_of([0.0, 180.0, 360.0, 180.0, 0.0, 180.0], 18.0), tmp_path)
    start = known.segments[0].time_ns[:1]
    assert off_deg(known.at(start + 5 * 10**9)[0], about_z(90.0)) < 1e-6


@pytest.mark.parametrize("text", [SPUN, V2], ids=["csv", "aem"])
def test_files_packed_with_gzip_are_read(text, tmp_path):
    plain, packed = (read(each, tmp_path) for each in (text, gzip.compress(text.encode())))
    assert plain.segments[0].quaternion.tobytes() == packed.segments[0].quaternion.tobytes()
    with pytest.raises(BadFile, match="is damaged gzip"):
        read(gzip.compress(text.encode())[:-12], tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("qc", "q4", "line 1: column qc: must be there once"),
        ("rate_y", "y", "line 1: column rate_y: must be there beside other rates"),
        ("time", "utc", "line 1: column time: must be there once"),
        ("0,0,0,1", "0,0,0,2", "line 2: quaternion: must have norm 1"),
        ("0,0,0,1", "0,0,x,1", "line 2: column q3: must be a number"),
        ("0,0,0,1", "0,0,0,1,1", "line 2: row: must have 8 cells"),
        ("12:00:10", "12:00:00", "line 3: time: must be later"),
        ("12:00:10", "24:00:10", "line 3: time: "),
    ],
)
def test_a_bad_row_is_refused_by_file_line_and_column(old, new, words, tmp_path):
    with pytest.raises(BadFile, match=rf"a.csv, {words}"):
        read(SPUN.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize(
    ("column", "cells", "words"),
    [
        ("spacecraft", "AB", "line 3: column spacecraft: must be A, as above"),
        ("run", ("live", "r2"), "line 3: column run: must be live, as above"),
        ("frame", ("ITRF",) * 2, "line 2: column frame: must be EME2000 or J2000"),
        ("direction", ("body to inertial",) * 2, "line 2: column direction: must be INERTIAL_TO"),
        ("time_system", ("GPS",) * 2, "line 2: column time_system: must be UTC"),
    ],
)
def test_a_column_that_says_that_attitudes_are_others_is_read(column, cells, words, tmp_path):
    """Rows of two spacecraft, or of an Earth-fixed frame, were one inertial series."""
    head, *lines = SPUN.splitlines()
    told = [f"{line},{cell}" for line, cell in zip(lines, cells, strict=True)]
    with pytest.raises(BadFile, match=rf"a.csv, {words}"):
        read("\n".join([f"{head},{column}", *told]), tmp_path)
    same = [f"{line},{'EME2000' if column == 'frame' else ''}" for line in lines]
    assert len(read("\n".join([f"{head},{column}", *same]), tmp_path)) == 2


@pytest.mark.parametrize("name", ["rate_x_rad_per_s", "omega_x", "w_x", "body_rate_x_arcsec_s"])
def test_rates_in_columns_of_other_names_are_refused(name, tmp_path):
    x, y, z = (name.replace("x", axis, 1) for axis in "xyz")
    with pytest.raises(BadFile, match=rf"a.csv, line 1: column {x}: is no column of rates"):
        read(SPUN.replace("rate_x,rate_y,rate_z", f"{x},{y},{z}"), tmp_path)


@pytest.mark.parametrize("fill", [[0], [2], [1, 2], [4]])
def test_an_identity_that_stands_for_no_attitude_is_refused(fill, tmp_path):
    def line(second, angle_deg):
        cells = ",".join(map(repr, about_z(angle_deg).tolist()))
        return f"1996-01-10T12:00:0{second}Z,{cells}"

    slow = [line(k, 30.0 + 0.1 * k) for k in range(5)]
    assert len(read("\n".join(["time,q1,q2,q3,qc", *slow]), tmp_path)) == 5
    filled = [line(k, 0.0) if k in fill else slow[k] for k in range(5)]
    with pytest.raises(BadFile, match=rf"record {fill[0] + 1}: is the identity, \S+ degrees from"):
        read("\n".join(["time,q1,q2,q3,qc", *filled]), tmp_path)
    through = [line(k, 20.0 * (k - 2)) for k in range(5)]
    assert len(read("\n".join(["time,q1,q2,q3,qc", *through]), tmp_path)) == 5


def test_a_truth_of_two_spacecraft_is_refused(tmp_path):
    line = '{{"spacecraft": "{}", "time": "1996-01-10T12:00:0{}Z", "quaternion": [0, 0, 0, 1]}}'
    with pytest.raises(BadFile, match=r"line 2, spacecraft: must be A, as above.*got 'B'"):
        read(f"{line.format('A', 0)}\n{line.format('B', 1)}\n", tmp_path)


@pytest.mark.parametrize(
    "data",
    [
        b"SIMPLE  =                    T / conforms to FITS standard".ljust(2880),
        b"PAR1" + bytes(40),
        b'[{"time": "1996-01-10T12:00:00Z", "quaternion": [0, 0, 0, 1]}]',
        b"Type OrientationsGalactic\nOG 1835487300.0 68.4 44.6 158.4 22.6\n",
    ],
)
def test_a_file_of_no_format_that_is_read_is_told_those_that_are(data, tmp_path):
    with pytest.raises(BadFile, match=r"a.csv, line 1.*of no format that is read here.*AEM or ACM"):
        read(data, tmp_path)


def test_an_orbit_in_fits_is_told_the_formats_of_orbits(tmp_path):
    (tmp_path / "x").write_bytes(b"SIMPLE  =".ljust(2880))
    with pytest.raises(BadFile, match=r"x, line 1.*OEM .*OMM .*and TLE"):
        read_ephemeris(tmp_path / "x", "--ephemeris")


def test_without_a_column_of_stretches_a_step_of_more_than_ten_minutes_is_a_gap(tmp_path):
    times = ["00:00:00", "00:10:00", "00:20:00.001", "12:00:00"]
    told = [f"1996-01-10T{each}Z,0,0,0,1" for each in times]
    known = read("\n".join(["time,q1,q2,q3,qc", *told]), tmp_path)
    assert [len(each.time_ns) for each in known.segments] == [2, 1, 1]
    first_ns = known.segments[0].time_ns[0]
    seconds = np.array([300.0, 900.0, 20_000.0])
    told = np.isfinite(known.at(first_ns + (seconds * 1e9).astype(np.int64))).all(axis=1)
    assert told.tolist() == [True, False, False]
    whole = ["time,q1,q2,q3,qc,stretch", *(f"1996-01-10T{each}Z,0,0,0,1,1" for each in times)]
    assert len(read("\n".join(whole), tmp_path).segments) == 1


def test_a_header_in_capitals_is_read(tmp_path):
    head, rest = SPUN.split("\n", 1)
    known = read(f"{head.upper()}\n{rest}", tmp_path)
    assert (
        known.segments[0].rate_rad_s.tobytes()
        == read(SPUN, tmp_path).segments[0].rate_rad_s.tobytes()
    )


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_aem_with_comments_before_its_version_is_read(end, tmp_path):
    text = f"COMMENT made by hand\nCOMMENT\n\n{V2}".replace("\n", end)
    assert len(read(text.encode(), tmp_path)) == 2


TRUTH = '{"spacecraft":"XTE","time":"1996-01-10T12:00:0%dZ","quaternion":[0,0,0,1]}\n'


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b'{"a":' + b"[" * 100_000, "line 1: is no truth"),
        (gzip.compress(b"{" + b" " * (2 << 20)), "line 1: must have at most 1048576 bytes"),
        ("".join(TRUTH % k for k in range(4)), "line 4: is more than the 3 lines"),
    ],
    ids=["deep", "long", "many"],
)
def test_a_truth_beyond_what_is_read_is_refused_by_line(data, words, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_RECORDS", 3)
    with pytest.raises(BadFile, match=words):
        read(data, tmp_path)
    assert len(read("".join(TRUTH % k for k in range(3)), tmp_path)) == 3

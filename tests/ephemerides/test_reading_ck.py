"""C-kernels, those of the service and those that CSPICE writes, read as attitudes."""

import io
import json
import random
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from service.ephemerides.files import read_attitudes
from service.errors import BadFile, BadInput
from tests import scale
from tests.features.products.series import GOLDEN, random_quaternions, rows, slew, whole, written
from tests.mutations import mutated

PAGES = [rows(slew(10)), rows(slew(3), "1996-01-10T12:30:00Z")]
"""Attitudes in two stretches."""


def unpacked(place, *pages):
    zipfile.ZipFile(io.BytesIO(written("ck", *pages))).extractall(place)
    return place / "xte.bc"


def apart(known, block):
    found = known.at(block.time_ns)
    sign = np.sign(np.sum(found * block.quaternion, axis=1))[:, None]
    return np.abs(found * sign - block.quaternion).max()


@pytest.mark.parametrize("as_zip", [pytest.param(True, marks=pytest.mark.slow), False])
def test_every_record_that_the_service_wrote_is_read_again(as_zip, rng, tmp_path):
    pages = [
        rows(random_quaternions(rng, 1_000), "2016-12-31T23:50:00.5Z"),
        rows(slew(60_001, step_s=0.1), "2018-01-10T12:00:00Z", step_s=0.1),
        rows([GOLDEN], "2019-01-10T12:00:00Z"),
    ]
    file = unpacked(tmp_path, *pages)
    if as_zip:
        file = tmp_path / "all.zip"
        file.write_bytes(written("ck", *pages))
    known, block = read_attitudes(file, "FILE"), whole(*pages)
    assert apart(known, block) < 1e-12
    assert known.object_name == "-999"


def test_intervals_are_segments_and_nothing_is_found_between(tmp_path):
    known = read_attitudes(unpacked(tmp_path, *PAGES), "FILE")
    assert [len(each.time_ns) for each in known.segments] == [10, 3]
    times = whole(*PAGES).time_ns
    assert np.isnan(known.at(times[[9, 12]] + 5 * 10**8)).all()
    assert not np.isnan(known.at(times[[0, 8, 10]] + 5 * 10**8)).any()


def test_between_records_the_attitude_is_that_of_spice(tmp_path):
    """`ckgp` interpolates as the service does: at a constant rate."""
    known = read_attitudes(unpacked(tmp_path, *PAGES), "FILE")
    block = whole(*PAGES)
    program = (
        "import spiceypy as s, json; s.furnsh('xte.tm'); "
        "et = s.str2et('1996-01-10T12:00:03.25'); "
        "print(json.dumps(s.m2q(s.pxform('J2000', 'XTE_BODY', et)).tolist()))"
    )
    told = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, check=True, text=True
    )
    scalar, *vector = np.array(json.loads(told.stdout))
    theirs = np.array([*(-np.array(vector)), scalar])
    (ours,) = known.at(block.time_ns[[3]] + 250_000_000)
    assert abs(ours @ theirs) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(ours * np.sign(ours @ theirs) - theirs).max() < 1e-8


WRITER = """
import sys, numpy as np, spiceypy as s
kind, rates, frame = sys.argv[1], sys.argv[2] == "yes", sys.argv[3]
h = s.ckopn("x.bc", "x", 0)
t = np.arange(1, 6) * 1e6 + 7.6e14
q = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)) * (0.9 if sys.argv[4] == "short" else 1.0)
w = np.zeros((5, 3))
if kind == "3":
    s.ckw03(h, t[0], t[-1], -999000, frame, rates, "x", 5, t, q, w, 1, t[:1])
elif kind == "2":
    s.ckw02(h, t[0], t[-1] + 1e6, -999000, frame, "x", 5, t, t + 1e6, q, w, np.ones(5))
else:
    s.ckw01(h, t[0], t[-1], -999000, frame, rates, "x", 5, t, q, w)
if sys.argv[4] == "several":
    s.ckw03(h, t[0], t[-1], -998000, frame, rates, "x", 5, t, q, w, 1, t[:1])
s.ckcls(h)
"""


@pytest.fixture
def spice_wrote(tmp_path):
    """A kernel that CSPICE wrote, with the service's clock beside it."""

    def write(kind="3", rates="yes", frame="J2000", other=""):
        unpacked(tmp_path, *PAGES)
        (tmp_path / "xte.bc").unlink()
        command = [sys.executable, "-c", WRITER, kind, rates, frame, other]
        subprocess.run(command, cwd=tmp_path, check=True)
        return tmp_path / "x.bc"

    return write


@pytest.mark.parametrize("rates", [pytest.param("yes", marks=pytest.mark.slow), "no"])
def test_a_kernel_without_rates_is_read_like_one_with_them(spice_wrote, rates):
    known = read_attitudes(spice_wrote(rates=rates), "FILE")
    assert len(known) == 5
    assert known.segments[0].quaternion[4].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"kind": "2"}, "x.bc: has a segment of type 2; types 1 and 3 are read"),
        ({"frame": "ITRF93"}, "x.bc: refers to frame ITRF93; inertial frames of SPICE are read"),
        ({"other": "short"}, "x.bc, record 1: quaternion: must have norm 1 within 0.001"),
        ({"other": "several"}, "x.bc: orients several structures: -999000, -998000; choose one"),
    ],
)
def test_a_kernel_that_is_not_read_is_refused_by_name(spice_wrote, told, words):
    with pytest.raises(BadFile) as refusal:
        read_attitudes(spice_wrote(**told), "FILE")
    assert words in str(refusal.value)


def test_of_several_structures_one_is_chosen(spice_wrote):
    """`divmod` of a negative id of an instrument gave the next spacecraft."""
    file = spice_wrote(other="several")
    known = read_attitudes(file, "FILE", "-999000")
    assert (known.object_name, len(known)) == ("-999", 5)
    with pytest.raises(BadFile, match="orients -999000, -998000, not -82000"):
        read_attitudes(file, "FILE", "-82000")
    with pytest.raises(BadInput, match=r"--object: must be the NAIF id .* \(got 'CASSINI'\)"):
        read_attitudes(file, "FILE", "CASSINI")


def test_a_kernel_without_its_clock_is_refused_with_what_it_needs(tmp_path):
    file = unpacked(tmp_path, *PAGES)
    (tmp_path / "xte.tsc").unlink()
    with pytest.raises(BadFile, match=r"xte\.bc: needs the clock of spacecraft -999.*\.tsc"):
        read_attitudes(file, "FILE")


def test_a_kernel_that_was_cut_short_is_refused(tmp_path):
    file = unpacked(tmp_path, *PAGES)
    for size in (8, 900, 1024, 2000, 3000) if scale.is_full() else (900, 3000):
        file.write_bytes(file.read_bytes()[:size])
        with pytest.raises(BadFile, match=r"xte\.bc: "):
            read_attitudes(file, "FILE")
        file.unlink()
        unpacked(tmp_path, *PAGES)


@pytest.mark.torture
@pytest.mark.parametrize("form", ["bc", "tsc", "zip"])
def test_a_mutated_kernel_is_read_or_refused(form, seed, tmp_path):
    """Fewer than of other readers: CSPICE needs a process a file."""
    unpacked(tmp_path, *PAGES)
    changed = tmp_path / f"xte.{form}"
    good = written("ck", *PAGES) if form == "zip" else changed.read_bytes()
    draw = random.Random(seed)
    refused, count = 0, scale.size(1_000)
    for _ in range(count):
        changed.write_bytes(mutated(good, draw))
        try:
            read_attitudes(changed if form == "zip" else tmp_path / "xte.bc", "FILE")
        except BadInput:
            refused += 1
    # One that was changed may be read.
    assert refused or count == 1


@pytest.mark.parametrize("record", [b"PK\x01\x02", b"PK\x03\x04"])
def test_a_zip_file_with_a_name_that_is_no_utf_8_is_refused(record, tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as packed:
        packed.writestr("é.bc", b"DAF/CK")
    data = bytearray((tmp_path / "x.zip").read_bytes())
    data[data.index("é".encode(), data.index(record))] = 0xFF
    (tmp_path / "x.zip").write_bytes(data)
    with pytest.raises(BadFile, match=r"x\.zip: cannot be unpacked"):
        read_attitudes(tmp_path / "x.zip", "FILE")


def test_a_zip_file_without_a_kernel_and_a_file_that_is_not_there_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as packed:
        packed.writestr("../a.tsc", "KPL/SCLK")
    with pytest.raises(BadFile, match=r"x\.zip: must hold one C-kernel \(\.bc\), not 0"):
        read_attitudes(tmp_path / "x.zip", "FILE")
    with pytest.raises(BadInput, match="--a-priori: cannot be read: No such file"):
        read_attitudes(tmp_path / "nowhere.bc", "--a-priori")


SEVERAL = """
import json, sys, numpy as np, spiceypy as s
s.furnsh("xte.tsc"); s.furnsh("xte.tls")
def segment(kind, first, n, frame, axis, rates):
    t = (first + np.arange(n)) * 1e6 + 7.6e14
    angle = np.radians(7.0 * np.arange(n) + 10.0 * first) / 2
    unit = np.array(axis) / np.linalg.norm(axis)
    q = np.column_stack([np.cos(angle), np.sin(angle)[:, None] * unit])
    w = np.tile(-np.radians(7.0) * unit, (n, 1))
    if kind == 3:
        s.ckw03(h, t[0], t[-1], -999000, frame, rates, "x", n, t, q, w, 2, t[[0, n // 2]])
    else:
        s.ckw01(h, t[0], t[-1], -999000, frame, rates, "x", n, t, q, w)
h = s.ckopn("x.bc", "x", 0)
for each in json.loads(sys.argv[1]):
    segment(*each)
s.ckcls(h)
s.furnsh("x.bc")
found = []
for t in np.array(json.loads(sys.argv[2])) * 1e6 + 7.6e14:
    # A discrete record is met to a millisecond.
    try:
        matrix, _ = s.ckgp(-999000, t, 1e3, "J2000")
        found.append(s.m2q(matrix).tolist())
    except s.NotFoundError:
        found.append(None)
print(json.dumps(found))
"""


@pytest.mark.parametrize(
    "segments",
    [
        [[1, 0, 8, "J2000", [0, 0, 1], False]],
        [[3, 0, 8, "ECLIPJ2000", [1, 2, 3], True]],
        [[3, 0, 8, "B1950", [1, 2, 3], False], [3, 10, 4, "GALACTIC", [1, 0, 3], True]],
        # The later of two segments has priority; between its intervals the earlier one holds.
        [[3, 0, 12, "J2000", [0, 0, 1], True], [3, 4, 4, "J2000", [0, 1, 1], True]],
        [[3, 4, 4, "J2000", [0, 1, 1], False], [3, 0, 12, "ECLIPJ2000", [0, 0, 1], False]],
        [[3, 0, 12, "J2000", [0, 0, 1], True], [1, 3, 4, "ECLIPJ2000", [0, 1, 1], True]],
        [
            [3, 0, 6, "J2000", [0, 0, 1], True],
            [3, 3, 8, "J2000", [0, 1, 1], True],
            [1, 20, 3, "J2000", [1, 1, 1], True],
        ],
    ],
)
def test_types_frames_and_overlaps_are_read_as_spice_reads_them(segments, tmp_path):
    """Of type 1 the records, in any inertial frame; of segments that overlap the later one."""
    unpacked(tmp_path, *PAGES)
    (tmp_path / "xte.bc").unlink()
    seconds = np.arange(-1.0, 25.0, 0.25)
    told = subprocess.run(
        [sys.executable, "-c", SEVERAL, json.dumps(segments), json.dumps(seconds.tolist())],
        cwd=tmp_path,
        capture_output=True,
        check=True,
        text=True,
    )
    theirs = json.loads(told.stdout)
    known = read_attitudes(tmp_path / "x.bc", "FILE")
    # The service's clock counts microseconds of TAI since 1972-01-01.
    ours = known.at(np.round((seconds + 7.6e8 - 883_656_000) * 1e9).astype(np.int64))
    for second, found, wanted in zip(seconds, ours, theirs, strict=True):
        assert np.isnan(found[0]) == (wanted is None), second
        if wanted is not None:
            scalar, *vector = wanted
            assert abs(found @ [*(-np.array(vector)), scalar]) == pytest.approx(1.0, abs=1e-12), (
                second
            )


def test_records_of_a_spinner_in_a_kernel_are_joined_by_its_rates(tmp_path):
    """CSPICE takes the shorter way between records; their rates say that it is the longer one."""
    unpacked(tmp_path, *PAGES)
    (tmp_path / "xte.bc").unlink()
    program = SEVERAL.replace("7.0", "240.0")
    command = [sys.executable, "-c", program, '[[3, 0, 8, "J2000", [0, 0, 1], true]]', "[]"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    known = read_attitudes(tmp_path / "x.bc", "FILE")
    moments = np.round((np.array([0.0, 0.5, 1.25]) + 7.6e8 - 883_656_000) * 1e9).astype(np.int64)
    half = np.radians(-240.0 * np.array([0.0, 0.5, 1.25])) / 2
    wanted = np.column_stack([0 * half, 0 * half, np.sin(half), np.cos(half)])
    assert np.abs(np.abs(np.sum(known.at(moments) * wanted, axis=1)) - 1.0).max() < 1e-12

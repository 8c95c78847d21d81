"""The registry of input formats: telemetry files, and files with attitudes or orbits for batches.

`acquire replay` and uploads choose a telemetry format by its suffixes and media types. A feature,
or another package, adds formats by a module `formats` with a mapping `INPUT_FORMATS`
(`service.feature`).
"""

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import BinaryIO

from service.errors import BadInput, Fault, shown_value
from service.feature import SETTING, feature_modules
from service.observations import csv_rows
from service.observations.csv_table import SEPARATORS, CsvTable
from service.observations.decompress import Line, physical_lines
from service.observations.gyro_rows import GYRO_ROWS, BlockRows

NDJSON, CSV = "ndjson", "csv"
"""Names of the two built-in telemetry formats; NDJSON is taken for unknown suffixes."""


def _is_this(start: bytes) -> str | None:
    return None


@dataclass(frozen=True)
class InputFormat:
    """A format of input files that `acquire replay` reads.

    `given` is the command line argument for such a file. A telemetry format has `read`, which
    yields the batches and gyro blocks of a seekable stream as lines of JSON; other formats are read
    by their options. `refusal` recognises other kinds of files by their first bytes and returns
    None for this format. In a format with `one_a_line` the lines of a file can be counted, and the
    body of an upload may be compressed. A format that `is_text` may also come as UTF-16. `notes` is
    text for users; `uploaded` describes an upload in `openapi.yaml`.
    """

    title: str
    holds: str
    given: str
    notes: str
    example: str = ""
    suffixes: tuple[str, ...] = ()
    media_types: tuple[str, ...] = ()
    read: Callable[[BinaryIO], Iterator[Line]] | None = None
    refusal: Callable[[bytes], str | None] = _is_this
    one_a_line: bool = False
    is_text: bool = True
    uploaded: str = ""


def input_formats(off: str | None = None) -> dict[str, InputFormat]:
    """The input formats by name: the built-in ones, then those added by features.

    `off` names disabled features; None for those of the environment.
    """
    brought = feature_modules("formats", os.environ.get(SETTING, "") if off is None else off)
    return {**INPUT_FORMATS, **{k: v for each in brought for k, v in each.INPUT_FORMATS.items()}}


def telemetry_formats() -> dict[str, InputFormat]:
    """The input formats whose files hold batches or gyro blocks, one line of JSON each."""
    return {name: each for name, each in input_formats().items() if each.read is not None}


def telemetry_format(path: Path) -> str:
    """The name of a file's telemetry format by its suffix; NDJSON for an unknown suffix."""
    suffix = path.suffix.lower()
    named = (name for name, each in telemetry_formats().items() if suffix in each.suffixes)
    return next(named, NDJSON)


def input_format(name: str) -> InputFormat:
    """The input format with a given name; raises `BadInput` naming all formats."""
    formats = input_formats()
    if name not in formats:
        message = f"must be one of {', '.join(formats)}"
        raise BadInput(Fault("--formats", message, shown_value(name)))
    return formats[name]


def _read_csv(stream: BinaryIO) -> Iterator[Line]:
    table = CsvTable(stream, (csv_rows.BATCH_ROWS, GYRO_ROWS))
    kind = BlockRows if table.kind is GYRO_ROWS else csv_rows.BatchRows
    yield from csv_rows.joined_lines(table.rows(), kind)


def _not_csv(start: bytes) -> str | None:
    is_object = start.lstrip().startswith(b"{")
    return "is no CSV but looks like NDJSON: name it .ndjson" if is_object else None


def _not_ndjson(start: bytes) -> str | None:
    lines = [line.strip() for line in start.split(b"\n") if line.strip()][:20]
    if lines[0] == b"{" or lines[0].startswith(b"["):
        return "is JSON, but not NDJSON, which has one batch a line and nothing around them"
    if any(line.startswith(b"{") for line in lines):
        return None
    names = re.split('[{}"]+'.format("".join(SEPARATORS)), lines[0].decode("utf-8", "replace"))
    if len({name.strip().lower() for name in names} & {*csv_rows.COLUMNS, *GYRO_ROWS.columns}) > 1:
        return "is no NDJSON but looks like CSV: name it .csv"
    return "is no NDJSON, which has one batch a line as a JSON object"


CSV_COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("spacecraft", "", "the name of the mission; required"),
    ("batch", "", "the name of the batch, in each of its rows; required"),
    ("run", "", "the run that takes the batch; `acquire replay` names its own"),
    (
        "time",
        "UTC",
        "of the batch, such as 1996-01-10T12:54:30.250Z or 1996-010T12:54:30Z; required",
    ),
    ("frame", "", "of the a priori or measured attitude: EME2000 (default), ICRF or GCRF"),
    ("aberration", "", "to_correct (default), applied_upstream or ignore"),
    ("options", "JSON", 'options of the batch, such as {"identifier": "starid"}'),
    ("q1 q2 q3 qc", "", "a priori attitude: a quaternion, inertial to body, scalar last"),
    ("boresight_ra_deg boresight_dec_deg", "deg", "or the direction of the spacecraft's boresight"),
    ("sun_pointed", "true, false", "or: the body axis of the band points at the Sun"),
    ("sun_counts", "counts", "of a sun tracker, with spaces between; with sun_pointed"),
    ("a_priori_from", "last", "or the attitude that the service predicts from the last good one"),
    ("rate_x_deg_per_s rate_y_deg_per_s rate_z_deg_per_s", "deg/s", "rates about the body axes"),
    ("velocity_x_km_per_s velocity_y_km_per_s velocity_z_km_per_s", "km/s", "geocentric, EME2000"),
    ("position_x_km position_y_km position_z_km", "km", "geocentric, EME2000"),
    ("sun_vector_x sun_vector_y sun_vector_z", "", "direction of the Sun, EME2000"),
    ("tracker", "", "the mission's tracker that saw the star; required"),
    ("x y z", "", "direction of the star in tracker axes, +Z the boresight"),
    ("h_deg v_deg", "deg", "or its angles from the boresight: along X, along Y"),
    ("magnitude", "mag", "as the tracker measured it"),
    ("time_offset_s", "s", "of the star, after the time of the batch"),
    ("sigma_arcsec", "arcsec", "one sigma of the position; default: that of the tracker"),
    ("h_counts v_counts", "counts", "of a scanning tracker, with spaces between"),
    ("h_times v_times", "s", "of a scanning tracker, with spaces between"),
    ("column_counts row_counts", "counts", "of a raster, in a row by themselves"),
    (
        "measured_q1 measured_q2 measured_q3 measured_qc",
        "",
        "in place of stars: the attitude that the tracker measured itself",
    ),
    (
        "measured_sigma_x_arcsec measured_sigma_y_arcsec measured_sigma_z_arcsec",
        "arcsec",
        "its sigmas about the same axes, or",
    ),
    (
        (
            "measured_p11_arcsec2 measured_p12_arcsec2 measured_p13_arcsec2 "
            "measured_p22_arcsec2 measured_p23_arcsec2 measured_p33_arcsec2"
        ),
        "arcsec2",
        "its covariance, by rows",
    ),
)
"""The CSV columns of batches, in groups that belong together, with unit and meaning."""

_CSV_NOTES = """\
A header, then one star a row; the rows with the same spacecraft, run and batch form a batch, in
whatever order they are.  Cells may be empty.  Required are spacecraft, batch, time, tracker, and
of each star x y z, or h_deg v_deg, or the counts or times of a scan; or a measured attitude.
Read are commas, semicolons, tabs or bars between cells, decimal commas where the cells are not
between commas, a first line sep=;, comments with # before the header, UTF-8 and UTF-16, any line
end, exponents with D, and headers in capital letters.
Gyro blocks have one sample a row: spacecraft, block, time, rate_1_rad_per_s, rate_2_rad_per_s,
rate_3_rad_per_s (about the axes of the mission's gyro), and optionally run.

Columns of batches:
"""


def _columns_text() -> str:
    rows = (
        f"{names}{f' [{unit}]' if unit else ''}: {meaning}" for names, unit, meaning in CSV_COLUMNS
    )
    return "\n".join(fill(row, 96, initial_indent="  ", subsequent_indent="      ") for row in rows)


_NDJSON_EXAMPLE = """\
{"spacecraft": "XTE", "batch": "1996-010-0110", "time": "1996-01-10T12:54:30.000Z", "a_priori": \
{"quaternion": [0.6330424085, -0.333721514, 0.5945872171, 0.3665423597]}, "velocity_km_per_s": \
[-6.3298, 3.116, 2.7403], "observations": [{"tracker": "STARTRACKER_1", "stars": [{"vector": \
[0.0384798478, 0.0097391059, 0.999211915], "magnitude": 6.424}, {"vector": [0.003941442, \
-0.0218769648, 0.9997529012], "magnitude": 5.865}, {"vector": [0.0202190777, 0.03796022, \
0.9990746772], "magnitude": 5.529}, {"vector": [0.0040747202, 0.06907744, 0.9976029791], \
"magnitude": 5.97}]}]}
{"spacecraft": "XTE", "block": "1996-010-g1", "start": "1996-01-10T12:54:00.000Z", "step_s": 0.5, \
"rates_rad_per_s": [[2.1e-06, -5.3e-06, 3.4e-06], [2.0e-06, -5.4e-06, 3.5e-06]]}
"""

_CSV_EXAMPLE = """\
spacecraft,batch,time,q1,q2,q3,qc,tracker,h_deg,v_deg,magnitude
XTE,1996-010-0110,1996-01-10T12:54:30.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597,STARTRACKER_1,2.205382,0.558432,6.424
XTE,1996-010-0110,1996-01-10T12:54:30.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597,STARTRACKER_1,0.225883,-1.253567,5.865
XTE,1996-010-0110,1996-01-10T12:54:30.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597,STARTRACKER_1,1.159383,2.175928,5.529
XTE,1996-010-0110,1996-01-10T12:54:30.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597,STARTRACKER_1,0.234024,3.961033,5.97
"""

_AEM_EXAMPLE = """\
CCSDS_AEM_VERS = 1.0
CREATION_DATE = 1996-01-11T00:00:00
ORIGINATOR = GSFC
META_START
OBJECT_NAME = XTE
OBJECT_ID = 1995-074A
REF_FRAME_A = EME2000
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = UTC
START_TIME = 1996-01-10T12:54:00.000
STOP_TIME = 1996-01-10T12:55:00.000
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP
DATA_START
1996-01-10T12:54:00.000 0.6330424085 -0.333721514 0.5945872171 0.3665423597
1996-01-10T12:55:00.000 0.6330424085 -0.333721514 0.5945872171 0.3665423597
DATA_STOP
"""

_ATTITUDES_EXAMPLE = """\
time,q1,q2,q3,qc
1996-01-10T12:54:00.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597
1996-01-10T12:55:00.000Z,0.6330424085,-0.333721514,0.5945872171,0.3665423597
"""

_OEM_EXAMPLE = """\
CCSDS_OEM_VERS = 2.0
CREATION_DATE = 1996-01-11T00:00:00
ORIGINATOR = GSFC
META_START
OBJECT_NAME = XTE
OBJECT_ID = 1995-074A
CENTER_NAME = EARTH
REF_FRAME = EME2000
TIME_SYSTEM = UTC
START_TIME = 1996-01-10T12:54:00.000
STOP_TIME = 1996-01-10T12:55:00.000
META_STOP
1996-01-10T12:54:00.000 3579.0102 5892.6689 939.5758 -6.206086 3.326901 2.775123
1996-01-10T12:54:30.000 3390.9552 5989.3210 1022.3145 -6.329800 3.116000 2.740300
1996-01-10T12:55:00.000 3199.2896 6079.5957 1103.9646 -6.446774 2.901782 2.702559
"""

_TLE_EXAMPLE = """\
1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927
2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537
"""

INPUT_FORMATS: dict[str, InputFormat] = {
    NDJSON: InputFormat(
        "NDJSON",
        "batches and gyro blocks, one a line",
        "FILE",
        "One JSON object a line, in UTF-8 or UTF-16, with the fields of the API: a batch, or a "
        "gyro block with\n`block`, `start`, and `step_s` or `times_s`.  A file whose suffix no "
        "other format has is NDJSON.",
        _NDJSON_EXAMPLE,
        media_types=(
            "application/x-ndjson",
            "application/ndjson",
            "application/jsonl",
            # Generated clients can send this type; most know no type for lines.
            "application/octet-stream",
        ),
        read=physical_lines,
        refusal=_not_ndjson,
        one_a_line=True,
    ),
    CSV: InputFormat(
        "CSV",
        "batches, one star a row; or gyro samples",
        "FILE.csv or FILE.tsv",
        _CSV_NOTES + _columns_text(),
        _CSV_EXAMPLE,
        suffixes=(".csv", ".tsv"),
        media_types=("text/csv",),
        read=_read_csv,
        refusal=_not_csv,
        uploaded="One star or one gyro sample a row; `.csv` or `.tsv` of `acquire replay`.",
    ),
    "aem": InputFormat(
        "CCSDS AEM",
        "the a priori attitude of each batch",
        "--a-priori FILE",
        "Versions 1 and 2, KVN and XML, every type of attitude; perhaps packed with gzip.",
        _AEM_EXAMPLE,
    ),
    "acm": InputFormat(
        "CCSDS ACM",
        "the a priori attitude of each batch",
        "--a-priori FILE",
        "Version 2, KVN and XML: the blocks of attitudes; perhaps packed with gzip.",
    ),
    "attitude-csv": InputFormat(
        "Attitudes as CSV",
        "the a priori attitude of each batch",
        "--a-priori FILE",
        "The columns time, q1, q2, q3, qc, as `acquire export attitude` writes them, and perhaps\n"
        "rate_x, rate_y, rate_z, stretch, status.",
        _ATTITUDES_EXAMPLE,
    ),
    "ck": InputFormat(
        "SPICE C-kernel",
        "the a priori attitude of each batch",
        "--a-priori FILE",
        "A .bc file of type 1 or 3 with its clock (.tsc) in the same folder, or a zip of both.\n"
        "Needs the extra `spice`.",
    ),
    "oem": InputFormat(
        "CCSDS OEM",
        "velocities and positions",
        "--ephemeris FILE",
        "Versions 1 to 3, KVN and XML; geocentric, in EME2000, J2000, ICRF or GCRF.",
        _OEM_EXAMPLE,
    ),
    "tle": InputFormat(
        "Two-line element sets",
        "velocities and positions",
        "--ephemeris FILE",
        "With or without lines of names; each is used within 7 days of its epoch.\n"
        "Needs the extra `tle`.",
        _TLE_EXAMPLE,
    ),
    "omm": InputFormat(
        "CCSDS OMM",
        "velocities and positions",
        "--ephemeris FILE",
        "Versions 1 to 3, KVN and XML, and the JSON and CSV of CelesTrak: the elements of a\n"
        "two-line set.  Needs the extra `tle`.",
    ),
}
"""The built-in input formats by name."""

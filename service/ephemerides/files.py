"""Reader of attitude and orbit files in any supported format, recognised by content."""

import gzip
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import msgspec
import numpy as np

from service.ephemerides.acm import read_acm
from service.ephemerides.aem import read_aem
from service.ephemerides.attitude_csv import is_attitude_csv, read_attitude_csv
from service.ephemerides.ck import read_ck
from service.ephemerides.known import (
    MOST_RECORDS,
    Ephemeris,
    KnownAttitudes,
    Segment,
    known_attitudes,
)
from service.ephemerides.oem import read_oem
from service.ephemerides.omm import is_omm, read_omm
from service.ephemerides.tle import read_tle
from service.errors import BadFile, BadInput, Fault, shown_value
from service.observations.decompress import MAX_LINE_BYTES
from service.times import parse_utc

_LOOKED_AT_BYTES = 2048
_COMMENTS = re.compile(rb"\A(COMMENT([ \t][^\n]*)?\r?\n\s*)+(?=CCSDS_)")
_IS_ACM = re.compile(rb"<(\w+:)?acm\b|\ACCSDS_ACM_VERS")

READ = (
    "AEM or ACM (CCSDS 504.0-B, KVN or XML), C-kernel (.bc with its clock beside it, or .zip), CSV "
    "as `acquire export` writes, or the truth that `acquire simulate telemetry` writes (NDJSON)"
)
"""Names of the attitude formats that can be read, for messages."""


def read_attitudes(file: Path, field: str, object_id: str | None = None) -> KnownAttitudes:
    """Read attitudes from a file in any format, also packed with gzip.

    `object_id` is the object whose attitudes are read: its name in a message, or the NAIF id of a
    structure of a C-kernel.  Raises `BadInput` naming `field` if the file cannot be opened, and
    `BadFile` naming file, line and field if the content is invalid or of another object.
    """
    with _opened(file, field) as opened:
        start = _start(opened)
        if start.startswith((b"DAF/CK", b"NAIF/DAF")) or zipfile.is_zipfile(file):
            return read_ck(file, field, object_id)
        known = _of_text(file, start, opened)
    if object_id not in (None, known.object_name):
        message = f"has the attitudes of {known.object_name}, not of the object asked for"
        raise BadFile(Fault(file.name, message, shown_value(object_id)))
    return known


def _of_text(file: Path, start: bytes, opened: IO[bytes]) -> KnownAttitudes:
    """Read attitudes from an open file of text that begins with `start`."""
    if start.startswith(b"{"):
        return _read_truth(file.name, opened)
    if is_attitude_csv(start):
        return read_attitude_csv(file.name, opened)
    _require_text(file, start, (b"CCSDS_", b"<"), READ)
    reader = read_acm if _IS_ACM.search(start) else read_aem
    return reader(file.name, opened)


@contextmanager
def _opened(file: Path, field: str) -> Iterator[IO[bytes]]:
    """Context manager of an opened file, unpacked if packed with gzip."""
    try:
        with file.open("rb") as opened:
            is_packed = opened.read(3) == b"\x1f\x8b\x08"
            opened.seek(0)
            if not is_packed:
                yield opened
                return
            with gzip.GzipFile(fileobj=opened) as unpacked:
                yield cast(IO[bytes], unpacked)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise BadFile(Fault(file.name, f"is damaged gzip: {error}")) from None
    except OSError as error:
        raise BadInput(Fault(field, f"cannot be read: {error.strerror}", repr(str(file)))) from None


def _require_text(file: Path, start: bytes, marks: tuple[bytes, ...], read: str) -> None:
    """Raise `BadFile` for binary content, or a file that does not begin with one of the marks."""
    if b"\0" in start or start.startswith(b"SIMPLE  =") or (marks and not start.startswith(marks)):
        message = f"is of no format that is read here; there are {read}"
        raise BadFile(Fault(f"{file.name}, line 1", message, shown_value(start[:40])))


class _Truth(msgspec.Struct):
    """Line of simulated truth, with the fields that are read as an attitude."""

    spacecraft: str
    time: str
    quaternion: tuple[float, float, float, float]


def _read_truth(file: str, opened: IO[bytes]) -> KnownAttitudes:
    """Read the true attitudes of a simulated pass, whose lines are in order of time."""
    decoder = msgspec.json.Decoder(_Truth)
    read: list[_Truth] = []
    while line := opened.readline(MAX_LINE_BYTES + 1):
        place = f"{file}: line {len(read) + 1}"
        if len(line) > MAX_LINE_BYTES:
            raise BadFile(Fault(place, f"must have at most {MAX_LINE_BYTES} bytes"))
        if len(read) == MOST_RECORDS:
            raise BadFile(Fault(place, f"is more than the {MOST_RECORDS:,} lines that are read"))
        try:
            read.append(decoder.decode(line))
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise BadFile(Fault(place, f"is no truth: {error}")) from None
    others = [line for line, each in enumerate(read, 1) if each.spacecraft != read[0].spacecraft]
    if others:
        message = f"must be {read[0].spacecraft}, as above: a file is of one spacecraft"
        value = shown_value(read[others[0] - 1].spacecraft)
        raise BadFile(Fault(f"{file}: line {others[0]}, spacecraft", message, value))
    time_ns = np.array([parse_utc(each.time, file).tai_ns for each in read], dtype=np.int64)
    if (np.diff(time_ns) <= 0).any():
        raise BadFile(Fault(file, "the times of its lines do not increase"))
    quaternion = np.array([each.quaternion for each in read])
    one = Segment(file, time_ns, int(time_ns[0]), int(time_ns[-1]), quaternion)
    return known_attitudes(file, read[0].spacecraft, [one])


def _start(file: IO[bytes]) -> bytes:
    """First bytes of a file without leading blanks and comments; the file is rewound."""
    start = file.read(_LOOKED_AT_BYTES).lstrip(b"\xef\xbb\xbf \t\r\n")
    file.seek(0)
    return _COMMENTS.sub(b"", start)


def read_ephemeris(file: Path, field: str) -> Ephemeris:
    """Read an ephemeris: an OEM (KVN or XML), an OMM, otherwise two-line element sets.

    Raises `BadInput` naming `field` if the file cannot be opened, and `BadFile` naming file, line
    and field if the content is invalid.
    """
    with _opened(file, field) as opened:
        start = _start(opened)
        _require_text(file, start, (), "OEM (KVN or XML), OMM (KVN, XML, JSON or CSV) and TLE")
        if is_omm(start):
            return read_omm(file.name, opened, field)
        if start.startswith((b"CCSDS_", b"<")):
            return read_oem(file.name, opened)
        return read_tle(file.name, opened, field)

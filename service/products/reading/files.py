"""Attitudes, or positions and velocities, of a file, whatever its format."""

import zipfile
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from service.errors import BadFile, BadInput, Fault
from service.products.reading.aem import read_aem
from service.products.reading.ck import read_ck
from service.products.reading.known import Ephemeris, KnownAttitudes, Segment, known_attitudes
from service.products.reading.oem import read_oem
from service.products.reading.tle import read_tle
from service.times import parse_utc

READ = (
    "AEM (CCSDS 504.0-B, KVN or XML), C-kernel (.bc with its clock beside it, or .zip), or the "
    "truth that `acquire simulate telemetry` writes (NDJSON)"
)
"""The formats that are read, for people."""


def read_attitudes(file: Path, field: str) -> KnownAttitudes:
    """The attitudes of a file, recognised by its first bytes.

    Raises `BadInput` naming `field` where it cannot be opened, and `BadFile` naming file, line
    and field where it is not as its format has it.
    """
    try:
        with file.open("rb") as opened:
            start = opened.read(8)
            if not (start.startswith((b"DAF/CK", b"NAIF/DAF")) or zipfile.is_zipfile(file)):
                opened.seek(0)
                if start.startswith(b"{"):
                    return _read_truth(file.name, opened)
                return read_aem(file.name, opened)
    except OSError as error:
        raise BadInput(Fault(field, f"cannot be read: {error.strerror}", repr(str(file)))) from None
    return read_ck(file, field)


class _Truth(msgspec.Struct):
    """The fields of a line of simulated truth that are read."""

    spacecraft: str
    time: str
    quaternion: tuple[float, float, float, float]


def _read_truth(file: str, lines: Iterable[bytes]) -> KnownAttitudes:
    """The attitudes of a simulated pass, whose lines are in order of time."""
    decoder = msgspec.json.Decoder(_Truth)
    read: list[_Truth] = []
    for number, line in enumerate(lines, 1):
        try:
            read.append(decoder.decode(line))
        except msgspec.MsgspecError as error:
            raise BadFile(Fault(f"{file}: line {number}", f"is no truth: {error}")) from None
    time_ns = np.array([parse_utc(each.time, file).tai_ns for each in read], dtype=np.int64)
    if (np.diff(time_ns) <= 0).any():
        raise BadFile(Fault(file, "the times of its lines do not increase"))
    quaternion = np.array([each.quaternion for each in read])
    one = Segment(file, time_ns, int(time_ns[0]), int(time_ns[-1]), quaternion)
    return known_attitudes(file, read[0].spacecraft, [one])


def read_ephemeris(file: Path, field: str) -> Ephemeris:
    """The ephemeris of a file: an OEM (KVN or XML), else two-line element sets.

    Raises `BadInput` naming `field` where it cannot be opened, and `BadFile` naming file, line
    and field where it is not as its format has it.
    """
    try:
        with file.open("rb") as opened:
            start = opened.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
            opened.seek(0)
            if start.startswith((b"CCSDS_", b"<")):
                return read_oem(file.name, opened)
            return read_tle(file.name, opened, field)
    except OSError as error:
        raise BadInput(Fault(field, f"cannot be read: {error.strerror}", repr(str(file)))) from None

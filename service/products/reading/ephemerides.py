"""Positions and velocities of a file, whatever its format."""

from pathlib import Path

from service.errors import BadInput, Fault
from service.products.reading.known_states import Ephemeris
from service.products.reading.oem import read_oem
from service.products.reading.tle import read_tle


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

"""Attitudes of a file, whatever its format."""

import zipfile
from pathlib import Path

from service.errors import BadInput, Fault
from service.products.reading.aem import read_aem
from service.products.reading.ck import read_ck
from service.products.reading.known_attitudes import KnownAttitudes

READ = "AEM (CCSDS 504.0-B, KVN or XML), or C-kernel (.bc with its clock beside it, or .zip)"
"""What is read, for people."""


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
                return read_aem(file.name, opened)
    except OSError as error:
        raise BadInput(Fault(field, f"cannot be read: {error.strerror}", repr(str(file)))) from None
    return read_ck(file, field)

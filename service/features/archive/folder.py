"""Folder of an archive: Parquet files (parts), and a manifest beside those of each day.

    archive.json
    spacecraft=NAME/day=YYYY-MM-DD/part-N.parquet
    spacecraft=NAME/day=YYYY-MM-DD/run-RUN-DIGEST.parquet
    spacecraft=NAME/day=YYYY-MM-DD/manifest.json
    settings/DIGEST.json

A part is complete when the manifest names it with its hash.  Every file appears complete, by a
rename or a link.
"""

import errno
import fcntl
import hashlib
import io
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import msgspec
import pyarrow as pa
from msgspec import Struct, structs
from pyarrow import parquet
from sqlalchemy import Connection, select

from service.errors import BadConfiguration
from service.storage.sql.database_file import sync_folder
from service.storage.sql.tables import mission_uses

T = TypeVar("T")

MANIFEST = "manifest.json"
OWNER = "archive.json"
LOCK = "archive.lock"
UNFINISHED = ".part"
"""Ending of the name of a file that is being written."""
COMPRESSION_LEVEL = 1
"""Compression level of zstd: higher levels take longer, and up to 9 give no smaller files."""
ROWS_TOGETHER = 2_048
"""Number of rows in a Parquet row group, the least that is read of a text column."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Operating system errors for a full disk, an exhausted quota, and a limit on file sizes."""
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)
"""Operating system errors of file systems without hard links."""


class Part(Struct, frozen=True, kw_only=True):
    """Entry of an archive part in the manifest of its day."""

    file: str
    run: str
    batches: int
    results: int
    first: str
    """UTC time of the earliest batch in the archive part."""
    last: str
    first_ns: int
    last_ns: int
    bytes: int
    sha256: str
    missions: list[str]
    """Digests of the missions' settings, which are stored in `settings/`."""
    catalogs: list[str]
    source: str | None = None
    """Digest of the inputs of a reprocessed part; None for a part of recorded batches."""
    tracked: bool = False
    """True if the part's run was reprocessed with tracking; see `runs`."""
    record_head: str | None = None
    """Number, SHA-256 and time of the record's last head when the part was written."""


class Manifest(Struct, frozen=True, kw_only=True):
    """Manifest of a spacecraft's day: the list of its archive parts."""

    spacecraft: str
    day: str
    parts: list[Part]

    def with_part(self, part: Part) -> "Manifest":
        """Copy of an archive manifest with a part added, replacing one of the same file."""
        return structs.replace(self, parts=[*self.without(part).parts, part])

    def without(self, part: Part) -> "Manifest":
        """Copy of an archive manifest without one of its parts."""
        return structs.replace(self, parts=[each for each in self.parts if each.file != part.file])


class Owner(Struct, frozen=True, kw_only=True):
    """Owner of an archive: the database whose batches it holds."""

    database: str
    """Digest that identifies the database; see `identity_of`."""


class Settings(Struct, frozen=True, kw_only=True):
    """Settings of a mission, or a catalog, to which results in the archive refer."""

    digest: str
    row: dict[str, Any]
    """Database row of the settings or the catalog, by column."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock an archive folder; raises `BadConfiguration` while another command works on it."""
    if not folder.is_dir():
        raise BadConfiguration(f"{folder}: there is no such folder")
    with (folder / LOCK).open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadConfiguration(f"{folder}: another command is working on it") from None
        yield


def is_locked(folder: Path) -> bool:
    """True while a command works on an archive folder."""
    try:
        lock = (folder / LOCK).open("rb")
    except OSError:
        return False
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def day_folder(folder: Path, spacecraft: str, day: str) -> Path:
    """Folder with the archive parts of a spacecraft's day."""
    return folder / f"spacecraft={quote(spacecraft, safe='')}" / f"day={day}"


def path_of(folder: Path, manifest: Manifest, part: Part) -> str:
    """Path of an archive part below the archive folder."""
    file = day_folder(folder, manifest.spacecraft, manifest.day) / part.file
    return str(file.relative_to(folder))


def manifests(folder: Path) -> Iterator[Manifest]:
    """All manifests of an archive, in order of spacecraft and day."""
    for file in sorted(folder.glob(f"spacecraft=*/day=*/{MANIFEST}")):
        yield _decoded(file, Manifest)


def parts_of(folder: Path) -> Iterator[tuple[str, Manifest, Part]]:
    """All parts of an archive, each with its path below the folder and its manifest."""
    for manifest in manifests(folder):
        for part in manifest.parts:
            yield path_of(folder, manifest, part), manifest, part


def day_folders(folder: Path) -> list[Path]:
    """Folders of all spacecraft and days, in this order, including those without a manifest."""
    return sorted(each for each in folder.glob("spacecraft=*/day=*") if each.is_dir())


def manifest_of(folder: Path, spacecraft: str, day: str) -> Manifest:
    """Manifest of a spacecraft's day; an empty one if there is none."""
    file = day_folder(folder, spacecraft, day) / MANIFEST
    if not file.exists():
        return Manifest(spacecraft=spacecraft, day=day, parts=[])
    return _decoded(file, Manifest)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a spacecraft's day, replacing the previous one."""
    file = day_folder(folder, manifest.spacecraft, manifest.day) / MANIFEST
    write_whole(file, msgspec.json.format(msgspec.json.encode(manifest), indent=1))


def remove_part(folder: Path, manifest: Manifest, part: Part) -> Manifest:
    """Remove an archive part from the manifest, then delete its file."""
    manifest = manifest.without(part)
    write_manifest(folder, manifest)
    (day_folder(folder, manifest.spacecraft, manifest.day) / part.file).unlink()
    return manifest


def write_partition(file: Path, partition: pa.Table) -> bytes:
    """Write an archive part to a file; returns the bytes read back from the file."""
    write_whole(file, encoded(partition))
    return file.read_bytes()


def encoded(partition: pa.Table) -> bytes:
    """Encode an archive part as Parquet; equal for the same rows and version of pyarrow."""
    buffer = io.BytesIO()
    parquet.write_table(
        partition,
        buffer,
        compression="zstd",
        compression_level=COMPRESSION_LEVEL,
        row_group_size=ROWS_TOGETHER,
        write_page_checksum=True,
        # For a day of few batches each of these defaults would make a tenth of the file: hardly any
        # number occurs twice, and Parquet's own types are those of the part.
        use_dictionary=False,
        write_statistics=["time_ns"],
        store_schema=False,
    )
    return buffer.getvalue()


def read_partition(content: bytes) -> pa.Table:
    """Decode an archive part from the bytes of its Parquet file."""
    return parquet.read_table(io.BytesIO(content), page_checksum_verification=True)


def whole_content(folder: Path, path: str, sha256: str) -> bytes:
    """Read the file of an archive part; raises `BadConfiguration` if missing or damaged."""
    try:
        content = (folder / path).read_bytes()
    except OSError as error:
        raise BadConfiguration(f"{folder / path}: cannot be read: {error.strerror}") from None
    if hashlib.sha256(content).hexdigest() != sha256:
        raise BadConfiguration(f"{folder / path}: is damaged: its SHA-256 differs")
    return content


def settings_file(folder: Path, digest: str) -> Path:
    """Path of the file with a mission's settings or a catalog in an archive, by digest."""
    return folder / "settings" / f"{digest.replace(':', '-')}.json"


def write_settings(folder: Path, settings: Settings) -> None:
    """Store mission settings under their digest, unless their file exists."""
    file = settings_file(folder, settings.digest)
    if not file.exists():
        write_whole(file, msgspec.json.encode(settings))


def read_settings(folder: Path, digest: str) -> Settings:
    """Read the settings or the catalog with a digest from an archive."""
    return _decoded(settings_file(folder, digest), Settings)


def write_first(file: Path, content: bytes) -> bytes:
    """Write a complete file, unless it exists; returns the bytes in the file afterwards.

    Several processes may write the same file at a time: each writes a temporary file beside it, and
    that of the first is kept.
    """
    if not file.exists():
        beside_as = f".{file.name}.{uuid.uuid4().hex}{UNFINISHED}"
        # Another process has written the file first.
        with suppress(FileExistsError):
            write_whole(file, content, beside_as, _move_unless_there)
    return file.read_bytes()


def _move_unless_there(beside: Path, file: Path) -> None:
    """Rename a file; raises `FileExistsError` if the new name exists already."""
    try:
        os.link(beside, file)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # Without links the last file is kept instead: files of equal machines are identical.
        beside.replace(file)
    else:
        beside.unlink(missing_ok=True)


def write_whole(
    file: Path,
    content: bytes,
    beside_as: str | None = None,
    move: Callable[[Path, Path], object] = Path.replace,
) -> None:
    """Write a file that appears complete and survives a power cut.

    It is written under another name in the same folder, from which `move` renames it.
    """
    new = [folder for folder in file.parents if not folder.exists()]
    file.parent.mkdir(parents=True, exist_ok=True)
    for folder in new:
        sync_folder(folder.parent)
    beside = file.with_name(beside_as or f"{file.name}{UNFINISHED}")
    try:
        with beside.open("wb") as part:
            part.write(content)
            part.flush()
            os.fsync(part.fileno())
        move(beside, file)
    except OSError as error:
        beside.unlink(missing_ok=True)
        if error.errno not in _NO_ROOM:
            raise
        # The system's own message names no file.
        free = shutil.disk_usage(file.parent).free
        needed = f"the file needs {len(content)} bytes, and {free} are free"
        raise OSError(error.errno, f"{error.strerror}: {needed}", str(file)) from None
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    sync_folder(file.parent)


def _decoded(file: Path, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be read: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise BadConfiguration(f"{file}: is no file of an archive: {error}") from None


# The database that an archive belongs to: another one with the same batches could discard parts.
#
# A database restored from an archive has the batches of the archive's owner.  Its `acquire archive`
# would take parts for unfinished that the owner needs.


def identity_of(connection: Connection) -> str:
    """Digest that two databases share only if one is a copy of the other.

    It covers the settings that the database was first served with, and the time of that, to the
    microsecond.  Raises `BadConfiguration` for a database that was never served.
    """
    c = mission_uses.c
    query = select(c.spacecraft, c.digest, c.since).order_by(c.id).limit(1)
    first = connection.execute(query).first()
    if first is None:
        raise BadConfiguration(
            "the database was never served, and so an archive cannot tell it from others: start "
            "the service with it once"
        )
    return hashlib.sha256("\0".join(map(str, first)).encode()).hexdigest()


def claim(connection: Connection, folder: Path) -> str:
    """Note a database as the owner of an archive without one; returns its identity.

    The folder must be locked.  Raises `BadConfiguration` where another database owns it.
    """
    own, file = identity_of(connection), folder / OWNER
    if not file.exists():
        content = msgspec.json.format(msgspec.json.encode(Owner(database=own)), indent=1)
        write_whole(file, content)
    elif _decoded(file, Owner).database != own:
        raise BadConfiguration(
            f"{folder}: the archive belongs to another database: name another folder; only if that "
            f"database is gone for good, delete {OWNER} in this one"
        )
    return own

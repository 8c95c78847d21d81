"""File of a SQLite database, which must stay the file that was opened, with one writing process.

A file that was moved, replaced or deleted still accepts writes through an open connection,
and these would be lost.
"""

import fcntl
import logging
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import BadConfiguration, Busy

FileIdentity = tuple[int, int]
"""Identity of a file: device and inode."""

RETRY_S = 5
PRIVATE_FILE, PRIVATE_FOLDER = 0o600, 0o700
"""Access modes of files and of folders that hold secrets, such as digests of tokens."""

log = logging.getLogger(__name__)


class DatabaseFile:
    """Path of a SQLite database, with the identity of the file that was opened there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log_path = f"{path}-wal"
        self.identity: FileIdentity | None = None
        self._is_loss_logged = False

    def create(self) -> int:
        """Open the database file; a missing file is created, readable by its owner only.

        Returns the descriptor.  SQLite gives the files beside it the same mode.
        Raises `BadConfiguration`.
        """
        try:
            return os.open(self.path, os.O_RDONLY | os.O_CREAT, PRIVATE_FILE)
        except OSError as error:
            raise BadConfiguration(
                f"ACQUIRE_DATABASE: {self.path}: cannot be opened: {error.strerror}"
            ) from None

    @property
    def is_read_only(self) -> bool:
        """True for an existing file that the process cannot write, or not its log beside it."""
        exists = self.path.exists()
        return exists and not (
            os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK)
        )

    @property
    def uri(self) -> str:
        """URI by which SQLite opens the existing file.

        A read-only file without a log is opened as immutable: without a log no other process has it
        open, and SQLite need not make one.
        """
        is_fixed = self.is_read_only and not Path(self._log_path).exists()
        return f"{self.path.as_uri()}?{'mode=ro&immutable=1' if is_fixed else 'mode=rw'}"

    def remember(self) -> None:
        """Note the identity of the file at the path, unless one is noted already."""
        if self.identity is None:
            self.identity = _identity(self.path)

    def require_there(self) -> None:
        """Raise `BadConfiguration` unless the path leads to a file."""
        if _identity(self.path) is None:
            raise BadConfiguration(f"ACQUIRE_DATABASE: {self.path}: there is no such file")

    def require(self) -> None:
        """Raise `Busy` if the path no longer leads to the file that was noted."""
        if self.identity is None or _identity(self.path) == self.identity:
            self._is_loss_logged = False
            return
        if not self._is_loss_logged:
            self._is_loss_logged = True
            log.error("%s was moved, replaced or deleted while it is being served", self.path)
        raise Busy(
            "the database file was moved, replaced or deleted while the service runs; nothing is "
            "read or written until it is back, or the service is started again",
            RETRY_S,
        )

    def log_identity(self) -> FileIdentity | None:
        """Identity of SQLite's write-ahead log, which is constant while a connection is open."""
        return _identity(self._log_path)

    def require_log(self, opened: FileIdentity | None) -> None:
        """Raise `Busy` unless file and log are the same as at the beginning of a transaction."""
        self.require()
        if self.log_identity() != opened:
            log.error("%s was moved, replaced or deleted while in use", self._log_path)
            raise Busy("the database's log was moved, replaced or deleted", RETRY_S)


def _identity(path: Path | str) -> FileIdentity | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def warn_of_readers(path: Path) -> None:
    """Log a warning if other users may access a file or folder that holds secrets."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return
    private = PRIVATE_FOLDER if path.is_dir() else PRIVATE_FILE
    if mode & ~PRIVATE_FOLDER:
        log.warning(
            "other users may read %s (mode %o), which holds secrets: chmod %o %s",
            path,
            mode,
            private,
            path,
        )


def sync_folder(folder: Path) -> None:
    """Flush a folder to disk, so that the names of its files survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# The lock of the one process that writes to a SQLite file.
#
# The operating system holds the lock on the file itself, whatever name it was opened by, and
# releases it when the process ends, for any reason.

_HELD = Path("/proc/locks")
MAX_SHOWN = 120


class FileLock:
    """Lock on a SQLite file that is taken at the first write and held until released.

    Closing any descriptor of the file ends SQLite's own locks of this process on it: call `release`
    after every connection is closed.
    """

    def __init__(self, file: DatabaseFile) -> None:
        self._file = file
        self._descriptor: int | None = None
        self._is_held = False
        self._taking = threading.Lock()

    def take(self) -> None:
        """Take the lock on the database file, unless it is held; creates a missing file.

        Raises `BadConfiguration`, which names the process that holds the lock, and for a read-only
        file.
        """
        if self._is_held:
            return
        if self._file.is_read_only:
            raise BadConfiguration(
                f"ACQUIRE_DATABASE: {self._file.path}: the file or its folder is read-only here: "
                "it can be read, verified and exported, but not written"
            )
        with self._taking:
            if self._descriptor is None:
                self._descriptor = self._file.create()
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BadConfiguration(
                    f"ACQUIRE_DATABASE: {self._file.path}: {_holder(self._descriptor)} writes to "
                    "it, and one process at a time may: stop that one, or work on a copy (`acquire "
                    "database backup copy.db`, then --database sqlite:///copy.db)"
                ) from None
            self._is_held = True

    def release(self) -> None:
        """Release the lock on the database file, so that another process may write."""
        with self._taking:
            if self._descriptor is not None:
                os.close(self._descriptor)
            self._descriptor, self._is_held = None, False


@contextmanager
def writing_alone(file: DatabaseFile | None) -> Iterator[None]:
    """Context manager that holds a SQLite file's lock, without a `Store`; None: no lock."""
    if file is None:
        yield
        return
    lock = FileLock(file)
    try:
        lock.take()
        yield
    finally:
        lock.release()


def is_written(file: DatabaseFile) -> bool:
    """True if the lock of an existing SQLite file cannot be taken: held elsewhere, or read-only."""
    file.require_there()
    try:
        with writing_alone(file):
            return False
    except BadConfiguration:
        return True


def _holder(descriptor: int) -> str:
    """Description of the process that holds the lock of a file, as far as the system names one."""
    inode = os.fstat(descriptor).st_ino
    with suppress(OSError, ValueError):
        for line in _HELD.read_text(encoding="ascii").splitlines():
            # Example line: 3: FLOCK ADVISORY WRITE 8537 fe:00:2154497 0 EOF
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].endswith(f":{inode}") and int(fields[4]) > 0:
                return f"process {fields[4]}{_command(fields[4])}"
    return "another process, perhaps of another container,"


def _command(process: str) -> str:
    """Command line of a process in parentheses, without the path of the interpreter."""
    with suppress(OSError):
        words = Path("/proc", process, "cmdline").read_text(errors="replace").split("\0")
        if Path(words[0]).name.startswith("python"):
            words = words[2:] if words[1:2] == ["-m"] else words[1:]
        shown = " ".join(" ".join([Path(words[0]).name, *words[1:]]).split())
        return f" ({shown[:MAX_SHOWN]})" if shown else ""
    return ""

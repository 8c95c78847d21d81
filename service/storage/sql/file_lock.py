"""The lock of the one process that writes to a SQLite file.

It is the operating system's, on the file itself whatever name it was opened by, and ends with the
process that holds it, however that ends.
"""

import fcntl
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import BadConfiguration
from service.storage.sql.database_file import DatabaseFile

_HELD = Path("/proc/locks")
MAX_SHOWN = 120


class FileLock:
    """Takes the lock of a file at the first write, and keeps it until it is released.

    To close any descriptor of the file ends SQLite's own locks of this process on it: `release`
    is called when every connection is closed.
    """

    def __init__(self, file: DatabaseFile) -> None:
        self._file = file
        self._descriptor: int | None = None
        self._is_held = False
        self._taking = threading.Lock()

    def take(self) -> None:
        """Take the lock, unless it is held; creates a file that is missing.

        Raises `BadConfiguration` that names the process that has it, and for a read-only file.
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
        """Let another process write."""
        with self._taking:
            if self._descriptor is not None:
                os.close(self._descriptor)
            self._descriptor, self._is_held = None, False


def is_written(file: DatabaseFile) -> bool:
    """True if a process holds the lock of a file that exists; this one must have it not open."""
    lock = FileLock(file)
    file.require_there()
    try:
        lock.take()
    except BadConfiguration:
        return True
    finally:
        lock.release()
    return False


@contextmanager
def writing_alone(file: DatabaseFile | None) -> Iterator[None]:
    """Hold the lock of a file, for changes without a `Store`; None: a database server."""
    if file is None:
        yield
        return
    lock = FileLock(file)
    try:
        lock.take()
        yield
    finally:
        lock.release()


def _holder(descriptor: int) -> str:
    """The process that holds the lock of a file, as far as this machine tells it."""
    inode = os.fstat(descriptor).st_ino
    with suppress(OSError, ValueError):
        for line in _HELD.read_text(encoding="ascii").splitlines():
            # 3: FLOCK  ADVISORY  WRITE 8537 fe:00:2154497 0 EOF
            fields = line.split()
            if fields[1] == "FLOCK" and fields[5].endswith(f":{inode}") and int(fields[4]) > 0:
                return f"process {fields[4]}{_command(fields[4])}"
    return "another process, perhaps of another container,"


def _command(process: str) -> str:
    """The command of a process in parentheses, without the path of the interpreter."""
    with suppress(OSError):
        words = Path("/proc", process, "cmdline").read_text(errors="replace").split("\0")
        if Path(words[0]).name.startswith("python"):
            words = words[2:] if words[1:2] == ["-m"] else words[1:]
        shown = " ".join(" ".join([Path(words[0]).name, *words[1:]]).split())
        return f" ({shown[:MAX_SHOWN]})" if shown else ""
    return ""

"""Tells whether a service is at work on a SQLite file, by a lock on a file beside it.

The lock ends with the process that holds it, however that ends: a service that
was killed leaves nothing that stands in the way.  The database's own file is
not locked, since closing it again would end SQLite's locks on it.
"""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from service.errors import BadConfiguration
from service.storage.sql.engines import database_url

SUFFIX = ".lock"


def hold_served(database: str) -> IO[bytes] | None:
    """Mark a SQLite file as served until the file returned is closed, or the process ends.

    Several services may.  Raises `BadConfiguration` while a process has it to itself.
    """
    lock = _opened(database)
    if lock is not None and not _taken(lock, fcntl.LOCK_SH):
        lock.close()
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {_file(database)}: `acquire reprocess`, `acquire smooth` or "
            "`acquire archive` is writing to it: wait for its end"
        )
    return lock


@contextmanager
def unserved(database: str) -> Iterator[None]:
    """Have a SQLite file to oneself; raises `BadConfiguration` while a service holds it."""
    lock = _opened(database)
    if lock is None:
        yield
        return
    with lock:
        if not _taken(lock, fcntl.LOCK_EX):
            raise BadConfiguration(
                f"ACQUIRE_DATABASE: {_file(database)}: a service is at work on it: stop it, or "
                "work on a copy (`acquire database backup copy.db`, then --database "
                "sqlite:///copy.db)"
            )
        yield


def _file(database: str) -> Path | None:
    url = database_url(database)
    return Path(url.database or "") if url.drivername == "sqlite" else None


def _opened(database: str) -> IO[bytes] | None:
    """The file that is locked; None for a database server, which takes several writers."""
    file = _file(database)
    if file is None:
        return None
    place = file.resolve()
    place = place.with_name(place.name + SUFFIX)
    try:
        return place.open("ab")
    except OSError as error:
        raise BadConfiguration(f"{place}: cannot be opened: {error.strerror}") from None


def _taken(lock: IO[bytes], kind: int) -> bool:
    try:
        fcntl.flock(lock, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

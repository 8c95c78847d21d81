"""Copies the whole database as it is at one moment, while it is being served.

SQLite is copied page by page from one read transaction: writers go on beside
it, and what they write meanwhile is not in the copy.  PostgreSQL's own tool
does the same with a snapshot.
"""

import os
import sqlite3
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from sqlalchemy import URL

from service.errors import BadConfiguration
from service.storage.sql.engines import BUSY_TIMEOUT_MS, database_url, shown_url

PAGES_AT_ONCE = 2_000
"""About eight megabytes: often enough to show how far it is."""

Step = Callable[[int, int], object]
"""Called with the pages that are left and those there are."""


def back_up(database: str, target: Path, step: Step = lambda left, total: None) -> None:
    """Write a copy of a database to a file that is not there yet, whole or not at all.

    Of SQLite the copy is a database of its own; of PostgreSQL it is what
    `pg_restore` reads.  Raises `BadConfiguration` where the database cannot be
    read, and for a target that is there already.
    """
    url = database_url(database)
    if target.exists():
        raise BadConfiguration(f"{target}: exists already; choose another file")
    if not target.absolute().parent.is_dir():
        raise BadConfiguration(f"{target}: there is no such folder")
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    try:
        if url.drivername == "sqlite":
            _copy_sqlite(Path(url.database or ""), part, step)
        else:
            _dump_postgresql(url, part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
        _sync_folder(target.absolute().parent)
    finally:
        part.unlink(missing_ok=True)


def _copy_sqlite(source: Path, part: Path, step: Step) -> None:
    if not source.is_file():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {source}: there is no such file")
    try:
        with closing(_opened(source)) as reading, closing(sqlite3.connect(part)) as writing:
            # Reading first of all: from here on it sees this one moment.  Without it every commit
            # of another process would begin the copy anew.
            reading.execute("BEGIN")
            reading.execute("SELECT count(*) FROM sqlite_master").fetchone()
            reading.backup(
                writing,
                pages=PAGES_AT_ONCE,
                progress=lambda _, left, total: step(left, total),
                sleep=0.0,
            )
            reading.execute("ROLLBACK")
            # One file is the whole of it: no log beside it that could be left behind.
            writing.execute("PRAGMA journal_mode = DELETE")
    except sqlite3.Error as error:
        raise BadConfiguration(f"ACQUIRE_DATABASE: {source}: cannot be copied: {error}") from None


def _opened(source: Path) -> sqlite3.Connection:
    # Read and write, for its log; but never created.
    uri = f"{source.absolute().as_uri()}?mode=rw"
    connection = sqlite3.connect(uri, isolation_level=None, uri=True)
    connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    connection.execute("PRAGMA query_only = ON")
    return connection


def _dump_postgresql(url: URL, part: Path) -> None:
    from service.storage.sql.engines import reading_engine

    engine = reading_engine(url)
    with engine.connect() as connection:
        schema = connection.exec_driver_sql("SELECT current_schema()").scalar_one()
    engine.dispose()
    options = {"host": url.host, "port": url.port, "username": url.username, "dbname": url.database}
    command = ["pg_dump", "--format=custom", "--no-owner", "--no-privileges", f"--schema={schema}"]
    command += [f"--{name}={value}" for name, value in options.items() if value is not None]
    command += ["--no-password", f"--file={part}"]
    environment = dict(os.environ)
    if url.password:
        # Not on the command line, where every user of the machine could read it.
        environment["PGPASSWORD"] = str(url.password)
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise BadConfiguration(
            "pg_dump was not found: a backup of PostgreSQL needs its client tools"
        ) from None
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise BadConfiguration(f"ACQUIRE_DATABASE: {shown_url(url)}: {said}")


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

"""Copies the whole database as it is at one moment, while it is being served.

SQLite is copied page by page from one read transaction: writers go on beside
it, and what they write meanwhile is not in the copy.  PostgreSQL's own tool
does the same with a snapshot.
"""

import os
import sqlite3
import subprocess
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

from sqlalchemy import URL

from service.errors import BadConfiguration
from service.storage.sql.database_file import PRIVATE_FILE, DatabaseFile, sync_folder
from service.storage.sql.engines import (
    BUSY_TIMEOUT_MS,
    database_url,
    reading_engine,
    shown_url,
)
from service.storage.sql.migrations import reported

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
        # It holds what access depends on, such as the secrets of webhooks.
        part.touch(mode=PRIVATE_FILE, exist_ok=False)
        if url.drivername == "sqlite":
            _copy_sqlite(Path(url.database or ""), part, step)
        else:
            _dump_postgresql(url, part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
        sync_folder(target.absolute().parent)
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
    uri = DatabaseFile(source.absolute()).uri
    connection = sqlite3.connect(uri, isolation_level=None, uri=True)
    connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    connection.execute("PRAGMA query_only = ON")
    return connection


def _dump_postgresql(url: URL, part: Path) -> None:
    to_server, secret = client_options(url)
    engine = reading_engine(url)
    try:
        with reported(url), engine.connect() as connection:
            schema = connection.exec_driver_sql("SELECT current_schema()").scalar_one()
    finally:
        engine.dispose()
    if schema is None:
        raise BadConfiguration(f"ACQUIRE_DATABASE: {shown_url(url)}: has no schema of records")
    # A name without quotes would be a pattern.
    quoted = '"' + schema.replace('"', '""') + '"'
    command = ["pg_dump", "--format=custom", "--no-owner", "--no-privileges", f"--schema={quoted}"]
    run_client([*command, *to_server, f"--file={part}"], shown_url(url), secret)


def client_options(url: URL) -> tuple[list[str], dict[str, str]]:
    """How PostgreSQL's programs reach the database of a URL: arguments, and environment.

    All of the URL counts, its query part too; the password is in the environment, because
    every user of the machine can read a command line.  Raises `BadConfiguration` for what has no
    other place.
    """
    # First of all: it says what to install where psycopg is missing.
    dialect = reading_engine(url).dialect
    from psycopg.conninfo import make_conninfo
    from psycopg.pq import Conninfo

    given = dialect.create_connect_args(url)[1]
    password = given.pop("password", None)
    if "sslpassword" in given:
        raise BadConfiguration(
            "ACQUIRE_DATABASE: sslpassword: every user of the machine could read it while "
            "PostgreSQL's programs run; name a key without a passphrase"
        )
    # What else is given is for psycopg alone.
    known = {option.keyword.decode() for option in Conninfo.get_defaults()}
    named = make_conninfo(**{name: value for name, value in given.items() if name in known})
    secret = {} if password is None else {"PGPASSWORD": str(password)}
    return ["--no-password", f"--dbname={named}"], secret


def run_client(command: list[str], about: str, secret: Mapping[str, str] | None = None) -> str:
    """Run a client program of PostgreSQL; what it printed.

    Raises `BadConfiguration`, which says what it was `about`, where the program is missing or
    fails.
    """
    environment = os.environ | (secret or {})
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise BadConfiguration(
            f"{command[0]} was not found: backups of PostgreSQL need its client tools"
        ) from None
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise BadConfiguration(f"ACQUIRE_DATABASE: {about}: {said}")
    return done.stdout

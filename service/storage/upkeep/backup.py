"""Backups: the whole database copied as of one moment while in use, and restored from a copy.

SQLite is copied page by page in one read transaction: writes continue meanwhile, and are not in the
copy.  PostgreSQL's own tool does the same with a snapshot.

A backup keeps the schema of the version that wrote it, and restoring does not migrate it: that
version can be installed again and serve the restored database.
"""

import os
import sqlite3
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from sqlalchemy import URL, inspect

from service.contract.events import RecordHead
from service.errors import BadConfiguration
from service.storage.projections.heads import newest_head
from service.storage.sql import engines
from service.storage.sql.chain_tables import record_heads
from service.storage.sql.database_file import PRIVATE_FILE, DatabaseFile, sync_folder
from service.storage.sql.migrations import connected, reading, revision_of

PAGES_AT_ONCE = 2_000
"""Number of pages copied between two progress reports, about eight megabytes."""
SQLITE, POSTGRESQL = b"SQLite format 3\0", b"PGDMP"
"""First bytes of an SQLite database file and of a PostgreSQL dump."""
BESIDE = ("-wal", "-shm", "-journal")
"""Endings of SQLite's files beside a database; another database's would be read as its own."""

Step = Callable[[int, int], object]
"""Callback for the progress of a backup: pages left, pages in total."""


def back_up(
    database: str, target: Path, step: Step = lambda left, total: None
) -> RecordHead | None:
    """Write a copy of a database to a new file, whole or not at all.

    For SQLite the copy is a database file; for PostgreSQL it is an archive for `pg_restore`.
    Returns the last head of the record from before the copy.  Raises `BadConfiguration` where the
    database cannot be read, and for a target that exists already.
    """
    url = engines.database_url(database)
    if target.exists():
        raise BadConfiguration(f"{target}: exists already; choose another file")
    if not target.absolute().parent.is_dir():
        raise BadConfiguration(f"{target}: there is no such folder")
    head = None
    # A database that cannot be read cannot be copied either; the copy reports the error.
    with suppress(BadConfiguration), reading(database) as connection:
        # Earlier versions made no heads.
        if inspect(connection).has_table(record_heads.name):
            head = newest_head(connection)
    with _part_of(target) as part:
        if url.drivername == "sqlite":
            _copy_sqlite(Path(url.database or ""), part, step)
        else:
            _dump_postgresql(url, part)
        _move(part, target, Path.replace)
    return head


@contextmanager
def _part_of(target: Path) -> Iterator[Path]:
    """Context manager of a temporary file beside the target, deleted at the end."""
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    try:
        # The backup holds secrets, such as those of webhooks.
        part.touch(mode=PRIVATE_FILE, exist_ok=False)
        yield part
    finally:
        for left in (part, *(part.with_name(part.name + end) for end in BESIDE)):
            left.unlink(missing_ok=True)


def _move(part: Path, target: Path, move: Callable[[Path, Path], object]) -> None:
    """Move a temporary file to its final name, so that content and name survive a power cut."""
    with part.open("rb") as file:
        os.fsync(file.fileno())
    move(part, target)
    sync_folder(target.absolute().parent)


def _copy_sqlite(source: Path, part: Path, step: Step) -> None:
    if not source.is_file():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {source}: there is no such file")
    try:
        with closing(_opened(source)) as reading, closing(sqlite3.connect(part)) as writing:
            # Read before copying: the transaction then sees one moment.  Otherwise every commit of
            # another process would restart the copy.
            reading.execute("BEGIN")
            reading.execute("SELECT count(*) FROM sqlite_master").fetchone()
            _copy_pages(reading, writing, step)
            reading.execute("ROLLBACK")
            # Make the copy a single file, without a log beside it that could be left behind.
            writing.execute("PRAGMA journal_mode = DELETE")
    except sqlite3.Error as error:
        raise BadConfiguration(f"ACQUIRE_DATABASE: {source}: cannot be copied: {error}") from None


def _copy_pages(reading: sqlite3.Connection, writing: sqlite3.Connection, step: Step) -> None:
    def progress(_: int, left: int, total: int) -> None:
        step(left, total)

    reading.backup(writing, pages=PAGES_AT_ONCE, progress=progress, sleep=0.0)


def _opened(source: Path) -> sqlite3.Connection:
    uri = DatabaseFile(source.absolute()).uri
    connection = sqlite3.connect(uri, isolation_level=None, uri=True)
    connection.execute(f"PRAGMA busy_timeout = {engines.BUSY_TIMEOUT_MS}")
    connection.execute("PRAGMA query_only = ON")
    return connection


def _dump_postgresql(url: URL, part: Path) -> None:
    to_server, secret = client_options(url)
    with connected(url) as connection:
        schema = connection.exec_driver_sql("SELECT current_schema()").scalar_one()
    if schema is None:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {engines.shown_url(url)}: has no schema of records"
        )
    # A name without quotes would be a pattern.
    quoted = '"' + schema.replace('"', '""') + '"'
    command = ["pg_dump", "--format=custom", "--no-owner", "--no-privileges", f"--schema={quoted}"]
    run_client([*command, *to_server, f"--file={part}"], engines.shown_url(url), secret)


def client_options(url: URL) -> tuple[list[str], dict[str, str]]:
    """Arguments and environment that connect PostgreSQL's programs to the database of a URL.

    All of the URL counts, its query part too; the password is in the environment, because every
    user of the machine can read a command line.  Raises `BadConfiguration` for a part that cannot
    be passed on.
    """
    # Call this first: without psycopg its error says what to install.
    dialect = engines.reading_engine(url).dialect
    from psycopg.conninfo import make_conninfo
    from psycopg.pq import Conninfo

    options = dialect.create_connect_args(url)[1]
    password = options.pop("password", None)
    if "sslpassword" in options:
        raise BadConfiguration(
            "ACQUIRE_DATABASE: sslpassword: every user of the machine could read it while "
            "PostgreSQL's programs run; name a key without a passphrase"
        )
    # The remaining options are for psycopg only.
    known = {option.keyword.decode() for option in Conninfo.get_defaults()}
    named = make_conninfo(**{name: value for name, value in options.items() if name in known})
    secret = {} if password is None else {"PGPASSWORD": str(password)}
    return ["--no-password", f"--dbname={named}"], secret


def run_client(command: list[str], about: str, secret: Mapping[str, str] | None = None) -> str:
    """Run a client program of PostgreSQL; returns its output.

    Raises `BadConfiguration`, with the subject `about`, where the program is missing or fails.
    """
    environment = os.environ | (secret or {})
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise BadConfiguration(
            f"{command[0]} was not found: backups of PostgreSQL need its client tools"
        ) from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise BadConfiguration(f"ACQUIRE_DATABASE: {about}: {reason}")
    return done.stdout


def restore(database: str, source: Path, step: Step = lambda left, total: None) -> str:
    """Restore a database from a backup file, whole or not at all; returns its schema revision.

    A SQLite file must not exist yet; a PostgreSQL database must exist, without the service's
    tables.  Raises `BadConfiguration` for a backup that is missing, damaged or of the other kind,
    and for a database that holds records already or that a service is using.
    """
    url = engines.database_url(database)
    _check_kind(source, url)
    if url.drivername == "sqlite":
        return _restore_sqlite(source, Path(url.database or ""), step)
    return _restore_postgresql(source, url)


def _check_kind(source: Path, url: URL) -> None:
    try:
        with source.open("rb") as file:
            begins = file.read(len(SQLITE))
    except OSError as error:
        raise BadConfiguration(f"{source}: cannot be read: {error.strerror}") from None
    is_sqlite = begins == SQLITE
    if not is_sqlite and not begins.startswith(POSTGRESQL):
        raise BadConfiguration(f"{source}: is no file of `acquire database backup`")
    if is_sqlite != (url.drivername == "sqlite"):
        kind, other = ("SQLite", "PostgreSQL") if is_sqlite else ("PostgreSQL", "SQLite")
        raise BadConfiguration(
            f"{source}: is a backup of {kind}; ACQUIRE_DATABASE names a database of {other}"
        )


def _restore_sqlite(source: Path, target: Path, step: Step) -> str:
    for path in (target, *(target.with_name(target.name + part) for part in BESIDE)):
        if path.exists():
            raise BadConfiguration(
                f"ACQUIRE_DATABASE: {path}: exists already; move it away, or name another file"
            )
    uri = f"{source.absolute().as_uri()}?mode=ro"
    try:
        with _part_of(target) as part:
            with (
                closing(sqlite3.connect(uri, uri=True)) as reading,
                closing(sqlite3.connect(part)) as writing,
            ):
                _copy_pages(reading, writing, step)
                found = [row[0] for row in writing.execute("PRAGMA integrity_check(1)")]
            if found != ["ok"]:
                raise BadConfiguration(f"{source}: is damaged: {found[0]}")
            revision = _revision(f"sqlite:///{part}", source)
            # `link`, unlike `replace`, refuses to overwrite a file that a service has made
            # meanwhile.
            _move(part, target, os.link)
    except FileExistsError:
        raise BadConfiguration(f"ACQUIRE_DATABASE: {target}: exists already") from None
    except sqlite3.Error as error:
        raise BadConfiguration(f"{source}: cannot be restored: {error}") from None
    return revision


def _restore_postgresql(source: Path, url: URL) -> str:
    to_server, secret = client_options(url)
    with connected(url) as connection:
        schema = connection.exec_driver_sql("SELECT current_schema()").scalar_one_or_none()
        tables = inspect(connection).get_table_names() if schema is not None else []
    if tables:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {engines.shown_url(url)}: holds tables already ({tables[0]}, ...); "
            "name an empty database"
        )
    contents = run_client(["pg_restore", "--list", str(source)], str(source)).splitlines()
    held = [entry for line in contents if (entry := _entry(line)).startswith("TABLE ")]
    held = [entry for entry in held if not entry.startswith("TABLE DATA ")]
    if schema is not None and held and not held[0].startswith(f"TABLE {schema} "):
        raise BadConfiguration(
            f"{source}: holds the tables of schema {held[0].split()[1]}; those of "
            f"{engines.shown_url(url)} belong in schema {schema}"
        )
    wanted = [line for line in contents if schema is None or not _makes_schema(line, schema)]
    with tempfile.NamedTemporaryFile("w", encoding="utf-8") as listed:
        listed.write("\n".join(wanted))
        listed.flush()
        command = ["pg_restore", "--single-transaction", "--exit-on-error", "--no-owner"]
        command += ["--no-privileges", f"--use-list={listed.name}", *to_server, str(source)]
        run_client(command, f"{source} into {engines.shown_url(url)}", secret)
    return _revision(url.render_as_string(hide_password=False), source)


def _entry(line: str) -> str:
    """Subject of an entry in a backup's list: the end of `5; 2615 2200 SCHEMA - public me`."""
    return " ".join(line.partition(";")[2].split(" ")[3:])


def _makes_schema(line: str, schema: str) -> bool:
    """True if a line of a backup's list creates a schema that the database has already."""
    return _entry(line).startswith((f"SCHEMA - {schema} ", f"COMMENT - SCHEMA {schema} "))


def _revision(database: str, source: Path) -> str:
    revision = revision_of(database)
    if revision is None:
        raise BadConfiguration(f"{source}: holds no records of this service")
    return revision

"""Schema migrations: upgrade a database, and check that its schema is up to date.

alembic is imported only to change or compare a schema: the import would delay the start of the
service.
"""

import json
import logging
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import URL, Connection, Engine, Table, inspect
from sqlalchemy.exc import SQLAlchemyError

from service import __version__
from service.errors import BadConfiguration
from service.feature import brought_modules, feature_modules
from service.resources import shipped
from service.storage.sql import engines
from service.storage.sql.columns import metadata, unpack
from service.storage.sql.database_file import writing_alone

if TYPE_CHECKING:
    from alembic.config import Config

log = logging.getLogger(__name__)

REVISIONS = sorted(each.name[:4] for each in shipped("migrations", "versions").glob("[0-9]*.py"))
"""Schema revisions in the folder `migrations/`, oldest first."""
HEAD = REVISIONS[-1]
LAST_OF_DEVELOPMENT = "2973fa51"
"""Newest commit whose `acquire database upgrade` reads the schemas before the first revision."""
UNFINISHED = "copy:"
"""Prefix of the revision of a database that `upkeep.copy` has not finished copying."""


def upgrade(database: str) -> None:
    """Upgrade a database to this version's schema, creating missing tables; data is kept.

    Raises `BadConfiguration` for a database that cannot be reached, is none, or was written by a
    newer version or by a development version before 0.2.0.
    """
    url = engines.database_url(database)
    require_known_file(url)
    with writing_alone(engines.database_file(url)), disposed(engines.writing_engine(url)) as engine:
        bring_up_to_date(engine)


@contextmanager
def reading(database: str) -> Iterator[Connection]:
    """Connect to a database for reading as of one moment, creating nothing.

    Raises `BadConfiguration` where the database is missing or cannot be reached.
    """
    url = engines.database_url(database)
    file = Path(url.database or "")
    if url.drivername == "sqlite" and not file.is_file():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {file}: there is no such file")
    with connected(url) as connection:
        yield connection


@contextmanager
def connected(url: URL) -> Iterator[Connection]:
    """Connect to the database of a URL for reading as of one moment."""
    engine = engines.reading_engine(url)
    with disposed(engine), reported(url), engine.begin() as connection:
        yield connection


def require_records(database: str) -> None:
    """Raise `BadConfiguration` for a database with an unknown schema, or a SQLite file without one.

    Opening a file without a schema to write would create the service's tables in it.
    """
    url = engines.database_url(database)
    with reading(database) as connection:
        require_known(connection)
        found = revision_in(connection)
    if url.drivername == "sqlite" and found is None:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {engines.shown_url(url)}: holds no records of this service"
        )


def require_known_file(url: URL) -> None:
    """Raise `BadConfiguration` for a SQLite file with a schema that this version cannot upgrade.

    To open the file for writing would change it, even if no record is written.  An unfinished copy
    passes.
    """
    if url.drivername == "sqlite" and Path(url.database or "").is_file():
        with connected(url) as connection:
            require_known(connection, unfinished=True)


def require_known(connection: Connection, *, unfinished: bool = False) -> None:
    """Raise `BadConfiguration` for a schema that the migrations neither make nor change.

    With `unfinished`, an unfinished copy passes.
    """
    found = revision_in(connection)
    if found is None or found in REVISIONS:
        return
    if not (unfinished and found.startswith(UNFINISHED)):
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {engines.shown_url(connection.engine.url)}: "
            f"{_difference(connection)}"
        )


def revision_of(database: str) -> str | None:
    """Revision of a database's schema; None for a database without the service's schema."""
    with reading(database) as connection:
        return revision_in(connection)


def check(database: str) -> list[str]:
    """List the differences between a database's schema and the tables of the code.

    It only reads.  Raises `BadConfiguration` where there is no database, or one of a development
    version before 0.2.0.
    """
    with reading(database) as connection:
        if _is_of_development(revision_in(connection)):
            require_known(connection)
        differs = _difference(connection)
        if differs is not None:
            return [differs]
        from alembic.autogenerate import compare_metadata
        from alembic.runtime.migration import MigrationContext

        all_tables()
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        unknown = _unknown_tables(connection)
        return [
            _in_words(difference)
            for difference in compare_metadata(context, metadata)
            if not _is_about(difference, unknown)
        ]


def unknown_tables(database: str) -> list[str]:
    """Names of a database's tables that no installed code knows, as of a removed feature."""
    with reading(database) as connection:
        return _unknown_tables(connection)


def _unknown_tables(connection: Connection) -> list[str]:
    known = {"alembic_version", *(table.name for table in all_tables())}
    return sorted(set(inspect(connection).get_table_names()) - known)


def _is_about(difference: Any, tables: Collection[str]) -> bool:
    """True if alembic's difference removes one of the given tables, or an index of one."""
    if isinstance(difference, list):
        return False
    verb, thing = difference[:2]
    table = thing if verb == "remove_table" else getattr(thing, "table", None)
    return verb in ("remove_table", "remove_index") and getattr(table, "name", "") in tables


def all_tables() -> list[Table]:
    """All database tables that the code defines, each after the tables that it refers to."""
    # Importing a module registers its tables in the metadata.
    from service.storage.sql import (  # noqa: F401
        chain_tables,
        definitive_tables,
        tables,
    )

    # A feature that is switched off keeps its tables.
    feature_modules("tables", off="")
    return metadata.sorted_tables


def brought_tables() -> list[Table]:
    """Tables of features from other packages, which the service's migrations do not create."""
    return [table for module in brought_modules("tables") for table in module.TABLES]


def check_fresh() -> list[str]:
    """List the differences between a newly migrated database and the tables of the code."""
    with tempfile.TemporaryDirectory() as folder:
        database = f"sqlite:///{Path(folder, 'fresh.db')}"
        upgrade(database)
        return [*check(database), *unknown_tables(database)]


def bring_up_to_date(engine: Engine, before: Callable[[], object] = lambda: None) -> None:
    """Run the missing migrations in one transaction; `before` is called before the first."""
    with reported(engine.url), engine.begin() as connection:
        found = revision_in(connection)
        if found == HEAD:
            missing = _missing(connection)
            if missing:
                before()
                metadata.create_all(connection, tables=missing)
            return
        require_known(connection)
        before()
        from alembic import command

        config = _config()
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
        what = "made with" if found is None else f"brought from {found} to"
        metadata.create_all(connection, tables=_missing(connection))
        log.info("%s: %s the schema %s", engines.shown_url(engine.url), what, HEAD)


def require_up_to_date(engine: Engine) -> None:
    """Raise `BadConfiguration` unless the database has this version's schema."""
    with reported(engine.url), engine.begin() as connection:
        differs = _difference(connection)
    if differs is not None:
        raise BadConfiguration(f"ACQUIRE_DATABASE: {engines.shown_url(engine.url)}: {differs}")


@contextmanager
def reported(url: URL) -> Iterator[None]:
    """Convert database errors on opening into a `BadConfiguration`."""
    try:
        yield
    except (SQLAlchemyError, UnicodeDecodeError) as error:
        reason = str(getattr(error, "orig", None) or error).strip()
        raise BadConfiguration(f"ACQUIRE_DATABASE: {engines.shown_url(url)}: {reason}") from error


@contextmanager
def disposed(engine: Engine) -> Iterator[Engine]:
    """Context manager of an engine, whose connections are closed at the end."""
    try:
        yield engine
    finally:
        engine.dispose()


def _config() -> "Config":
    from alembic.config import Config

    config = Config()
    # A percent sign in a path would be taken for the start of a variable.
    config.set_main_option("script_location", str(shipped("migrations")).replace("%", "%%"))
    return config


def revision_in(connection: Connection) -> str | None:
    """Schema revision of a connection's database; None without the service's schema."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    revisions = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalars()
    return next(iter(revisions), None)


def remedy(database: str) -> str | None:
    """How a database's schema differs from this version's, and what to do; None if it does not."""
    with reading(database) as connection:
        return _difference(connection)


def _is_of_development(revision: str | None) -> bool:
    """True for the schema of a development version before 0.2.0."""
    return revision is not None and revision < REVISIONS[0]


def _difference(connection: Connection) -> str | None:
    """Difference of the database's schema from this version's, with the remedy; None if equal."""
    found = revision_in(connection)
    if found == HEAD:
        if missing := [table.name for table in _missing(connection)]:
            names = ", ".join(missing)
            return f"lacks the tables {names} of a feature: run `acquire database upgrade`"
        return None
    if found is None:
        return "holds no tables of this service: run `acquire database upgrade` to make them"
    if found.startswith(UNFINISHED):
        return (
            "is an unfinished copy: run the same `acquire database copy` again, which goes on, or "
            "name another database"
        )
    if _is_of_development(found):
        return (
            f"was written by a development version before 0.2.0, with the schema {found}: "
            f"upgrade it with `git checkout {LAST_OF_DEVELOPMENT} && make install && "
            f".venv/bin/acquire database upgrade`, then this version, {__version__}, reads it"
        )
    if found < HEAD:
        return (
            f"its schema is at {found}, this version needs {HEAD}: run `acquire database upgrade`"
        )
    return (
        f"its schema is at {found}, of a newer version of the service ({_writer(connection)}); "
        f"this version, {__version__}, knows those up to {HEAD}: use the newer one"
    )


def _missing(connection: Connection) -> list[Table]:
    """Tables of features from other packages that the database lacks."""
    brought = brought_tables()
    return [each for each in brought if not inspect(connection).has_table(each.name)]


def _writer(connection: Connection) -> str:
    """Clause for a message: the service version of the newest answer, or that none tells it."""
    newest = "SELECT answer FROM results ORDER BY id DESC LIMIT 1"
    with suppress(SQLAlchemyError, ValueError, LookupError, TypeError), connection.begin_nested():
        answer = unpack(connection.exec_driver_sql(newest).scalar_one())
        version = json.loads(answer)["provenance"]["version"]
        return f"its newest result is of version {version}"
    return "which one, no result tells"


def _in_words(difference: Any) -> str:
    """Text for one of alembic's differences (a verb, then its subject), or for a list of them."""
    if isinstance(difference, list):
        return "; ".join(_in_words(each) for each in difference)
    verb, *about = difference
    names = [str(getattr(each, "name", each)) for each in about if isinstance(each, str)] or [
        str(getattr(about[0], "name", about[0]))
    ]
    last = getattr(about[-1], "name", None)
    where = ".".join([*names, str(last)] if last and last not in names else names)
    return f"to be as the code says: {verb.replace('_', ' ')} {where}"

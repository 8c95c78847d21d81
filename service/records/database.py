"""The schema's migrations: bringing a database up to date, and telling whether it is."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import URL, Connection, Engine
from sqlalchemy.exc import SQLAlchemyError

from service.errors import BadConfiguration
from service.records.engines import database_url, reading_engine, shown_url, writing_engine
from service.records.tables import metadata
from service.resources import shipped


def upgrade(database: str) -> None:
    """Create what is missing and bring the schema to this version's; data is kept.

    Raises `BadConfiguration` for a database that cannot be reached, is none,
    or was written by a newer version.
    """
    with _disposed(writing_engine(database_url(database))) as engine:
        bring_up_to_date(engine)


def check(database: str) -> list[str]:
    """How the schema of a database differs from the tables of the code; empty: not at all.

    Nothing is written and nothing created: raises `BadConfiguration` where
    there is no database.
    """
    url = database_url(database)
    if url.drivername == "sqlite" and not Path(url.database or "").is_file():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {url.database}: there is no such file")
    with _disposed(reading_engine(url)) as engine, reported(url), engine.begin() as connection:
        found, wanted = _revision(connection), _head()
        if found != wanted:
            return [_behind(found, wanted)]
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        return [_in_words(difference) for difference in compare_metadata(context, metadata)]


def check_fresh() -> list[str]:
    """How the migrations, run from nothing, differ from the tables of the code."""
    with tempfile.TemporaryDirectory() as folder:
        database = f"sqlite:///{Path(folder, 'fresh.db')}"
        upgrade(database)
        return check(database)


def bring_up_to_date(engine: Engine) -> None:
    """Run the migrations that are missing, in one transaction."""
    with reported(engine.url), engine.begin() as connection:
        config = _config()
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def require_up_to_date(engine: Engine) -> None:
    """Raise `BadConfiguration` unless the schema is this version's."""
    with reported(engine.url), engine.begin() as connection:
        found = _revision(connection)
    wanted = _head()
    if found != wanted:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {shown_url(engine.url)}: {_behind(found, wanted)}"
        )


@contextmanager
def reported(url: URL) -> Iterator[None]:
    """Turn what a database says of itself on opening into a `BadConfiguration`."""
    try:
        yield
    except CommandError:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {shown_url(url)}: was written by another version of the service"
        ) from None
    except SQLAlchemyError as error:
        said = str(getattr(error, "orig", None) or error).strip()
        raise BadConfiguration(f"ACQUIRE_DATABASE: {shown_url(url)}: {said}") from error


@contextmanager
def _disposed(engine: Engine) -> Iterator[Engine]:
    try:
        yield engine
    finally:
        engine.dispose()


def _config() -> Config:
    config = Config()
    # A percent sign in a path would be taken for the start of a variable.
    config.set_main_option("script_location", str(shipped("migrations")).replace("%", "%%"))
    return config


def _revision(connection: Connection) -> str | None:
    return MigrationContext.configure(connection).get_current_revision()


def _head() -> str | None:
    return ScriptDirectory.from_config(_config()).get_current_head()


def _behind(found: str | None, wanted: str | None) -> str:
    return (
        f"its schema is at {found or 'nothing'}, this version needs {wanted}: "
        "run `acquire database upgrade`"
    )


def _in_words(difference: Any) -> str:
    """One difference as alembic tells it: a verb, then what it is about, perhaps in a list."""
    if isinstance(difference, list):
        return "; ".join(_in_words(each) for each in difference)
    verb, *about = difference
    names = [str(getattr(each, "name", each)) for each in about if isinstance(each, str)] or [
        str(getattr(about[0], "name", about[0]))
    ]
    last = getattr(about[-1], "name", None)
    where = ".".join([*names, str(last)] if last and last not in names else names)
    return f"to be as the code says: {verb.replace('_', ' ')} {where}"

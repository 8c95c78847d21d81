"""The schema's migrations: bringing a database up to date, and telling whether it is."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import URL, Connection, Engine
from sqlalchemy.exc import SQLAlchemyError

from service.errors import BadConfiguration
from service.records.engines import database_url, shown_url, writing_engine
from service.records.tables import metadata
from service.resources import shipped


def upgrade(database: str) -> None:
    """Create what is missing and bring the schema to this version's; data is kept.

    Raises `BadConfiguration` for a database that cannot be reached, is none,
    or was written by a newer version.
    """
    with _engine(database_url(database)) as engine:
        bring_up_to_date(engine)


def check(database: str) -> list[str]:
    """How the schema of a database differs from the tables of the code; empty: not at all."""
    url = database_url(database)
    with _engine(url) as engine, reported(url), engine.begin() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        return [str(difference) for difference in compare_metadata(context, metadata)]


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
    wanted = ScriptDirectory.from_config(_config()).get_current_head()
    if found != wanted:
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {shown_url(engine.url)}: its schema is at "
            f"{found or 'nothing'}, this version needs {wanted}: run `acquire database upgrade`"
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
def _engine(url: URL) -> Iterator[Engine]:
    engine = writing_engine(url)
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

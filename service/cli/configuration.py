"""Configuration of commands beside their arguments: settings, missions, catalogs, periods."""

import dataclasses
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import BadInput, Fault, shown_value
from service.settings import Settings

if TYPE_CHECKING:
    from service.missions.mission import Mission
    from service.sky.catalog.star_catalog import Catalog
    from service.times import Utc


def settings_of(parsed: Namespace) -> Settings:
    """The settings of the environment, overridden by the command's options."""
    overrides = {
        name: value
        for name in ("database", "host", "port")
        if (value := getattr(parsed, name, None)) is not None
    }
    return dataclasses.replace(Settings.from_environment(), **overrides)


def service_url(parsed: Namespace) -> str:
    """The address of the service: that of `--url`, else where the settings have it listen."""
    from service.settings import url_of

    settings = settings_of(parsed)
    return parsed.url or url_of(settings.host, settings.port)


def settings_of_existing(parsed: Namespace) -> Settings:
    """`settings_of` a command that reads records; raises `BadConfiguration` without a database.

    Opening a SQLite file that does not exist would create it.
    """
    from service.storage.sql.migrations import require_records

    settings = settings_of(parsed)
    require_records(settings.database)
    return settings


def period_of(parsed: Namespace) -> "tuple[Utc | None, Utc | None]":
    """The times of `--start` and `--end`; raises `BadInput` where they are out of order."""
    from service.times import parse_utc

    start = None if parsed.start is None else parse_utc(parsed.start, "--start")
    end = None if parsed.end is None else parse_utc(parsed.end, "--end")
    if start is not None and end is not None and start.tai_ns > end.tai_ns:
        raise BadInput(Fault("--end", "must not be before --start", shown_value(parsed.end)))
    return start, end


def mission_and_catalog(name: str) -> "tuple[Mission, Catalog]":
    """The mission of that name and the star catalog that the environment chooses."""
    from service.missions.mission import load_missions, mission_named
    from service.sky.catalog.star_catalog import open_catalog

    settings = Settings.from_environment()
    mission = mission_named(load_missions(settings.missions), name)
    return mission, open_catalog(settings.catalog)


def mission_of_file_or_name(text: str) -> "Mission":
    """The mission of a file whose name ends in `.toml`, else that of a spacecraft's name."""
    from service.missions.mission import load_missions, mission_named, read_mission

    if text.endswith(".toml"):
        return read_mission(Path(text))
    return mission_named(load_missions(Settings.from_environment().missions), text)

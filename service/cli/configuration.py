"""The parts of a command's run that several share: settings, missions, periods, progress."""

import dataclasses
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import BadInput, Fault, shown_value
from service.settings import Settings

if TYPE_CHECKING:
    import httpx

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


def http_client(settings: Settings, url: str, timeout_s: float) -> "httpx.Client":
    """A client of the service at an address, with the token of the settings."""
    import httpx

    headers = {} if settings.token is None else {"Authorization": f"Bearer {settings.token}"}
    # The service may listen to this machine alone, where no proxy reaches it.
    return httpx.Client(base_url=url, timeout=timeout_s, trust_env=False, headers=headers)


def refusal_of(response: "httpx.Response") -> str:
    """The reason that the service gives in an answer that refuses a request."""
    try:
        return str(response.json()["detail"])
    except (ValueError, KeyError, TypeError):
        return f"HTTP {response.status_code}: {response.text[:200]}"


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


class Progress:
    """The progress of a command, as a bar on a terminal; calling it moves the bar."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self.done = 0

    def __call__(self, done: int, total: int | None = None) -> None:
        """Show how many are done and, where it is known, of how many."""
        self._bar.total = total
        self._bar.update(done - self.done)
        self.done = done


@contextmanager
def progress_bar(
    unit: str, title: str, quiet: bool = False, leave: bool = False
) -> Iterator[Progress]:
    """A progress bar, which stays at the end if `leave` says so; none without a terminal."""
    from tqdm import tqdm

    disable = True if quiet else None
    with tqdm(total=None, unit=f" {unit}", desc=title, disable=disable, leave=leave) as bar:
        yield Progress(bar)

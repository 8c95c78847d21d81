"""The words between front and backend."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.errors import AcquisitionError
from service.logs import About
from service.missions.mission import Mission
from service.records.database_file import FileIdentity
from service.records.identity import OwnKey
from service.records.tokens import Caller
from service.settings import Settings
from service.times import Utc

# Of what comes with every batch there are plain tuples: objects take four times as long to pack.
Take = tuple[int, bytes | tuple[str, str], OwnKey | None, Caller | None]
"""A batch that is to be taken: its number, as sent or the fields of `Checked`, its key, and who
sent it, if they are bound to a spacecraft."""


@dataclass(frozen=True)
class Open:
    """The first word of the front: open the operations."""

    settings: Settings
    file: FileIdentity | None = None
    """SQLite's file that must be there, for a backend that takes the place of another."""


@dataclass(frozen=True)
class Opened:
    """The first word of the backend: what the front needs to know of the operations."""

    missions: Mapping[str, Mission]
    started: Utc
    file: FileIdentity | None
    """SQLite's file that was opened."""


@dataclass(frozen=True)
class Refused:
    """The other first word: they cannot be opened."""

    error: AcquisitionError


@dataclass(frozen=True)
class Takes:
    """Batches that came at once."""

    batches: list[Take]


@dataclass(frozen=True)
class Call:
    """A method of the operations is to be called; files among what it is given are `Handed`.

    `request` is the request that it is called for, as logs name it.
    """

    number: int
    method: str
    given: tuple[Any, ...]
    named: Mapping[str, Any]
    request: About | None = None


@dataclass(frozen=True)
class Close:
    """The last word of the front: finish what was taken, and end."""


@dataclass
class Told:
    """What the backend tells together: which batches are new, and what became of what was asked.

    `recorded` are the fields of `Recorded`, `answered` a number and those of
    `Answered`; `news`: something was written.
    """

    recorded: list[tuple[Any, ...]]
    answered: list[tuple[int, str | None, bytes, bool]]
    failed: list[tuple[int, Exception]]
    news: bool


@dataclass(frozen=True)
class Gave:
    """What a call gave, or raised."""

    number: int
    value: Any
    error: Exception | None

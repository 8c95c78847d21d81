"""What stands around every page: which run is shown, where else to go, and as of when."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends
from pydantic import Field

from service.observe.wire import RunName
from service.operations import LIVE, Operations
from service.records.tokens import Caller
from service.times import Utc
from service.web.access import Asking
from service.web.dashboard.words import present
from service.web.holding import Held
from service.web.queries import Query

__all__ = ["BARE", "LIVE", "AtDesk", "Desk", "RunQuery", "Shell"]

PLACES: Sequence[tuple[str, str]] = (
    ("/", "Overview"),
    ("/alarms", "Alarms"),
    ("/batches", "Batches"),
    ("/compare", "Compare"),
    ("/runs", "Runs"),
    ("/zones", "Zones"),
    ("/missions", "Missions"),
    ("/about", "About"),
)
"""Addresses and names of the pages, in the order of the menu."""


class RunQuery(Query):
    """Which run a page shows; every page takes it."""

    run: Annotated[RunName, Field(description="The run; `live` is what pipelines send.")] = LIVE


@dataclass(frozen=True)
class Run:
    """A run to choose; `batches` is None where nothing was recorded in it."""

    name: str
    batches: int | None


@dataclass(frozen=True)
class Shell:
    """The frame of a page: who reads it, which run of which it shows, and when it was made."""

    run: str
    runs: tuple[Run, ...]
    here: str
    now: Utc
    last_event: int | None = None
    """The number of the latest event when the page was begun: what came since is asked for."""
    stream: str | None = None
    """The spacecraft that events are asked of; None: every one; "none": there is no such stream."""
    reader: str | None = None
    """The name of the token that is signed in; None where nobody is asked."""
    may_operate: bool = False

    @property
    def is_live(self) -> bool:
        """Whether live batches are shown and not those of a named run."""
        return self.run == LIVE

    @property
    def places(self) -> Sequence[tuple[str, str]]:
        """The menu."""
        return PLACES

    @property
    def other_runs(self) -> tuple[Run, ...]:
        """The runs that hold batches, other than the one shown."""
        return tuple(run for run in self.runs if run.batches and run.name != self.run)


BARE = Shell(LIVE, (Run(LIVE, None),), "", present())


@dataclass(frozen=True)
class Desk:
    """What a page works with: the operations, and who reads it.

    `last_event` is asked for before anything else, so that a page may be told
    of what it shows already, and never misses anything.
    """

    operations: Operations
    caller: Caller
    last_event: int

    def shell(self, run: str, here: str) -> Shell:
        """The frame of the page at `here` (an address of the menu) that shows a run."""
        batches = {
            each["run"]: each["batches"]
            for each in self.operations.runs()
            if any(self.caller.may_see(name) for name in each["spacecraft"])
        }
        names = sorted({LIVE, run, *batches}, key=lambda name: (name != LIVE, name))
        return Shell(
            run=run,
            runs=tuple(Run(name, batches.get(name)) for name in names),
            here=here,
            now=present(),
            last_event=self.last_event,
            stream=self._stream(),
            reader=self.caller.name if self.caller.token_id else None,
            may_operate="operate" in self.caller.scopes,
        )

    def _stream(self) -> str | None:
        bound = self.caller.spacecraft
        if bound is None:
            return None
        return next(iter(bound)) if len(bound) == 1 else "none"

    @property
    def spacecraft(self) -> list[str]:
        """The spacecraft that the reader may ask about."""
        return [name for name in sorted(self.operations.missions) if self.caller.may_see(name)]


def _desk(operations: Held, caller: Asking) -> Desk:
    return Desk(operations, caller, operations.last_event())


AtDesk = Annotated[Desk, Depends(_desk)]

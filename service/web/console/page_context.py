"""The context of every page: the app and the reader, and the layout around its content."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fastapi import Depends
from pydantic import Field
from starlette.requests import Request

from service import logs
from service.access.tokens import Caller
from service.alarms.limits import Severity
from service.app.factory import App
from service.observations.schema import RunName
from service.storage.models.alarms import Alarm
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc
from service.web.console.formatting import present
from service.web.console.registry import PAGES, ConsolePage, navigation
from service.web.requests.access import CallerDep
from service.web.requests.dependencies import AppDep
from service.web.requests.problems import root_path
from service.web.requests.query_parameters import Query


class PageQuery(Query):
    """The run that a page shows; every page takes it."""

    run: Annotated[RunName, Field(description="The run; `live` for the batches of pipelines.")] = (
        LIVE
    )

    def address(self, **changed: Any) -> dict[str, Any]:
        """The parameters of this page with some changed; those at their default are left out."""
        asked = {name: changed.get(name, value) for name, value in self if name != "run"}
        fields = type(self).model_fields
        kept = {name: value for name, value in asked.items() if value != fields[name].default}
        return {
            name: str(value).lower() if isinstance(value, bool) else value
            for name, value in kept.items()
        }


class SortedQuery(PageQuery):
    """A table that is sorted by one of its columns."""

    descending: bool | None = None


@dataclass(frozen=True)
class RunChoice:
    """A run to choose; `batches` is None where it holds none."""

    name: str
    batches: int | None


@dataclass(frozen=True)
class AlarmCounts:
    """How many alarms there are that are not cleared; each is counted once.

    `open` are out of limits now and nobody has acknowledged them; `returned` are back in limits
    and wait for that.
    """

    open: int
    acknowledged: int
    returned: int
    shelved: int
    worst: str | None
    """The worst present severity of those that are out of limits and not shelved."""


def alarm_counts(found: Sequence[Alarm]) -> AlarmCounts:
    """The counts of alarms that are not cleared."""
    unshelved = [each for each in found if each.state != "shelved"]
    out = [each for each in unshelved if not each.in_limits]
    severities = [each.current_severity for each in out if each.current_severity]
    return AlarmCounts(
        open=sum(each.state == "open" for each in out),
        acknowledged=sum(each.state == "acknowledged" for each in out),
        returned=len(unshelved) - len(out),
        shelved=len(found) - len(unshelved),
        worst=max(severities, key=lambda word: Severity[word.upper()], default=None),
    )


@dataclass(frozen=True)
class Layout:
    """The layout around the content of a page: its title, run, reader and time."""

    run: str
    runs: tuple[RunChoice, ...]
    title: str
    section: str
    now: Utc
    last_event: int | None = None
    """The number of the latest event when the page was begun; the page asks for later ones."""
    stream: str | None = None
    """The spacecraft whose events the page follows; None: all; "none": there is no such stream.

    "off": the page follows no events.
    """
    reader: str | None = None
    """The name of the signed-in token; None while access is open."""
    may_operate: bool = False
    address: str = ""
    """The service's address, as the reader's browser has it."""
    alarms: "AlarmCounts | None" = None
    """Alarms of the run, which every page counts; None: of a page that shows no run."""
    """True if another service writes to the database."""
    behind_s: float = 0.0
    """How far trends and alarms are behind the record, where they could not be waited for."""

    @property
    def is_live(self) -> bool:
        """True if live batches are shown and not those of a named run."""
        return self.run == LIVE

    @property
    def navigation(self) -> list[ConsolePage]:
        """The pages of the navigation, in its order."""
        return navigation()

    @property
    def other_runs(self) -> tuple[RunChoice, ...]:
        """The runs that hold batches, other than the one shown."""
        return tuple(run for run in self.runs if run.batches and run.name != self.run)


OFF = "off"
EMPTY_LAYOUT = Layout(LIVE, (RunChoice(LIVE, None),), "", "", present())
"""The layout of pages without a reader: sign in, and errors."""


def open_layout(run: str, title: str, section: str) -> Layout:
    """The layout of a page that needs no token and shows nothing that is recorded."""
    runs = tuple(RunChoice(name, None) for name in dict.fromkeys((LIVE, run)))
    return replace(
        EMPTY_LAYOUT,
        run=run,
        runs=runs,
        title=title,
        section=section,
        now=present(),
        stream=OFF,
    )


@dataclass(frozen=True)
class PageContext:
    """The context of the handler of a page.

    `last_event` is read before anything else: the page may hear of something
    that it shows already, but never misses anything.
    """

    app: App
    caller: Caller
    page: ConsolePage
    last_event: int
    address: str

    def layout(self, run: str) -> Layout:
        """The layout of the page that shows a run."""
        batches = {each.run: each.batches for each in self.app.runs.all(self.caller.spacecraft)}
        active = self.app.alarms.active(run)
        alarms = alarm_counts([each for each in active if self.caller.may_see(each.spacecraft)])
        names = sorted({LIVE, run, *batches}, key=lambda name: (name != LIVE, name))
        return Layout(
            run=run,
            runs=tuple(RunChoice(name, batches.get(name)) for name in names),
            title=self.page.title,
            section=self.page.section,
            now=present(),
            last_event=self.last_event,
            stream=self._stream(),
            reader=self.caller.name if self.caller.token_id else None,
            may_operate="operate" in self.caller.scopes,
            address=self.address,
            alarms=alarms,
            behind_s=request.behind_s if (request := logs.request.get()) is not None else 0.0,
        )

    def _stream(self) -> str | None:
        bound = self.caller.spacecraft
        if bound is None:
            return None
        return next(iter(bound)) if len(bound) == 1 else "none"

    @property
    def spacecraft(self) -> list[str]:
        """The spacecraft that the reader may see, retired ones too."""
        return [name for name in sorted(self.app.context.known) if self.caller.may_see(name)]

    @property
    def first_spacecraft(self) -> str:
        """The first spacecraft that the reader may see, with a mission if there is one.

        A token may be bound to spacecraft alone that have no mission file any more.
        """
        return (self.spacecraft or sorted(self.caller.spacecraft or ()))[0]

    def filled_spacecraft(self, run: str) -> str:
        """The first spacecraft with batches in a run; without any, the first one."""
        found = {
            name
            for each in self.app.runs.all(self.caller.spacecraft)
            if each.run == run
            for name in each.spacecraft
        }
        return next((name for name in self.spacecraft if name in found), self.first_spacecraft)


def _page_context(request: Request, app: AppDep, caller: CallerDep) -> PageContext:
    page = PAGES[request.scope["route"].name]
    address = str(request.base_url).rstrip("/") + root_path(request)
    return PageContext(app, caller, page, app.events.last(caller.spacecraft), address)


ContextDep = Annotated[PageContext, Depends(_page_context)]

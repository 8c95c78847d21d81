"""What every page of the console is made of: registration, context, layout, rendering.

A page is a module that calls `console_page`; see `service.web.console.pages`.  Routes,
navigation, titles and access policies derive from that call.
"""

import re
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any
from urllib.parse import quote, urlencode

import msgspec
from fastapi import Depends
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, pass_context
from jinja2.runtime import Context
from markupsafe import Markup
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from service import __version__, logs
from service.access import Caller
from service.app.factory import App
from service.contract.alarms import Alarm
from service.errors import AcquisitionError, BadInput, Busy, problem_of, problem_of_faults
from service.feature import feature_folders, feature_modules
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc, parse_utc
from service.trends.limits import Severity
from service.web.console.formatting import FILTERS, completed_utc, present
from service.web.requests import problems
from service.web.requests.access import POLICIES, AppDep, CallerDep, Policy
from service.web.requests.problems import ProblemType, faults_in_query, on_http_error, root_path
from service.web.requests.query_parameters import FromQuery as FromQuery  # for pages
from service.web.requests.query_parameters import Query, Run

Handler = Callable[..., Any]


@dataclass(frozen=True)
class ConsolePage:
    """A page of the console.

    `section` is the path of the navigation entry that is marked on the page.
    `position` orders the entries of the navigation; a page without one has no entry.
    """

    path: str
    title: str
    section: str
    position: int | None
    handler: Handler


PAGES: dict[str, ConsolePage] = {}
"""Every page by the name of its route."""


def console_page(
    path: str, title: str, policy: Policy, *, section: str = "", position: int | None = None
) -> Callable[[Handler], Handler]:
    """Register the decorated handler as the page at `path`."""

    def register(handler: Handler) -> Handler:
        PAGES[handler.__name__] = ConsolePage(path, title, section or path, position, handler)
        POLICIES[handler.__name__] = policy
        return handler

    return register


def navigation() -> list[ConsolePage]:
    """The pages of the navigation, in its order."""
    return sorted(
        (page for page in PAGES.values() if page.position is not None),
        key=lambda page: page.position or 0,
    )


class PageQuery(Query):
    """The run that a page shows; every page takes it."""

    run: Run = LIVE

    def address(self, **changed: Any) -> dict[str, Any]:
        """The parameters of this page with some changed; those at their default are left out."""
        asked = {name: changed.get(name, value) for name, value in self if name != "run"}
        fields = type(self).model_fields
        kept = {name: value for name, value in asked.items() if value != fields[name].default}
        return {
            name: str(value).lower() if isinstance(value, bool) else value
            for name, value in kept.items()
        }


def typed_utc(text: str, field: str) -> Utc:
    """A time as people type it; raises `BadInput` naming the field."""
    return parse_utc(completed_utc(text), field)


class PeriodQuery(PageQuery):
    """A period as people type it; an empty field stands for any time."""

    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""

    @property
    def bounds(self) -> dict[str, Utc | None]:
        """Both ends by name; raises `BadInput` for what is no time."""
        typed = {"start": self.start, "end": self.end}
        return {
            name: typed_utc(text, name) if text.strip() else None for name, text in typed.items()
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
    alarms: AlarmCounts | None = None
    """Alarms of the run, which every page counts; None: of a page that shows no run."""
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


EMPTY_LAYOUT = Layout(LIVE, (RunChoice(LIVE, None),), "", "", present())
"""The layout of pages without a reader: sign in, and errors."""


def open_layout(run: str, title: str, section: str) -> Layout:
    """The layout of a page that needs no token and shows nothing that is recorded."""
    runs = tuple(RunChoice(name, None) for name in dict.fromkeys((LIVE, run)))
    return Layout(run, runs, title, section, now=present(), stream="off")


@dataclass(frozen=True)
class Panel:
    """A part of a page that a feature draws: its template, which sees `values`."""

    template: str
    values: Any


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

    @property
    def may_operate(self) -> bool:
        """True if the reader may change something."""
        return "operate" in self.caller.scopes

    def rendered(self, template: str, run: str, **values: Any) -> Response:
        """The page, which shows a run."""
        return rendered(template, self._layout(run), **values)

    def panels(self, page: str, *shown: Any) -> list[Any]:
        """What features add to a page, by the name of its handler; `shown` is what it shows."""
        modules = feature_modules("pages", self.app.settings.features_off)
        makers = (getattr(module, "PANELS", {}).get(page) for module in modules)
        return [panel for make in makers if make is not None for panel in make(self, *shown)]

    def _layout(self, run: str) -> Layout:
        batches = {each.run: each.batches for each in self.app.runs.all(self.caller.spacecraft)}
        active = self.app.spacecraft.alarms(run)
        alarms = alarm_counts([each for each in active if self.caller.may_see(each.spacecraft)])
        names = sorted({LIVE, run, *batches}, key=lambda name: (name != LIVE, name))
        return Layout(
            run=run,
            runs=tuple(RunChoice(name, batches.get(name)) for name in names),
            title=self.page.title,
            section=self.page.section,
            now=present(),
            last_event=self.last_event,
            stream=self._stream,
            reader=self.caller.name if self.caller.token_id else None,
            may_operate=self.may_operate,
            address=self.address,
            alarms=alarms,
            behind_s=request.behind_s if (request := logs.request.get()) is not None else 0.0,
        )

    @property
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

    def listed(self, spacecraft: str) -> str:
        """The spacecraft of a list: the asked one; empty for all, of which some see one alone."""
        if spacecraft:
            self.caller.require(spacecraft)
        elif self.caller.spacecraft is not None:
            return self.first_spacecraft
        return spacecraft

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


HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@pass_context
def _to(context: Context, path: str, /, **query: object) -> str:
    """An address of the console that keeps the shown run."""
    run = query.pop("run", context["layout"].run)
    asked = {} if run == LIVE else {"run": run}
    asked |= {name: value for name, value in query.items() if value is not None}
    return f"{quote(path)}?{urlencode(asked)}" if asked else quote(path)


_DOCUMENTED = re.compile(r'href="(/(?:docs|problems)[^"#]*)')


def _of_run(text: Markup, run: str) -> Markup:
    """A kept part of a page whose links to other pages keep the shown run."""
    if run == LIVE:
        return text
    return Markup(_DOCUMENTED.sub(rf'href="\1?{urlencode({"run": run})}', str(text)))


def _data(value: object) -> Markup:
    """Values for a script, in a `template` element: escaped like any text."""
    return Markup("<template data-json>{}</template>").format(msgspec.json.encode(value).decode())


def _environment() -> Environment:
    # Text from clients is escaped; a misspelt name is an error, not an empty string.
    environment = Environment(
        loader=ChoiceLoader(
            [PackageLoader(each) for each in ("service.web.console", *feature_folders("templates"))]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    environment.filters["of_run"] = _of_run
    environment.globals.update(to=_to, data=_data, pages=PAGES, version=__version__)
    return environment


_ENVIRONMENT = _environment()


def rendered(template: str, layout: Layout, status: int = 200, **values: Any) -> Response:
    """A page of the console."""
    text = _ENVIRONMENT.get_template(template).render(layout=layout, **values)
    return HTMLResponse(text, status, headers=dict(HEADERS))


def rendered_part(template: str, **values: Any) -> Markup:
    """A part of a page that depends on neither reader nor run, so that it can be kept."""
    return Markup(_ENVIRONMENT.get_template(template).render(**values))


_OWN_ADDRESS = re.compile(rb'\b(href|src|action)="/(?!/)')


def below_path(request: Request, page: Response) -> Response:
    """A page whose addresses begin with the path below which a proxy serves the service."""
    root = root_path(request).encode()
    if not root or not isinstance(page, HTMLResponse):
        return page
    body = _OWN_ADDRESS.sub(rb'\1="' + root + b"/", bytes(page.body))
    page.body = body.replace(b"<html ", b'<html data-root="' + root + b'" ', 1)
    page.headers["Content-Length"] = str(len(page.body))
    return page


class PageRoute(APIRoute):
    """A route whose errors are pages for people."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler, with every expected error turned into a page."""
        inner = super().get_route_handler()

        async def handler(request: Request) -> Response:
            try:
                return below_path(request, await inner(request))
            except RequestValidationError as error:
                page = _error_page(
                    problems.PROBLEM_TYPES[BadInput], problem_of_faults(faults_in_query(error))
                )
                return below_path(request, page)
            except AcquisitionError as error:
                if (kind := problems.problem_type_of(error)) is problems.INTERNAL_ERROR:
                    raise
                answer = _error_page(kind, problem_of(error))
                if isinstance(error, Busy):
                    answer.headers["Retry-After"] = str(error.retry_after_s)
                return below_path(request, answer)

        return handler


async def page_or_problem(request: Request, error: Exception) -> Response:
    """What a browser that follows a link to no page gets is a page; all others get a problem."""
    is_page = not request.url.path.startswith(("/api/", "/static/"))
    asks_for_page = "text/html" in request.headers.get("accept", "")
    if not (isinstance(error, HTTPException) and error.status_code == 404):
        return await on_http_error(request, error)
    if not (is_page and asks_for_page and request.method in ("GET", "HEAD")):
        return await on_http_error(request, error)
    detail = f"There is no page at {request.url.path[:200]}."
    page = _error_page(ProblemType(404, "Not found"), {"detail": detail})
    return below_path(request, page)


def _error_page(kind: ProblemType, problem: Mapping[str, Any]) -> Response:
    return rendered(
        "error.html.jinja",
        replace(EMPTY_LAYOUT, now=present()),
        kind.status,
        kind=kind,
        problem=problem,
    )

"""Common parts of all console pages: registration, context, layout, rendering.

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
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, Response

from service import __version__, logs
from service.access import Caller
from service.app.factory import App
from service.contract.alarms import Alarm
from service.errors import AcquisitionError, BadInput, Busy, problem_of, problem_of_faults
from service.feature import feature_folders, feature_modules
from service.observations.schema import LIVE
from service.times import Utc, parse_utc
from service.trends.limits import Severity
from service.web.console.formatting import FILTERS, STATES, completed_utc, present
from service.web.requests import problems
from service.web.requests.access import POLICIES, AppDep, CallerDep, Policy
from service.web.requests.problems import ProblemType, faults_in_query, on_http_error, root_path
from service.web.requests.query_parameters import FromQuery as FromQuery  # for pages
from service.web.requests.query_parameters import Query, Run

Handler = Callable[..., Any]


@dataclass(frozen=True)
class ConsolePage:
    """A registered page of the console: address, title, handler and place in the navigation.

    `section` is the path of the navigation entry that is marked on the page.
    `position` orders the entries of the navigation; a page without one has no entry.
    """

    path: str
    title: str
    section: str
    position: int | None
    handler: Handler


PAGES: dict[str, ConsolePage] = {}
"""All pages, by the name of their route."""


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
    """Pages of the navigation, in its order."""
    return sorted(
        (page for page in PAGES.values() if page.position is not None),
        key=lambda page: page.position or 0,
    )


class PageQuery(Query):
    """Query that selects the run of a page; every page has it."""

    run: Run = LIVE

    def address(self, **changed: Any) -> dict[str, Any]:
        """Parameters of this page with some changed; default values are left out."""
        asked = {name: changed.get(name, value) for name, value in self if name != "run"}
        fields = type(self).model_fields
        kept = {name: value for name, value in asked.items() if value != fields[name].default}
        return {
            name: str(value).lower() if isinstance(value, bool) else value
            for name, value in kept.items()
        }


def typed_utc(text: str, field: str, near: Utc | None = None) -> Utc:
    """Parse a time as people type it, see `completed_utc`; raises `BadInput` naming the field."""
    return parse_utc(completed_utc(text, near), field)


class PeriodQuery(PageQuery):
    """Query with a period as people type it; an empty field selects any time."""

    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""

    @property
    def bounds(self) -> dict[str, Utc | None]:
        """Start and end of the period by name; raises `BadInput` for other text."""
        typed = {"start": self.start, "end": self.end}
        return {
            name: typed_utc(text, name) if text.strip() else None for name, text in typed.items()
        }


class SortedQuery(PageQuery):
    """Query of a table that is sorted by one of its columns."""

    descending: bool | None = None


@dataclass(frozen=True)
class RunChoice:
    """Run in the list of runs; `batches` is None if it has none."""

    name: str
    batches: int | None
    has_alarms: bool = True
    """True if its batches can raise alarms."""


@dataclass(frozen=True)
class AlarmCounts:
    """Numbers of alarms that are not cleared; each alarm is counted once.

    `open` alarms are out of limits and not acknowledged; `returned` alarms are back in limits and
    not acknowledged.
    """

    open: int
    acknowledged: int
    returned: int
    shelved: int
    worst: str | None
    """Greatest severity of the alarms that are out of limits and not shelved."""

    @property
    def mark(self) -> str:
        """Shape of the worst severity with a space; empty if no alarm is out of limits."""
        return f"{STATES[self.worst][0]} " if self.worst else ""


def alarm_counts(found: Sequence[Alarm]) -> AlarmCounts:
    """Numbers of alarms that are not cleared."""
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
    """Layout around the content of a page: title, run, reader and time."""

    run: str
    runs: tuple[RunChoice, ...]
    title: str
    section: str
    now: Utc
    last_event: int | None = None
    """Number of the latest event before the page was read; the page asks for later ones."""
    stream: str | None = None
    """Spacecraft whose events the page follows; None: all; "none": there is no event stream.

    "off": the page follows no events.
    """
    reader: str | None = None
    """Name of the signed-in token; None while access is open."""
    may_operate: bool = False
    address: str = ""
    """Address of the service in the reader's browser."""
    alarms: AlarmCounts | None = None
    """Alarms of the run, for the count on every page; None for a page without a run."""
    behind_s: float = 0.0
    """Lag of trends and alarms behind the record, in seconds, if the wait for them was too long."""

    @property
    def is_live(self) -> bool:
        """True if live batches are shown, not a named run."""
        return self.run == LIVE

    @property
    def has_alarms(self) -> bool:
        """True if batches of the shown run can raise alarms."""
        return all(run.has_alarms for run in self.runs if run.name == self.run)

    @property
    def navigation(self) -> list[ConsolePage]:
        """Pages of the navigation, in its order."""
        return navigation()

    @property
    def other_runs(self) -> tuple[RunChoice, ...]:
        """Runs with batches, except the shown one."""
        return tuple(run for run in self.runs if run.batches and run.name != self.run)


EMPTY_LAYOUT = Layout(LIVE, (RunChoice(LIVE, None),), "", "", present())
"""Layout of pages without a reader: sign-in, and errors."""


def open_layout(run: str, title: str, section: str) -> Layout:
    """Layout of a page that needs no token and shows no recorded data."""
    runs = tuple(RunChoice(name, None) for name in dict.fromkeys((LIVE, run)))
    return Layout(run, runs, title, section, now=present(), stream="off")


@dataclass(frozen=True)
class Panel:
    """Part of a page that a feature adds: the name of its template, and `values` for it."""

    template: str
    values: Any


@dataclass(frozen=True)
class PageContext:
    """Context for the handler of a page.

    `last_event` is read before all other data: so the page may hear of an event that it already
    shows, but never misses one.
    """

    app: App
    caller: Caller
    page: ConsolePage
    last_event: int
    address: str

    @property
    def may_operate(self) -> bool:
        """True if the reader may make changes."""
        return "operate" in self.caller.scopes

    def rendered(self, template: str, run: str, **values: Any) -> Response:
        """Render a template as a page of the console about a run."""
        return rendered(template, self._layout(run), **values)

    def panels(self, page: str, *shown: Any) -> list[Any]:
        """Parts that features add to a page, by the name of its handler; `shown` is its content."""
        modules = feature_modules("pages", self.app.settings.features_off)
        makers = (getattr(module, "PANELS", {}).get(page) for module in modules)
        return [panel for make in makers if make is not None for panel in make(self, *shown)]

    def _layout(self, run: str) -> Layout:
        def choice(name: str) -> RunChoice:
            row = known.get(name)
            return RunChoice(name, row.batches, row.alarms) if row else RunChoice(name, None)

        known = {each.run: each for each in self.app.runs.all(self.caller.spacecraft)}
        active = self.app.spacecraft.alarms(run)
        alarms = alarm_counts([each for each in active if self.caller.may_see(each.spacecraft)])
        names = sorted({LIVE, run, *known}, key=lambda name: (name != LIVE, name))
        return Layout(
            run=run,
            runs=tuple(map(choice, names)),
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
        """Names of the spacecraft that the reader may see, including retired ones."""
        return [name for name in sorted(self.app.context.known) if self.caller.may_see(name)]

    @property
    def first_spacecraft(self) -> str:
        """First spacecraft that the reader may see, with a mission if possible.

        A token may be bound only to spacecraft that have no mission file any more.
        """
        return (self.spacecraft or sorted(self.caller.spacecraft or ()))[0]

    def listed(self, spacecraft: str) -> str:
        """Spacecraft of a list: the requested one, the first of a bound token, or empty: all."""
        if spacecraft:
            self.caller.require(spacecraft)
        elif self.caller.spacecraft is not None:
            return self.first_spacecraft
        return spacecraft

    def filled_spacecraft(self, run: str) -> str:
        """First spacecraft with batches in a run, or the first of all."""
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
    """Address of a console page that keeps the shown run."""
    run = query.pop("run", context["layout"].run)
    asked = {} if run == LIVE else {"run": run}
    asked |= {name: value for name, value in query.items() if value is not None}
    return f"{quote(path)}?{urlencode(asked)}" if asked else quote(path)


_DOCUMENTED = re.compile(r'href="(/(?:docs|problems)[^"#]*)')


def _of_run(text: Markup, run: str) -> Markup:
    """Cached HTML of a part of a page, with the shown run in its links to other pages."""
    if run == LIVE:
        return text
    return Markup(_DOCUMENTED.sub(rf'href="\1?{urlencode({"run": run})}', str(text)))


def _data(value: object) -> Markup:
    """Values for a script as a `template` element, escaped like any text."""
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
    """HTML response with a page of the console."""
    text = _ENVIRONMENT.get_template(template).render(layout=layout, **values)
    return HTMLResponse(text, status, headers=dict(HEADERS))


def rendered_part(template: str, **values: Any) -> Markup:
    """Part of a page that depends on neither reader nor run, and can be kept."""
    return Markup(_ENVIRONMENT.get_template(template).render(**values))


_OWN_ADDRESS = re.compile(rb'\b(href|src|action)="/(?!/)')


def below_path(request: Request, page: Response) -> Response:
    """Page whose addresses begin with the path below which a proxy serves the service."""
    root = root_path(request).encode()
    if not root or not isinstance(page, HTMLResponse):
        return page
    body = _OWN_ADDRESS.sub(rb'\1="' + root + b"/", bytes(page.body))
    page.body = body.replace(b"<html ", b'<html data-root="' + root + b'" ', 1)
    page.headers["Content-Length"] = str(len(page.body))
    return page


class PageRoute(APIRoute):
    """Route that answers errors with pages for people."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Handler that answers every expected error with a page."""
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
                    return _failed(request, error)
                answer = _error_page(kind, problem_of(error))
                if isinstance(error, Busy):
                    answer.headers["Retry-After"] = str(error.retry_after_s)
                return below_path(request, answer)
            except (HTTPException, ClientDisconnect):
                # The app has answers of its own to these.
                raise
            except Exception as error:
                # A fault of the service: whoever opened the page reads a page, not JSON.
                return _failed(request, error)

        return handler


def _failed(request: Request, error: Exception) -> Response:
    """Page about an unexpected error, which is logged."""
    problems.internal_error(request, error)
    return below_path(request, _error_page(problems.INTERNAL_ERROR, problems.FAILED))


async def page_or_problem(request: Request, error: Exception) -> Response:
    """Answer to an unknown address: a page for a browser that follows a link, or a problem."""
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

"""API routes for spacecraft: settings, state, attitudes, star rates, and overview."""

from starlette.requests import Request
from starlette.responses import Response

from service.app.fleet import batch_table, history_table
from service.contract import spacecraft as models
from service.contract.answers import Result
from service.contract.events import RecordHead
from service.contract.spacecraft import About, Overview
from service.table_files.formats import JSON_FORMAT, TABLE_FORMATS, write_table
from service.web.openapi import CONTENT_LOCATION, LINK, ApiRouter, ClientMethod, Example, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import AppDep, CallerDep, Policy, json_response, page_response
from service.web.requests.exports import (
    THINNED,
    ExportsDep,
    history_file,
    history_headers,
    thinned_header,
)
from service.web.requests.query_parameters import FromQuery, SpacecraftPath

router = ApiRouter("spacecraft")


@ClientMethod(
    "fleet",
    example="""
    >>> [each.name for each in client.fleet() if each.attitude]
    ['XTE']
    """,
)
@Example("all")
@router.serves(
    "GET /spacecraft",
    Policy("read", "nothing"),
    Returns("Every spacecraft.", models.SpacecraftList),
)
def list_spacecraft(query: FromQuery[params.RunQuery], app: AppDep, caller: CallerDep) -> Response:
    """Every spacecraft with a mission file, with its state in a run."""
    return json_response({"items": app.spacecraft.states(query.run, caller.spacecraft)})


@ClientMethod("spacecraft")
@Example("soho", path={"name": "SOHO"})
@Example("unknown", path={"name": "NOPE"})
@router.serves(
    "GET /spacecraft/{name}",
    Policy("read", "path"),
    Returns("The spacecraft.", models.SpacecraftState),
)
def get_spacecraft(
    name: SpacecraftPath, query: FromQuery[params.RunQuery], app: AppDep, caller: CallerDep
) -> Response:
    """One spacecraft: state in a run, mission settings and their history."""
    return json_response(app.spacecraft.state(name, query.run, caller.spacecraft))


@ClientMethod(
    "latest",
    example="""
    >>> client.latest("XTE").answer.attitude.status
    'good'
    """,
)
@Example("soho", path={"name": "SOHO"})
@Example("empty_run", "run=none")
@router.serves(
    "GET /spacecraft/{name}/latest",
    Policy("read", "path"),
    Returns("The result and its batch.", Result, CONTENT_LOCATION),
)
def get_latest(name: SpacecraftPath, query: FromQuery[params.RunQuery], app: AppDep) -> Response:
    """The newest current result of a run, by batch time; it may have no attitude.

    A live batch that is dated more than an hour in the future counts only where there is no other.
    """
    latest = app.results.latest(name, query.run)
    return json_response(
        latest, headers={"Content-Location": f"/api/v1/batches/{latest.answer.id}"}
    )


@ClientMethod(
    "attitudes",
    example="""
    >>> [round(row.quaternion[3], 4) for row in client.attitudes("XTE")]
    [0.3536]
    >>> client.attitudes("XTE").to_arrow().num_rows
    1
    """,
)
@Example("one", path={"name": "SWAS"})
@router.serves(
    "GET /spacecraft/{name}/attitudes",
    Policy("read", "path"),
    Returns("A page of attitudes.", models.AttitudePage, LINK),
)
def list_attitudes(
    request: Request, name: SpacecraftPath, query: FromQuery[params.PeriodPageQuery], app: AppDep
) -> Response:
    """The attitudes of a run, oldest first by batch time."""
    return page_response(request, app.spacecraft.attitudes(name, **query.asked()))


@ClientMethod(
    "rates",
    example="""
    >>> [(each.start, each.observed) for each in client.rates("XTE")]
    [('1996-01-10T12:00:00.000Z', 4)]
    """,
)
@Example("one_hour")
@router.serves(
    "GET /spacecraft/{name}/rates",
    Policy("read", "path"),
    Returns("The buckets with batches.", models.RateList),
)
def list_rates(name: SpacecraftPath, query: FromQuery[params.RatesQuery], app: AppDep) -> Response:
    """Numbers of stars by outcome, in at most 20,000 buckets of batch time."""
    return json_response(models.RateList(items=app.spacecraft.rates(name, **query.asked())))


@ClientMethod(
    "history",
    by_place=("quantity",),
    renamed={"quantity": "quantities"},
    example="""
    >>> history = client.history("XTE", ["residual_rms_arcsec"])
    >>> history.to_arrow().column_names[-1]
    'residual_rms_arcsec.max'
    """,
)
@Example("one_bucket", "quantity=residual_ratio&size=10")
@Example("latest_batch", "strategy=latest&quantity=ambiguous_share&size=1")
@router.serves(
    "GET /spacecraft/{name}/history",
    Policy("read", "path"),
    Returns("The history, in the requested format.", models.History, THINNED, formats="tables"),
    problems=(503,),
)
def get_history(
    name: SpacecraftPath,
    query: FromQuery[params.HistoryQuery],
    app: AppDep,
    exports: ExportsDep,
    caller: CallerDep,
) -> Response:
    """Histories of quantities over a period.

    Thinned out to as many points as can be drawn, or as a table of every batch.
    """
    where = query.run_and_times
    file = "-".join(filter(None, (name, query.tracker, query.run, "history")))
    if query.of_every_batch:
        pages = app.spacecraft.every_batch(
            name, quantities=query.quantity, tracker=query.tracker, **where
        )
        return exports.response(
            caller,
            lambda: write_table(query.format, batch_table(pages)),
            TABLE_FORMATS[query.format].media_type,
            history_headers(file, query.format, is_thinned=False),
        )
    history = app.spacecraft.history(
        name,
        quantities=query.quantity,
        strategy=query.strategy or "minmax",
        size=query.size or 500,
        tracker=query.tracker,
        **where,
    )
    if query.format != JSON_FORMAT:
        return history_file(history_table(history), query.format, file, is_thinned=history.thinned)
    return json_response(history, headers=thinned_header(history.thinned))


@ClientMethod("worst", by_place=("by",))
@Example("by_ambiguous_share", "limit=1")
@router.serves(
    "GET /spacecraft/{name}/worst",
    Policy("read", "path"),
    Returns("The worst batches.", models.Ranking),
)
def list_worst(name: SpacecraftPath, query: FromQuery[params.WorstQuery], app: AppDep) -> Response:
    """The batches with the worst values of a quantity in a period, worst first."""
    return json_response(app.spacecraft.ranking(name, **query.asked()))


overview_router = ApiRouter("spacecraft")


@Example("live")
@overview_router.serves(
    "GET /overview", Policy("read", "nothing"), Returns("Every spacecraft in the run.", Overview)
)
def get_overview(query: FromQuery[params.RunQuery], app: AppDep, caller: CallerDep) -> Response:
    """Every spacecraft in a run: state, last attitude, the last hour and day, active alarms."""
    return json_response(app.spacecraft.overview(query.run, caller.spacecraft))


@Example("here")
@overview_router.serves(
    "GET /about",
    Policy("read", "nothing"),
    Returns("The version of the service and its data.", About),
)
def get_about(app: AppDep, caller: CallerDep) -> Response:
    """The service's version, start, catalog, database and credits, and the caller's missions."""
    return json_response(app.service.about(caller.spacecraft))


@Example("first")
@overview_router.serves(
    "GET /record/head",
    Policy("read", "nothing"),
    Returns("The last head.", RecordHead),
    problems=(404,),
)
def get_record_head(app: AppDep) -> Response:
    """The last head of the record, to be kept where nobody can write who can change the record."""
    return json_response(app.service.record_head())

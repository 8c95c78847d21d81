"""API routes for calibrations of trackers: start, read, try, adopt and revert."""

from typing import Annotated, Self

from fastapi import Path
from pydantic import AfterValidator, Field, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.access import Caller
from service.app.results import COMPARE_SAMPLE
from service.contract.calibration import CalibrationAdoption, CalibrationInForce
from service.contract.runs import Comparison
from service.errors import NotFound, shown_value
from service.features.calibration import records as models
from service.features.calibration.estimates import CALIBRATION_SAMPLE, CalibrationRequest
from service.features.calibration.linearise import LARGEST_DEGREE
from service.features.calibration.part import Calibrations
from service.observations.schema import LIVE, Key, RunName, Wire
from service.web.api.batches import COMPARISON_S, SampleSize
from service.web.openapi import LINK, LOCATION, ApiRouter, ClientMethod, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    CallerDep,
    ChangeDep,
    Policy,
    json_response,
    page_response,
)
from service.web.requests.query_parameters import FromQuery, Query, SpacecraftPath, Who
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("calibrations")
ROUTERS = (router,)

CalibrationId = Annotated[str, Path(description="The `id` of a calibration.")]


class _Period(Wire):
    """Period of the batches to use."""

    start: params.Start = None
    end: params.End = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        params.require_order(self.start, self.end)
        return self


class CalibrationIn(_Period):
    """Request body for a calibration: the parameters to estimate and the batches to use."""

    spacecraft: Key
    run: RunName = LIVE
    trackers: Annotated[
        tuple[Key, ...],
        Field(max_length=16, description="The first is the reference; empty: all of the mission."),
    ] = ()
    degree: Annotated[
        int | None,
        Field(
            ge=0,
            le=LARGEST_DEGREE,
            strict=True,
            description="Degree of the distortion; 0: none; null: the degree that fits held-out "
            "blocks of time best.",
        ),
    ] = None
    alignment: Annotated[bool, Field(description="Estimate alignment between trackers.")] = True
    scale: Annotated[bool, Field(description="Estimate the scale of measured angles.")] = True
    time_tag: Annotated[
        bool, Field(description="Estimate how much later than sent stars were measured.")
    ] = False
    magnitudes: Annotated[
        bool, Field(description="Estimate zero point, scale and colour term of magnitudes.")
    ] = True
    sample: Annotated[
        int, Field(ge=1, le=10_000, strict=True, description="Maximum number of batches.")
    ] = CALIBRATION_SAMPLE
    who: Who = None

    def request(self) -> CalibrationRequest:
        """Convert the body to a request for the calibration service, without the author."""
        return CalibrationRequest(**{name: getattr(self, name) for name in _ASKED})


_ASKED = tuple(name for name in CalibrationIn.model_fields if name != "who")


class CalibrationTrialIn(_Period):
    """Request body for a trial of a calibration; by default with the calibration's run."""

    run: RunName | None = None
    sample: SampleSize = COMPARE_SAMPLE


class _Signed(Wire):
    """Author and note of a change of the calibration in force."""

    who: Who = None
    note: Annotated[
        str,
        Field(max_length=2_000, description="The reason, in plain text."),
        AfterValidator(params.without_nul),
    ] = ""


class CalibrationAdoptIn(_Signed):
    """Request body for the adoption of a calibration."""


class CalibrationRevertIn(_Signed):
    """Request body to return to an earlier adoption or to the mission file."""

    to: Annotated[
        Key | None, Field(description="The `id` of an earlier adoption; null: the mission file.")
    ] = None


class CalibrationQuery(Query):
    """Query that selects calibrations by spacecraft."""

    spacecraft: params.SpacecraftFilter = None
    limit: params.PageLimit = 100
    cursor: params.Cursor = None


@ClientMethod(
    "calibrations",
    by_place=("spacecraft",),
    example="""
    >>> [each.version for each in client.calibrations("XTE")]
    []
    """,
)
@router.serves(
    "GET /calibrations",
    Policy("read", "query"),
    Returns("A page of calibrations.", models.CalibrationPage, LINK),
)
def list_calibrations(
    request: Request, query: FromQuery[CalibrationQuery], app: AppDep
) -> Response:
    """Calibrations without covariances and residual maps, newest first."""
    return page_response(request, app.part(Calibrations).page(**query.asked()))


@ClientMethod("calibrate", by_place=("spacecraft",), omitted=("sample",))
@router.serves(
    "POST /calibrations",
    Policy("operate", "body"),
    Returns("The calibration, which is computed now.", models.Calibration, LOCATION, status=202),
    body=CalibrationIn,
    problems=(404,),
)
def start_calibration(body: JsonBody, app: AppDep, change: ChangeDep) -> Response:
    """Estimate alignment, scale and distortion of trackers; no setting is changed."""
    asked = read_model(CalibrationIn, body)
    change.caller.require(asked.spacecraft)
    begun = app.part(Calibrations).start(
        asked.request(), change.author(asked.who), change.entry(202)
    )
    return json_response(begun, 202, {"Location": f"/api/v1/calibrations/{begun.id}"})


@ClientMethod("calibration")
@router.serves(
    "GET /calibrations/{id}",
    # A token bound to spacecraft may use calibrations of these only: the handlers check it.
    Policy("read", "nothing"),
    Returns("The calibration.", models.Calibration),
)
def get_calibration(id: CalibrationId, app: AppDep, caller: CallerDep) -> Response:
    """One calibration with covariance and residual maps."""
    return json_response(_visible(app, id, caller))


@router.serves(
    "POST /calibrations/{id}/trial",
    Policy("read", "nothing"),
    Returns("In force (a), and with the calibration (b).", Comparison),
    body=CalibrationTrialIn,
    problems=(409,),
)
def try_calibration(id: CalibrationId, body: JsonBody, app: AppDep, caller: CallerDep) -> Response:
    """Process recorded batches again with and without a calibration; nothing is recorded."""
    asked = read_model(CalibrationTrialIn, body)
    _visible(app, id, caller)
    return json_response(app.part(Calibrations).trial(id, **vars(asked), limit_s=COMPARISON_S))


@ClientMethod("adopt_calibration")
@router.serves(
    "POST /calibrations/{id}/adopt",
    Policy("operate", "nothing"),
    Returns("The adoption.", CalibrationAdoption),
    body=CalibrationAdoptIn,
    problems=(409,),
)
def adopt_calibration(
    id: CalibrationId, body: JsonBody, app: AppDep, change: ChangeDep
) -> Response:
    """Process new batches of the spacecraft with a calibration from now on."""
    asked = read_model(CalibrationAdoptIn, body)
    _visible(app, id, change.caller)
    who = change.author(asked.who)
    return json_response(app.part(Calibrations).adopt(id, who, asked.note, change.entry()))


@ClientMethod(
    "calibration_in_force",
    example="""
    >>> in_force = client.calibration_in_force("XTE")
    >>> in_force.calibration, in_force.history
    (None, [])
    """,
)
@router.serves(
    "GET /spacecraft/{name}/calibration",
    Policy("read", "path"),
    Returns("The calibration in force.", CalibrationInForce),
)
def get_calibration_in_force(name: SpacecraftPath, app: AppDep) -> Response:
    """The calibration in force for new batches of a spacecraft, and the history of adoptions."""
    return json_response(app.adoptions.in_force(name))


@ClientMethod("revert_calibration", by_place=("to",))
@router.serves(
    "POST /spacecraft/{name}/calibration/revert",
    Policy("operate", "path"),
    Returns("The change.", CalibrationAdoption),
    body=CalibrationRevertIn,
    problems=(409,),
)
def revert_calibration(
    name: SpacecraftPath, body: JsonBody, app: AppDep, change: ChangeDep
) -> Response:
    """Return to an earlier adopted calibration, or to the mission file."""
    asked = read_model(CalibrationRevertIn, body)
    who = change.author(asked.who)
    return json_response(app.adoptions.revert(name, asked.to, who, asked.note, change.entry()))


def _visible(app: AppDep, id: str, caller: Caller) -> models.Calibration:
    """A calibration that the caller may see; raises `NotFound` for other callers' spacecraft."""
    found = app.part(Calibrations).get(id)
    if not caller.may_see(found.spacecraft):
        raise NotFound(f"there is no calibration with the id {shown_value(id)}")
    return found

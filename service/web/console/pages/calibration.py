"""The page of a spacecraft's calibration: what was found, what it would change, what holds."""

from collections.abc import Callable, Sequence
from typing import Annotated

from pydantic import Field
from starlette.responses import Response

from service.app.calibration_estimates import CALIBRATION_SAMPLE
from service.calibration.linearise import LARGEST_DEGREE
from service.errors import NotFound
from service.storage.calibrations import Calibration, CalibrationSummary
from service.storage.recording.unsaved_result import LIVE
from service.web.console.charts.calibration_history import parameter_histories
from service.web.console.charts.focal_plane import residual_pictures
from service.web.console.page import ContextDep, FromQuery, PageContext, PageQuery, console_page
from service.web.requests.access import Policy

SHOWN = 50
CERTAIN_SIGMAS = 3.0


class CalibrationPageQuery(PageQuery):
    """Which version; by default the latest that is done."""

    version: Annotated[int | None, Field(ge=1)] = None


@console_page(
    "/spacecraft/{name}/calibration", "Calibration", Policy("read", "path"), section="/missions"
)
def calibration_page(
    name: str, query: FromQuery[CalibrationPageQuery], context: ContextDep
) -> Response:
    """Residual maps, parameters and their history, and what was adopted when."""
    app = context.app
    in_force = app.adoptions.in_force(name)
    versions = app.calibrations.page(name, SHOWN).items
    shown = _shown(app.calibrations.get, versions, query.version)
    result = shown.result if shown else None
    return context.rendered(
        "calibration.html.jinja",
        query.run,
        name=name,
        in_force=in_force,
        holding=next((each for each in in_force.history if in_force.calibration), None),
        versions=versions,
        unfinished=[each for each in versions if each.state in ("queued", "running")],
        shown=shown,
        result=result,
        pictures=[residual_pictures(each) for each in result.maps] if result else [],
        certain=CERTAIN_SIGMAS,
        corrects=result is not None
        and any(abs(each.value) > each.sigma for each in result.unknowns),
        trackers=app.adoptions.file_of(name).trackers,
        recorded=_recorded(context, name),
        histories=parameter_histories(versions, app.adoptions.file_of(name)),
        largest_degree=LARGEST_DEGREE,
        sample=CALIBRATION_SAMPLE,
        may_write=context.may_operate,
    )


def _recorded(context: PageContext, name: str) -> int:
    """How many live batches of a spacecraft there are."""
    live = [each for each in context.app.runs.all([name]) if each.run == LIVE]
    return live[0].batches if live else 0


def _shown(
    read: Callable[[str], Calibration], versions: Sequence[CalibrationSummary], version: int | None
) -> Calibration | None:
    """The version that is asked for, or the latest that is done; raises `NotFound`."""
    for each in versions:
        if each.version == version or (version is None and each.state == "done"):
            return read(each.id)
    if version is not None:
        raise NotFound(f"there is no version {version} among the latest {SHOWN}")
    return None

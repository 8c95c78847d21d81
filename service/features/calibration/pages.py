"""Console page for the calibration of a spacecraft: results, changes, settings in force."""

from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from starlette.responses import Response

from service.contract.calibration import TrackerGeometry
from service.errors import NotFound
from service.features.calibration.estimates import CALIBRATION_SAMPLE
from service.features.calibration.focal_plane import residual_pictures
from service.features.calibration.linearise import LARGEST_DEGREE
from service.features.calibration.magnitudes import COLOR, SCALE
from service.features.calibration.part import Calibrations
from service.features.calibration.records import Calibration, CalibrationSummary
from service.ingest.missions_in_force import geometry_of
from service.missions.mission import AS_MEASURED, Mission
from service.observations.schema import LIVE
from service.sky.catalog.run_catalog import UNKNOWN_COLOR_BV_MAG
from service.vectors import ARCSEC_PER_RADIAN
from service.web.console.page import ContextDep, FromQuery, PageContext, PageQuery, console_page
from service.web.requests.access import Policy

STAR_MAG = 5.0
"""V magnitude of the star, with the Sun's colour, at which zero points are compared."""


def parameters(found: CalibrationSummary, file: Mission) -> dict[str, tuple[float, float]]:
    """Alignment, scale, magnitudes and time tags of a calibration version, each with its sigma.

    All values are relative to the mission file, whatever settings were in force at the estimate.
    """
    own = {each.name: each for each in found.trackers}
    files = {each.name: each for each in file.trackers}
    files_geometry = [geometry_of(each) for each in file.trackers]
    values = {}
    for each in found.unknowns:
        if each.tracker not in own or each.tracker not in files:
            continue
        if each.kind == "alignment":
            turned = _turned_arcsec(own[each.tracker], files[each.tracker].body_from_tracker)
            value = turned["xyz".index(each.name[-1])]
        elif each.kind == "scale":
            value = own[each.tracker].calibration.scale - files[each.tracker].calibration.scale
        elif each.kind == "time_tag":
            value = each.value
        elif each.kind == "magnitude":
            value = _of_magnitudes(each.name, found.trackers, each.tracker)
            value -= _of_magnitudes(each.name, files_geometry, each.tracker)
        else:
            continue
        values[each.name if each.unit == "1" else f"{each.name}, {each.unit}"] = value, each.sigma
    return values


def _of_magnitudes(name: str, trackers: Sequence[TrackerGeometry], tracker: str) -> float:
    """Value of a magnitude unknown in a tracker's settings.

    For a zero point, the measured magnitude of a star of `STAR_MAG`; for a scale, the measured
    magnitudes per catalog magnitude; or the colour term.
    """
    own = {each.name: each.magnitudes or AS_MEASURED for each in trackers}
    if name.endswith(COLOR):
        return own[tracker].color_mag
    if name.endswith(SCALE):
        return 1.0 / own[tracker].scale
    color_mag = sum(each.color_mag for each in own.values()) / len(own)
    instrument_mag = STAR_MAG + color_mag * UNKNOWN_COLOR_BV_MAG
    return (instrument_mag - own[tracker].zero_mag) / own[tracker].scale


def _turned_arcsec(tracker: TrackerGeometry, before: np.ndarray) -> list[float]:
    """Rotation vector about the body axes between two alignments, in arcsec; small angles."""
    axes = [tracker.x_axis_body, tracker.y_axis_body, tracker.z_axis_body]
    turn = np.column_stack(axes) @ before.T
    vector = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    return [float(part) / 2.0 * ARCSEC_PER_RADIAN for part in vector]


SHOWN = 50
CERTAIN_SIGMAS = 3.0


class CalibrationPageQuery(PageQuery):
    """Query that selects a version of the calibration; by default the latest that is done."""

    version: Annotated[int | None, Field(ge=1)] = None


@console_page(
    "/spacecraft/{name}/calibration", "Calibration", Policy("read", "path"), section="/missions"
)
def calibration_page(
    name: str, query: FromQuery[CalibrationPageQuery], context: ContextDep
) -> Response:
    """Console page with residual maps, parameter history and adoptions of a calibration."""
    app = context.app
    in_force = app.adoptions.in_force(name)
    versions = app.part(Calibrations).page(name, SHOWN).items
    shown = _shown(app.part(Calibrations).get, versions, query.version)
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
        parameters={each.id: parameters(each, app.adoptions.file_of(name)) for each in versions},
        largest_degree=LARGEST_DEGREE,
        sample=CALIBRATION_SAMPLE,
        may_write=context.may_operate,
    )


def _recorded(context: PageContext, name: str) -> int:
    """Number of recorded live batches of a spacecraft."""
    live = [each for each in context.app.runs.all([name]) if each.run == LIVE]
    return live[0].batches if live else 0


def _shown(
    read: Callable[[str], Calibration], versions: Sequence[CalibrationSummary], version: int | None
) -> Calibration | None:
    """Requested version of a calibration, or the latest done one or None; raises `NotFound`."""
    for each in versions:
        if each.version == version or (version is None and each.state == "done"):
            return read(each.id)
    if version is not None:
        raise NotFound(f"there is no version {version} among the latest {SHOWN}")
    return None

"""What a calibration found, as it is recorded and shown."""

import math
from collections.abc import Iterator
from itertools import chain

import numpy as np

from service.app.calibrations.estimates import CalibrationRun
from service.app.calibrations.geometry import calibrated_geometry, mission_file_lines
from service.calibration.estimate import Calibration
from service.calibration.magnitudes import UNITS
from service.calibration.observability import NotObservable
from service.storage.calibrations import (
    CalibrationBatches,
    CalibrationHeldOut,
    CalibrationNotObservable,
    CalibrationResiduals,
    CalibrationResult,
    CalibrationUnknown,
    ResidualCell,
    ResidualMap,
)
from service.vectors import ARCSEC_PER_RADIAN, Vector

VECTORS = (
    "scale and distortion in a mission file correct stars sent as angles (h_deg, v_deg) only, "
    "not those sent as vectors"
)
TIME_TAGS = "mission files hold no time tag: add it to time_offset_s where telemetry is made"
COLORS = (
    "the colour terms of the trackers differ: the run catalog is one for all and has their mean, "
    "so that magnitudes of very blue and very red stars stay off"
)
MAP_CELLS = 12
"""Cells of a residual map across the field of view."""


def result_of(run: CalibrationRun) -> CalibrationResult:
    """A calibration as a record, without its covariance."""
    found = run.found
    return CalibrationResult(
        batches=CalibrationBatches(
            total=run.total,
            sampled=run.sampled,
            used=run.used,
            refused=run.refused,
            first=run.first,
            last=run.last,
        ),
        stars=len(found.stars),
        stars_left_out=int(np.sum(~found.used)),
        degree=found.model.degree,
        held_out=[
            CalibrationHeldOut(
                degree=each.degree,
                residual_over_sigma=each.residual_over_sigma,
                chosen=each.chosen,
            )
            for each in run.tried
        ],
        residual_over_sigma=found.residual_over_sigma,
        residuals=residuals_by_tracker(found),
        unknowns=unknowns_of(run),
        not_observable=[
            CalibrationNotObservable(name=each.name, reason=each.reason)
            for each in not_observable_of(run)
        ],
        notes=notes(run),
        maps=list(_maps(found)),
        trackers=calibrated_geometry(run.mission, found, run.calibrated_magnitudes),
        mission_file=mission_file_lines(run.mission, found, run.calibrated_magnitudes),
    )


def unknowns_of(run: CalibrationRun) -> list[CalibrationUnknown]:
    """The names of the estimated parameters, in the order of the covariance."""
    found = run.found
    names = [each.name for each in found.stars.trackers]
    of_positions = [
        CalibrationUnknown(
            name=unknown.name,
            tracker=names[unknown.tracker],
            kind=unknown.kind,
            value=float(value),
            sigma=float(sigma),
            unit=unknown.unit,
        )
        for unknown, value, sigma in zip(found.unknowns, found.value, found.sigma, strict=True)
    ]
    return of_positions + [
        CalibrationUnknown(
            name=f"{names[each.tracker]} {name}",
            tracker=names[each.tracker],
            kind="magnitude",
            value=float(value),
            sigma=float(sigma),
            unit=UNITS[name],
        )
        for each in run.magnitudes
        for name, value, sigma in zip(each.names, each.value, each.sigma, strict=True)
    ]


def not_observable_of(run: CalibrationRun) -> list[NotObservable]:
    """What the stars do not show."""
    of_magnitudes = (each.not_observable for each in run.magnitudes)
    return [*run.found.not_observable, *chain.from_iterable(of_magnitudes)]


def residuals_by_tracker(found: Calibration) -> list[CalibrationResiduals]:
    """Of each tracker the rms of the residuals of used stars, before and after."""
    sigma_arcsec = found.stars.sigma_rad[:, None] * ARCSEC_PER_RADIAN
    rows = []
    for index, tracker in enumerate(found.stars.trackers):
        own = found.used & (found.stars.tracker == index)
        if own.any():
            rows.append(
                CalibrationResiduals(
                    tracker=tracker.name,
                    stars=int(own.sum()),
                    before_arcsec=_rms((found.before * sigma_arcsec)[own]),
                    after_arcsec=_rms((found.residual * sigma_arcsec)[own]),
                    before_over_sigma=_rms(found.before[own]),
                    after_over_sigma=_rms(found.residual[own]),
                )
            )
    return rows


def _rms(values: Vector) -> float:
    return math.sqrt(float(np.mean(values**2)))


def notes(run: CalibrationRun) -> list[str]:
    """What a mission file cannot hold of this calibration."""
    kinds = {each.kind for each in run.found.unknowns}
    told = [VECTORS] if kinds & {"scale", "distortion"} else []
    told += [TIME_TAGS] if "time_tag" in kinds else []
    return told + ([COLORS] if _colors_differ(run) else [])


def _colors_differ(run: CalibrationRun) -> bool:
    """Whether the calibrated trackers do not have one colour term within the noise of a star."""
    settings = run.calibrated_magnitudes
    colors = [settings[each.name].color_mag for each in run.mission.trackers]
    least = min(each.magnitude_sigma_mag for each in run.mission.trackers)
    return max(colors) - min(colors) > least


def _maps(found: Calibration) -> Iterator[ResidualMap]:
    """The mean residuals of used stars in the cells of each tracker's focal plane."""
    sigma_arcsec = found.stars.sigma_rad[:, None] * ARCSEC_PER_RADIAN
    both = np.hstack([found.before * sigma_arcsec, found.residual * sigma_arcsec])
    measured_deg = np.degrees(found.stars.measured_rad)
    for index, tracker in enumerate(found.stars.trackers):
        own = found.used & (found.stars.tracker == index)
        radius = tracker.field_of_view_radius_deg
        step = 2.0 * radius / MAP_CELLS
        cells = np.clip(np.floor((measured_deg[own] + radius) / step), 0, MAP_CELLS - 1)
        places, inverse, counts = np.unique(
            cells.astype(int), axis=0, return_inverse=True, return_counts=True
        )
        sums = np.zeros((len(places), 4))
        np.add.at(sums, inverse.reshape(-1), both[own])
        means = np.round(sums / counts[:, None], 4)
        yield ResidualMap(
            tracker=tracker.name,
            radius_deg=radius,
            step_deg=step,
            cells=[
                ResidualCell(
                    h_deg=round((place[0] + 0.5) * step - radius, 6),
                    v_deg=round((place[1] + 0.5) * step - radius, 6),
                    stars=int(count),
                    before_arcsec=mean[:2].tolist(),
                    after_arcsec=mean[2:].tolist(),
                )
                for place, count, mean in zip(places.tolist(), counts, means, strict=True)
            ],
        )

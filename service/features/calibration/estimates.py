"""Calibration of trackers from recorded batches: request, sampling, estimate and report."""

import math
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from msgspec import structs

from service.acquire import Acquisition
from service.app.context import Context
from service.contract.calibration import TrackerGeometry
from service.errors import BadInput, Busy, Fault, Stopping, shown_value
from service.features.calibration import records
from service.features.calibration.elimination import NotObservable
from service.features.calibration.estimate import (
    Calibration,
    HeldOut,
    calibrate,
    calibrate_with_chosen_degree,
)
from service.features.calibration.evidence import identified_magnitudes, identified_stars
from service.features.calibration.linearise import LARGEST_DEGREE, Model
from service.features.calibration.magnitudes import (
    UNITS,
    MagnitudeCalibration,
    MagnitudeStars,
    calibrate_magnitudes,
    calibrated_settings,
)
from service.features.calibration.magnitudes import joined as joined_magnitudes
from service.features.calibration.mission_file import Lines, magnitude_lines, tracker_lines
from service.features.calibration.stars import IdentifiedStars, joined
from service.ingest.missions_in_force import geometry_of
from service.ingest.submit import SubmissionService
from service.missions.mission import Calibration as FocalPlaneSettings
from service.missions.mission import Magnitudes, Mission, Tracker
from service.observations.batch import ObservationBatch
from service.observations.schema import LIVE
from service.storage.queries.pages import ResultFilter
from service.storage.queries.results import sample_batches
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

CALIBRATION_SAMPLE = 2_000
LARGEST_CHOSEN_DEGREE = 5
LONGEST_WAIT_S = 120.0
"""Longest wait in seconds for a free thread of the solver."""

Step = Callable[[int, int], object]
"""Callback for progress after each batch: number done, total number."""


@dataclass(frozen=True)
class CalibrationRequest:
    """Request for a calibration: the unknowns to estimate, and the batches to use.

    Without `trackers` all of the mission's are calibrated; the first one is the reference.  Without
    a `degree` the distortion's is chosen, up to `LARGEST_CHOSEN_DEGREE`.
    """

    spacecraft: str
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None
    trackers: Sequence[str] = ()
    degree: int | None = None
    alignment: bool = True
    scale: bool = True
    time_tag: bool = False
    magnitudes: bool = True
    sample: int = CALIBRATION_SAMPLE

    def require(self, mission: Mission, trackers_field: str = "trackers") -> None:
        """Raise `BadInput` for an unknown tracker, a bad degree, or a model without unknowns."""
        for name in self.trackers:
            mission.tracker(name, trackers_field)
        if self.degree is not None and not 0 <= self.degree <= LARGEST_DEGREE:
            message = f"must be from 0 to {LARGEST_DEGREE}"
            raise BadInput(Fault("degree", message, shown_value(self.degree)))
        if self.degree == 0 and not (self.alignment or self.scale or self.time_tag):
            raise BadInput(Fault("degree", "leaves nothing to estimate", "0"))

    def model(self, degree: int) -> Model:
        """Calibration model with the requested unknowns and a distortion of a degree."""
        return Model(self.alignment, self.scale, degree, time_tag=self.time_tag)


@dataclass(frozen=True)
class CalibrationRun:
    """An estimated calibration with the batches used for it.

    `total` batches are in the period, `sampled` were processed again and `used` had identified
    stars; `refused` no longer fit the mission.  `tried` is empty if the degree was requested.
    """

    mission: Mission
    found: Calibration
    tried: tuple[HeldOut, ...]
    total: int
    sampled: int
    used: int
    refused: int
    first: str | None
    last: str | None
    magnitudes: tuple[MagnitudeCalibration, ...] = ()
    """Magnitude calibration of each calibrated tracker; empty if not requested."""

    @property
    def calibrated_magnitudes(self) -> dict[str, Magnitudes]:
        """Magnitude settings of every tracker by name, updated with the calibration."""
        names = [each.name for each in self.found.stars.trackers]
        return calibrated_settings(self.mission.trackers, self.magnitudes, names)

    @property
    def covariance(self) -> Matrix:
        """Covariance of all unknowns; magnitudes are last, uncorrelated with the others."""
        blocks = [self.found.covariance, *(each.covariance for each in self.magnitudes)]
        size = sum(len(each) for each in blocks)
        whole, first = np.zeros((size, size)), 0
        for each in blocks:
            end = first + len(each)
            whole[first:end, first:end] = each
            first = end
        return whole


class Estimator:
    """Estimates calibrations from recorded batches, without recording them or changing settings."""

    def __init__(self, context: Context, submissions: SubmissionService) -> None:
        self._context = context
        self._submissions = submissions

    def estimate(
        self,
        wanted: CalibrationRequest,
        mission: Mission,
        step: Step = lambda done, total: None,
    ) -> CalibrationRun:
        """Calibrate the trackers of a mission from batches of a run.

        Batches are processed again with verified identification, which does not depend on the
        tolerances.  Raises `BadInput` if there are too few identified stars.
        """
        names = set(wanted.trackers or (each.name for each in mission.trackers))
        selected = ResultFilter(wanted.run or LIVE, wanted.spacecraft, wanted.start, wanted.end)
        with self._context.reading() as connection:
            drawn = sample_batches(connection, self._context.store.archive, selected, wanted.sample)
        parts: list[IdentifiedStars] = []
        seen: list[MagnitudeStars] = []
        color_bv_mag = self._context.sky.catalog.color_bv_mag
        refused = 0
        for number, batch in enumerate(drawn.batches, 1):
            options = structs.replace(batch.options, identifier="verified", solver="quest")
            try:
                again = self._run_again(structs.replace(batch, options=options), mission)
                stars = identified_stars(again, names)
            except BadInput:
                refused += 1
            else:
                parts += [] if stars is None else [stars]
                magnitudes = identified_magnitudes(again, names, color_bv_mag)
                seen += [] if magnitudes is None else [magnitudes]
            step(number, len(drawn.batches))
        if not parts:
            message = "have no identified stars: there is nothing to calibrate with"
            raise BadInput(Fault("batches", message, f"{len(drawn.batches)} batches"))
        found, tried = _calibrated(joined(parts), wanted)
        counts = drawn.total, len(drawn.batches), len(parts), refused
        used = [each.name for each in found.stars.trackers]
        of_magnitudes: tuple[MagnitudeCalibration, ...] = ()
        if wanted.magnitudes:
            settings = {each.name: each.magnitudes for each in mission.trackers}
            of_magnitudes = calibrate_magnitudes(joined_magnitudes(seen), used, settings)
        ends = drawn.first, drawn.last
        return CalibrationRun(mission, found, tried, *counts, *ends, of_magnitudes)

    def _run_again(self, batch: ObservationBatch, mission: Mission) -> Acquisition:
        """Acquire a recorded batch again, waiting while the solver's threads are busy."""
        until_s = time.monotonic() + LONGEST_WAIT_S
        while True:
            try:
                return self._submissions.run_again(batch, mission.within_zones)
            except Stopping:
                raise
            except Busy:
                if time.monotonic() > until_s:
                    raise


def _calibrated(
    stars: IdentifiedStars, wanted: CalibrationRequest
) -> tuple[Calibration, tuple[HeldOut, ...]]:
    """Calibrate with the requested degree, or the best degree that the number of stars allows."""
    if wanted.degree is not None:
        return calibrate(stars, wanted.model(wanted.degree)), ()
    for degree in range(LARGEST_CHOSEN_DEGREE, 0, -1):
        try:
            return calibrate_with_chosen_degree(stars, wanted.model(degree))
        except BadInput:
            continue
    return calibrate_with_chosen_degree(stars, wanted.model(0))


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
"""Number of cells across the field of view in a map of residuals."""


def result_of(run: CalibrationRun) -> records.CalibrationResult:
    """Convert an estimated calibration to an API record, without its covariance."""
    found = run.found
    return records.CalibrationResult(
        batches=records.CalibrationBatches(
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
            records.CalibrationHeldOut(
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
            records.CalibrationNotObservable(name=each.name, reason=each.reason)
            for each in not_observable_of(run)
        ],
        notes=notes(run),
        maps=list(_maps(found)),
        trackers=calibrated_geometry(run.mission, found, run.calibrated_magnitudes),
        mission_file=mission_file_lines(run.mission, found, run.calibrated_magnitudes),
    )


def unknowns_of(run: CalibrationRun) -> list[records.CalibrationUnknown]:
    """Estimated parameters with values and sigmas, in the order of the covariance."""
    found = run.found
    names = [each.name for each in found.stars.trackers]
    of_positions = [
        records.CalibrationUnknown(
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
        records.CalibrationUnknown(
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
    """Parameters that the stars do not determine, of positions and of magnitudes."""
    of_magnitudes = (each.not_observable for each in run.magnitudes)
    return [*run.found.not_observable, *chain.from_iterable(of_magnitudes)]


def residuals_by_tracker(found: Calibration) -> list[records.CalibrationResiduals]:
    """Root mean square residuals of each tracker's used stars, before and after calibration."""
    sigma_arcsec = found.stars.sigma_rad[:, None] * ARCSEC_PER_RADIAN
    rows = []
    for index, tracker in enumerate(found.stars.trackers):
        own = found.used & (found.stars.tracker == index)
        if own.any():
            rows.append(
                records.CalibrationResiduals(
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
    """Remarks on results of a calibration that a mission file cannot hold."""
    kinds = {each.kind for each in run.found.unknowns}
    remarks = [VECTORS] if kinds & {"scale", "distortion"} else []
    remarks += [TIME_TAGS] if "time_tag" in kinds else []
    return remarks + ([COLORS] if _colors_differ(run) else [])


def _colors_differ(run: CalibrationRun) -> bool:
    """True if the colour terms of calibrated trackers differ by more than the noise of one star."""
    settings = run.calibrated_magnitudes
    colors = [settings[each.name].color_mag for each in run.mission.trackers]
    least = min(each.magnitude_sigma_mag for each in run.mission.trackers)
    return max(colors) - min(colors) > least


def _maps(found: Calibration) -> Iterator[records.ResidualMap]:
    """Mean residuals of used stars in cells of each tracker's focal plane."""
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
        yield records.ResidualMap(
            tracker=tracker.name,
            radius_deg=radius,
            step_deg=step,
            cells=[
                records.ResidualCell(
                    h_deg=round((place[0] + 0.5) * step - radius, 6),
                    v_deg=round((place[1] + 0.5) * step - radius, 6),
                    stars=int(count),
                    before_arcsec=mean[:2].tolist(),
                    after_arcsec=mean[2:].tolist(),
                )
                for place, count, mean in zip(places.tolist(), counts, means, strict=True)
            ],
        )


def calibrated_geometry(
    mission: Mission, found: Calibration, magnitudes: Mapping[str, Magnitudes]
) -> list[TrackerGeometry]:
    """Geometry of every tracker of a mission, updated with a calibration."""
    return [
        _calibrated_tracker(
            each.model_copy(update={"magnitudes": magnitudes[each.name]}),
            tracker_lines(each, found),
        )
        for each in mission.trackers
    ]


def _calibrated_tracker(tracker: Tracker, changes: dict[str, Lines]) -> TrackerGeometry:
    own: dict[str, Any] = {
        name: tuple(value) for name, value in _values(changes["tracker"]).items()
    }
    if changes["calibration"]:
        values = _values(changes["calibration"])
        own["calibration"] = FocalPlaneSettings.model_validate(values)
    return geometry_of(tracker.model_copy(update=own))


def _values(lines: Lines) -> dict[str, Any]:
    return tomllib.loads("\n".join(f"{key} = {value}" for key, value in lines.items()))


def mission_file_lines(
    mission: Mission, found: Calibration, magnitudes: Mapping[str, Magnitudes]
) -> str:
    """Lines of a mission file that a calibration changes, as TOML."""
    parts = []
    for each in mission.trackers:
        changes = tracker_lines(each, found)
        changes["magnitudes"] = magnitude_lines(magnitudes[each.name], each)
        lines = [f"{key} = {value}" for key, value in changes["tracker"].items()]
        for table in ("calibration", "magnitudes"):
            if changes[table]:
                lines += ["", f"[trackers.{table}]"]
                lines += [f"{key} = {value}" for key, value in changes[table].items()]
        if lines:
            parts.append("\n".join(["[[trackers]]", f'name = "{each.name}"', *lines]))
    return "\n\n".join(parts)

"""Measurement of star candidates: centroids with predicted errors, flags, light and magnitude."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.features.pictures.centroids.centroid import centroid
from service.features.pictures.centroids.psf import ColouredPsf, Psf
from service.features.pictures.centroids.shape_fit import fit_in_its_colour
from service.features.pictures.centroids.window import CentroidRecord, Window, cutout
from service.features.pictures.detection.cosmic_rays import hits_under
from service.features.pictures.detection.detect import MESH_PX, Detections, detector_of
from service.features.pictures.detection.star_images import core_share, psf_of
from service.features.pictures.frames.frame import Frame
from service.missions.camera import Camera, CentroidMethod
from service.missions.mission import Tracker
from service.vectors import Vector

MARGIN_PX = 2
"""Margin of pixels about the square of a centroid, so that the square may follow the star."""
FAINT_SHARE = 0.4
"""Share of the faintest wanted star's light that is above the threshold; the rest lies below it."""


@dataclass(frozen=True)
class MeasuredStar:
    """One measured candidate: centroid, instrument magnitude, and the reason if in no batch."""

    record: CentroidRecord
    magnitude_mag: float
    left_out: str | None = None


def measure(
    frame: Frame,
    found: Detections,
    tracker: Tracker,
    camera: Camera,
    rates_deg_per_s: Vector,
    method: CentroidMethod,
    faintest_mag: float,
) -> list[MeasuredStar]:
    """The candidates brighter than a magnitude, measured, the brightest first.

    Each is measured alone first. Candidates with others in their window are measured again with the
    light of the others subtracted, and those hit by cosmic rays without the hit pixels.
    """
    exposure_s = frame.exposure_s or camera.exposure_s
    detector = detector_of(frame, found.background_counts, found.noise_counts, camera)
    wanted = (
        FAINT_SHARE * core_share(camera) * camera.flux_counts(np.array(faintest_mag), exposure_s)
    )
    # Without a zero point no candidate is known to be too faint.
    bright = np.count_nonzero(~(found.flux_counts < wanted))
    count = min(int(bright), 2 * camera.most_stars)
    psfs = psf_of(camera, tracker, rates_deg_per_s, exposure_s)(
        found.u_px[:count], found.v_px[:count]
    )
    half = camera.centroid_half_width_px
    windows = [
        cutout(
            frame.counts,
            float(found.u_px[k]),
            float(found.v_px[k]),
            half + MARGIN_PX,
            detector,
            found.background_counts,
            found.noise_counts / MESH_PX,
            found.good,
        )
        for k in range(count)
    ]
    windows = [dataclasses.replace(w, counts=w.counts - camera.bias_counts) for w in windows]
    if found.images is not None:
        windows = [
            found.images.behind(window, int(own) if own >= 0 else None)
            for window, own in zip(windows, found.image_of[:count], strict=True)
        ]
    starts = list(zip(found.u_px.tolist(), found.v_px.tolist(), strict=True))

    def placed(window: Window, k: int) -> CentroidRecord:
        if isinstance(psfs[k], ColouredPsf):
            at = starts[k][0] - window.corner_u_px, starts[k][1] - window.corner_v_px
            _, psfs[k] = fit_in_its_colour(window, psfs[k], at, half)
        return centroid(window, method, psfs[k], starts[k], half)

    records = [placed(windows[k], k) for k in range(count)]
    for k, near in enumerate(_neighbours(found, count, half + MARGIN_PX + 2)):
        window = _without(windows[k], near, records, found, psfs) if near else windows[k]
        if near:
            records[k] = placed(window, k)
        if records[k].usable and (hits := hits_under(window, psfs[k], records[k])).any():
            clean = dataclasses.replace(window, good=window.usable & ~hits)
            records[k] = placed(clean, k)
    flux = np.array([record.flux_counts for record in records], dtype=np.float64)
    magnitudes = camera.magnitude(flux, exposure_s)
    return chosen_stars(records, magnitudes.tolist(), faintest_mag, camera.most_stars)


def _neighbours(found: Detections, count: int, reach_px: float) -> list[list[int]]:
    """Indices of candidates with light in the window of each of the first `count` candidates.

    Bright stars whose images are already part of the background are not counted.
    """
    u, v = found.u_px, found.v_px
    whole = found.image_of < 0
    return [
        [
            int(other)
            for other in np.flatnonzero(
                whole & (np.maximum(abs(u - u[k]), abs(v - v[k])) < reach_px)
            )
            if other != k
        ]
        for k in range(count)
    ]


def _without(
    window: Window,
    others: Sequence[int],
    records: Sequence[CentroidRecord],
    found: Detections,
    psfs: Sequence[Psf],
) -> Window:
    """The window of one star with the images of other stars subtracted."""
    rows, columns = window.counts.shape
    u = np.arange(columns)[None, :] + window.corner_u_px
    v = np.arange(rows)[:, None] + window.corner_v_px
    counts = window.counts.copy()
    for other in others:
        at_u, at_v, flux = found.u_px[other], found.v_px[other], found.flux_counts[other]
        if other < len(records) and records[other].usable:
            record = records[other]
            at_u, at_v, flux = record.u_px, record.v_px, record.flux_counts
        shape = psfs[other] if other < len(psfs) else psfs[0]
        counts -= flux * shape.pixel(u - at_u, v - at_v)
    return dataclasses.replace(window, counts=counts)


def chosen_stars(
    records: Sequence[CentroidRecord],
    magnitudes: Sequence[float],
    faintest_mag: float,
    most: int,
) -> list[MeasuredStar]:
    """The measured stars by magnitude; stars used in the batch come first."""
    used: list[MeasuredStar] = []
    left: list[MeasuredStar] = []
    for record, magnitude in sorted(
        zip(records, magnitudes, strict=True),
        key=lambda each: _by_magnitude_else_light(each[1], each[0].flux_counts),
    ):
        if not record.usable:
            left.append(MeasuredStar(record, magnitude, record.refused))
        elif magnitude > faintest_mag or not record.flux_counts > 0.0:
            left.append(MeasuredStar(record, magnitude, f"fainter than {faintest_mag:g} mag"))
        elif len(used) == most:
            left.append(MeasuredStar(record, magnitude, f"{most} are brighter"))
        else:
            used.append(MeasuredStar(record, magnitude))
    return used + left


def _by_magnitude_else_light(magnitude_mag: float, flux_counts: float) -> tuple[bool, float]:
    """The sort key of a star: by magnitude, and by decreasing light after all with a magnitude."""
    if math.isnan(magnitude_mag):
        return True, -flux_counts if flux_counts > 0.0 else math.inf
    return False, magnitude_mag

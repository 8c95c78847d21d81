"""What each tracker of a batch contributes: its stars by outcome, residuals and magnitudes.

Rows of `tracker_values`, which exist where the spacecraft has several trackers:
of one alone the result itself has the same values.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from service.acquire import Acquisition
from service.observations.calibrate import CorrectedObservations
from service.storage.models.answers import Answer, Star
from service.storage.sql.tables import MEASURED
from service.vectors import Vector

Row = dict[str, Any]


def values_of_trackers(acquisition: Acquisition, answer: Answer, batch_id: str) -> list[Row]:
    """The rows of an acquisition; none where its mission has one tracker."""
    if len(acquisition.mission.trackers) == 1:
        return []
    catalog_mag = acquisition.run_catalog.magnitude_mag
    found = [each.identification.star for each in acquisition.trackers]
    return tracker_rows(
        batch_id,
        answer,
        [each.corrected for each in acquisition.trackers],
        [np.where(star >= 0, catalog_mag[star], np.nan) for star in found],
    )


def tracker_rows(
    batch_id: str,
    answer: Answer,
    corrected: Sequence[CorrectedObservations],
    catalog_mag: Sequence[Vector],
) -> list[Row]:
    """The rows of an answer, one a tracker, in the order of its observations.

    `corrected` are the observations that it was made from, and `catalog_mag` the
    catalog magnitudes (n,) of their unique stars, NaN for others and where they
    are not known.
    """
    expected = [_expected_squares(answer, each) for each in corrected]
    scale = _scale(answer, expected)
    rows = []
    for stars, seen, squares, magnitudes in zip(
        answer.observations, corrected, expected, catalog_mag, strict=True
    ):
        outcomes = [star.outcome for star in stars.stars]
        used = list(_residuals(stars.stars))
        predicted = scale * math.fsum(squares[k] for k, _ in used)
        offsets = (seen.magnitude_mag - magnitudes)[np.isfinite(seen.magnitude_mag - magnitudes)]
        rows.append(
            dict.fromkeys(MEASURED)
            | {
                "batch_id": batch_id,
                "tracker": stars.tracker,
                "observed": len(outcomes),
                **{name: outcomes.count(name) for name in ("unique", "ambiguous", "unmatched")},
                "status": _status(answer, stars.tracker),
                "residual_rms_arcsec": _rms(math.fsum(each**2 for _, each in used), len(used)),
                "predicted_rms_arcsec": _rms(predicted, len(used)),
                "magnitude_offset_mag": (
                    math.fsum(offsets.tolist()) / len(offsets) if len(offsets) else None
                ),
            }
        )
    return rows


def _residuals(stars: Sequence[Star]) -> Iterator[tuple[int, float]]:
    """The place and the residual of each star that the attitude uses."""
    for place, star in enumerate(stars):
        if star.residual_arcsec is not None:
            yield place, star.residual_arcsec


def _status(answer: Answer, tracker: str) -> str | None:
    """`suspect` for the tracker that disagrees with the others; None without an attitude."""
    if answer.attitude is None:
        return None
    return "suspect" if answer.attitude.outlier == tracker else "good"


def _expected_squares(answer: Answer, seen: CorrectedObservations) -> Vector:
    """The squared residual (n,) in arcsec^2 that is expected of each star.

    Of the best attitude it is the noise along both tangent axes less what the
    attitude, of covariance P, takes up of it: 2 sigma^2 - (trace P - d' P d).
    """
    if answer.attitude is None:
        return np.zeros(len(seen.sigma_arcsec))
    covariance = np.array(answer.attitude.covariance_arcsec2)
    direction = seen.direction_body
    along = np.einsum("ni,ij,nj->n", direction, covariance, direction)
    return np.asarray(2.0 * seen.sigma_arcsec**2 - (np.trace(covariance) - along))


def _scale(answer: Answer, expected: Sequence[Vector]) -> float:
    """What brings the expected squares to the sum that the answer predicts; 1 for QUEST.

    TRIAD's attitude takes its own part of the noise, which its answer says of all stars only.
    """
    if answer.attitude is None or answer.attitude.predicted_rms_arcsec is None:
        return 0.0
    used = [
        squares[place]
        for squares, stars in zip(expected, answer.observations, strict=True)
        for place, _ in _residuals(stars.stars)
    ]
    total = math.fsum(used)
    return len(used) * answer.attitude.predicted_rms_arcsec**2 / total if total > 0.0 else 0.0


def _rms(squares: float, count: int) -> float | None:
    """The rms of so many squares; None where it is not known."""
    return math.sqrt(squares / count) if count and squares > 0.0 else None

"""How the measured quantities are computed from an acquisition."""

import math
from typing import TYPE_CHECKING

import numpy as np

from service.vectors import separation_deg

if TYPE_CHECKING:
    from service.acquire import Acquisition
    from service.alarms.drift import MeanStars


def residual_rms_arcsec(acquisition: "Acquisition") -> float | None:
    """The rms of the attitude's residuals; None without an attitude from stars."""
    solution = acquisition.solution
    return None if solution is None else _known(solution.residual_rms_arcsec)


def predicted_rms_arcsec(acquisition: "Acquisition") -> float | None:
    """The residual rms that the covariance predicts; None without an attitude from stars."""
    solution = acquisition.solution
    return None if solution is None else _known(solution.predicted_rms_arcsec)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def magnitude_offset_mag(acquisition: "Acquisition") -> float | None:
    """The mean of observed less catalog magnitude over the unique stars.

    None where no unique star has a magnitude.
    """
    catalog_mag = acquisition.run_catalog.magnitude_mag
    offsets = []
    for each in acquisition.trackers:
        star, observed_mag = each.identification.star, each.corrected.magnitude_mag
        # Row -1, no star, reads the last star's magnitude; it is left out.
        known = zip(star.tolist(), observed_mag.tolist(), catalog_mag[star].tolist(), strict=True)
        offsets += [mag - known_mag for row, mag, known_mag in known if row >= 0 and mag == mag]
    return math.fsum(offsets) / len(offsets) if offsets else None


def scale_offset_ppm(acquisition: "Acquisition") -> float | None:
    """How much larger the stars' distances are than the catalog's, in millionths.

    None without an attitude, or where the stars are too close together.
    """
    from service.alarms import drift

    means = _mean_stars(acquisition)
    return drift.scale_offset_ppm(means) if means else None


def alignment_offset_arcsec(acquisition: "Acquisition") -> float | None:
    """How much larger the angles between trackers are than the catalog's, as a mean.

    None without an attitude, or where fewer than two trackers have unique stars.
    """
    from service.alarms import drift

    if len(acquisition.trackers) == 1:
        return None
    offsets = [
        each
        for each in drift.alignment_offsets_arcsec(_mean_stars(acquisition))
        if each is not None
    ]
    return math.fsum(offsets) / len(offsets) if offsets else None


def _mean_stars(acquisition: "Acquisition") -> list["MeanStars"]:
    """The mean directions of every tracker; none without an attitude."""
    # Only what records an acquisition needs the ephemeris.
    from service.alarms.drift import mean_stars

    if acquisition.solution is None:
        return []
    return mean_stars(
        acquisition.batch,
        [each.corrected for each in acquisition.trackers],
        [each.identification.star for each in acquisition.trackers],
        acquisition.run_catalog.direction_at(acquisition.batch.time),
    )


def a_priori_angle_deg(acquisition: "Acquisition") -> float | None:
    """The angle from the a priori attitude to the one found; None without either.

    Where the a priori gives an axis alone, the pole of a band or the boresight
    of a cap, the angle between that axis and where it was found to be.
    """
    if acquisition.solution is None or acquisition.prior is None:
        return None
    prior = acquisition.prior
    attitude = acquisition.solution.matrix
    if prior.known_axis is not None:
        axis = np.dot(prior.axis_body(acquisition.mission), attitude)
        return separation_deg(axis, prior.known_axis)
    # The Frobenius norm of A - B is 2 sqrt(2) sin(angle / 2).
    apart = math.dist(attitude.ravel().tolist(), prior.attitude.ravel().tolist())
    return math.degrees(2.0 * math.asin(min(1.0, apart / math.sqrt(8.0))))

"""Sources of quantities, and the functions that measure quantities in the stars of a batch.

`STORED` names the quantities with columns of their own in the database, in the order of these
columns: the tables are built from it.  Names, limits and usual causes of quantities are in
`service.trends.quantities`.

A new `Measured` quantity needs a migration as well: a column of its name in `results` and in
`tracker_values`; and for `rolled_up` the columns `_min` and `_max` in all four rollups, and `_n`
and `_sum` too.  Results recorded earlier have no value of the quantity.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from service.vectors import separation_deg

if TYPE_CHECKING:
    from service.acquire import Acquisition
    from service.identify.identification import Integers
    from service.observations.batch import ObservationBatch
    from service.observations.calibrate import CorrectedObservations
    from service.sky.catalog.run_catalog import RunCatalog
    from service.trends.drift import MeanStars

Counts = Mapping[str, Any]
"""Counts by name: of one result, or columns of a rollup as numbers or SQL.

The names are `batches`, `observed`, `unique`, `ambiguous`, `unmatched`, `solved`, `suspect`.
"""


@dataclass(frozen=True, eq=False)
class BatchStars:
    """Stars of a batch from which a result was made, for each tracker.

    `corrected` are the observations of `batch`, and `star` the rows of the catalog (n,) of the
    unique ones, -1 for others and where they are not known.
    """

    batch: "ObservationBatch"
    corrected: Sequence["CorrectedObservations"]
    star: Sequence["Integers"]
    catalog: "RunCatalog"
    has_attitude: bool

    @classmethod
    def of(cls, acquisition: "Acquisition") -> "BatchStars":
        """Collect the stars of an acquisition."""
        return cls(
            acquisition.batch,
            [each.corrected for each in acquisition.trackers],
            [each.identification.star for each in acquisition.trackers],
            acquisition.run_catalog,
            acquisition.solution is not None,
        )

    @cached_property
    def means(self) -> list["MeanStars"]:
        """Mean directions of the stars of every tracker; empty without an attitude."""
        # Only recording an acquisition needs the ephemeris.
        from service.trends.drift import mean_stars

        if not self.has_attitude:
            return []
        directions = self.catalog.direction_at(self.batch.time)
        return mean_stars(self.batch, self.corrected, self.star, directions)

    @cached_property
    def alignment_offsets_arcsec(self) -> list[float | None]:
        """Mean excess of each tracker's angles to the others over the catalog's, in arcsec."""
        from service.trends.drift import alignment_offsets_arcsec

        if len(self.corrected) == 1 or not self.has_attitude:
            return [None] * len(self.corrected)
        return alignment_offsets_arcsec(self.means)


@dataclass(frozen=True, eq=False)
class MeasuredStars:
    """Stars of one tracker of a batch, or of all its trackers, in which a quantity is measured.

    `trackers` are their positions in `batch`.  Both rms are those of the attitude's residuals over
    these stars; None without an attitude from stars.
    """

    batch: BatchStars
    trackers: range
    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None

    @classmethod
    def of_all(cls, acquisition: "Acquisition") -> "MeasuredStars":
        """Collect the stars of all trackers of an acquisition."""
        stars = BatchStars.of(acquisition)
        return cls(stars, range(len(stars.corrected)), *rms_arcsec(acquisition))


@dataclass(frozen=True)
class StarShare:
    """Source of a quantity: a fraction of the observed stars; `part` counts them."""

    part: Callable[[Counts], Any]
    rolled_up: bool = False


@dataclass(frozen=True)
class BatchShare:
    """Source of a quantity: a fraction of the batches; `part` counts them, 0 or 1 for one batch."""

    part: Callable[[Counts], Any]


@dataclass(frozen=True)
class Measured:
    """Source of a quantity: a value measured at recording, stored in its own column.

    The same function measures the stars of a batch and those of each of its trackers.
    """

    measure: Callable[[MeasuredStars], float | None]
    rolled_up: bool = False


@dataclass(frozen=True)
class MeasuredOfBatch:
    """Source of a quantity: a value of the whole batch in its own column; trackers have none."""

    measure: Callable[["Acquisition"], float | None]
    rolled_up: bool = False


@dataclass(frozen=True)
class Ratio:
    """Source of a quantity: the ratio of two measured ones by name; None if either is missing."""

    numerator: str
    denominator: str
    rolled_up: bool = False


@dataclass(frozen=True)
class Rate:
    """Source of a quantity: the number of batches in an hour of batch time."""


@dataclass(frozen=True)
class Gap:
    """Source of a quantity: the time without a batch; it has no history."""


@dataclass(frozen=True)
class SmoothedShare:
    """Source of a quantity: a fraction of a smoothed day's attitudes; it has no history.

    Batches have no value of it when they are recorded: `acquire smooth` computes it.
    """


Source = StarShare | BatchShare | Measured | MeasuredOfBatch | Ratio | Rate | Gap | SmoothedShare
"""Source of a quantity: the way in which it follows from batches.

`rolled_up`, where a source has it, is True if the rollups have columns of it.  Without such columns
buckets have no extremes of a share of stars and no values of a ratio, and batches are not ranked by
the quantity.
"""


def rms_arcsec(acquisition: "Acquisition") -> tuple[float | None, float | None]:
    """Rms of the attitude's residuals in arcsec, measured and predicted; None: not known."""
    solution = acquisition.solution
    if solution is None:
        return None, None
    return _known(solution.residual_rms_arcsec), _known(solution.predicted_rms_arcsec)


def magnitude_offset_mag(stars: MeasuredStars) -> float | None:
    """Mean of observed minus catalog magnitude over the unique stars.

    None where no unique star has a magnitude.
    """
    batch = stars.batch
    offsets = []
    for k in stars.trackers:
        star, observed_mag = batch.star[k], batch.corrected[k].magnitude_mag
        # Row -1, no star, reads the last star's magnitude; it is left out.
        catalog_mag = batch.catalog.magnitude_mag[star]
        known = zip(star.tolist(), observed_mag.tolist(), catalog_mag.tolist(), strict=True)
        offsets += [mag - known_mag for row, mag, known_mag in known if row >= 0 and mag == mag]
    return _mean(offsets)


def scale_offset_ppm(stars: MeasuredStars) -> float | None:
    """Excess of the stars' mutual distances over the catalog's, in ppm.

    None without an attitude, or where the stars are too close together.
    """
    from service.trends import drift

    means = [stars.batch.means[k] for k in stars.trackers] if stars.batch.has_attitude else []
    return drift.scale_offset_ppm(means) if means else None


def alignment_offset_arcsec(stars: MeasuredStars) -> float | None:
    """Mean excess of the angles to the other trackers over the catalog's angles, in arcsec.

    None without an attitude, or where fewer than two trackers have unique stars.
    """
    offsets = [stars.batch.alignment_offsets_arcsec[k] for k in stars.trackers]
    return _mean([each for each in offsets if each is not None])


def a_priori_angle_deg(acquisition: "Acquisition") -> float | None:
    """Angle from the a priori attitude to the found one in degrees; None if one is missing.

    If the a priori gives only an axis (the pole of a band or the boresight of a cap), the angle
    between that axis and its found direction.
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


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None


STORED: dict[str, StarShare | Measured | MeasuredOfBatch | Ratio] = {
    "ambiguous_share": StarShare(itemgetter("ambiguous"), rolled_up=True),
    "unmatched_share": StarShare(itemgetter("unmatched"), rolled_up=True),
    "residual_rms_arcsec": Measured(lambda stars: stars.residual_rms_arcsec, rolled_up=True),
    "predicted_rms_arcsec": Measured(lambda stars: stars.predicted_rms_arcsec, rolled_up=True),
    "residual_ratio": Ratio("residual_rms_arcsec", "predicted_rms_arcsec", rolled_up=True),
    "magnitude_offset_mag": Measured(magnitude_offset_mag, rolled_up=True),
    "a_priori_angle_deg": MeasuredOfBatch(a_priori_angle_deg, rolled_up=True),
    "scale_offset_ppm": Measured(scale_offset_ppm, rolled_up=True),
    "alignment_offset_arcsec": Measured(alignment_offset_arcsec, rolled_up=True),
}
"""Sources of the quantities stored in database columns, by name, in the order of the columns.

Add new ones at the end: an index of results has the columns in this order.
"""

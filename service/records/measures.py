"""What is measured of one result: what trends are drawn of and limits are held against."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np

from service.acquire import Acquisition
from service.records.tables import COUNTS, MAXIMA, MINIMA, ROLLED_UP, SUMS, VALUES
from service.vectors import separation_deg

Row = dict[str, Any]


def measures_of(acquisition: Acquisition) -> Row:
    """The values of an acquisition by the names of their columns, None where there is none."""
    solution = acquisition.solution
    return {
        "residual_rms_arcsec": None if solution is None else solution.residual_rms_arcsec,
        "predicted_rms_arcsec": None if solution is None else solution.predicted_rms_arcsec,
        "magnitude_offset_mag": magnitude_offset_mag(acquisition),
        "a_priori_angle_deg": a_priori_angle_deg(acquisition),
    }


def magnitude_offset_mag(acquisition: Acquisition) -> float | None:
    """How much fainter the unique stars are than the catalog says, on average.

    None where no unique star has a magnitude.
    """
    catalog_mag = acquisition.run_catalog.magnitude_mag
    offsets = []
    for each in acquisition.trackers:
        star, seen_mag = each.identification.star, each.corrected.magnitude_mag
        # Rows without a star take the last one's; they are passed over.
        known = zip(star.tolist(), seen_mag.tolist(), catalog_mag[star].tolist(), strict=True)
        offsets += [mag - known_mag for row, mag, known_mag in known if row >= 0 and mag == mag]
    return math.fsum(offsets) / len(offsets) if offsets else None


def a_priori_angle_deg(acquisition: Acquisition) -> float | None:
    """The angle from the a priori attitude to the one found; None without either.

    Where only an axis is taken for known, in a band its pole and in a cap an a
    priori boresight, the angle between it and where that axis was found to be.
    """
    if acquisition.solution is None or acquisition.presumed is None:
        return None
    presumed = acquisition.presumed
    attitude = acquisition.solution.matrix
    if presumed.known_axis is not None:
        axis = np.dot(acquisition.mission.axis_body, attitude)
        return separation_deg(axis, presumed.known_axis)
    # |A - B| is 2 sqrt(2) sin(angle / 2) in the sense of Frobenius.
    apart = math.dist(attitude.ravel().tolist(), presumed.attitude.ravel().tolist())
    return math.degrees(2.0 * math.asin(min(1.0, apart / math.sqrt(8.0))))


def residual_ratio(row: Row) -> float | None:
    """The residual rms of an attitude over what its covariance predicts."""
    rms, predicted = row["residual_rms_arcsec"], row["predicted_rms_arcsec"]
    return None if rms is None or not predicted else float(rms / predicted)


VALUE_OF: Mapping[str, Callable[[Row], float | None]] = {
    name: residual_ratio if name == "residual_ratio" else itemgetter(name) for name in VALUES
}
"""What gives a result's value by name, None where it has none."""


def rolled_up(results: Sequence[Row]) -> Row:
    """What current results are to the trends: the columns of a rollup of them."""
    observed = [row["observed"] for row in results]
    status = [row["status"] for row in results]
    counts = (
        len(results),
        sum(observed),
        sum([row["unique"] for row in results]),
        sum([row["ambiguous"] for row in results]),
        sum([row["unmatched"] for row in results]),
        len(status) - status.count(None),
        status.count("suspect"),
    )
    shares = [
        [row[name] / row["observed"] for row in results if row["observed"]]
        for name in ("ambiguous", "unmatched")
    ]
    values = [
        [value for value in map(of, results) if value is not None] for of in VALUE_OF.values()
    ]
    sums = chain.from_iterable((len(there), sum(there, 0.0)) for there in values)
    extremes = shares + values
    least = [min(there, default=None) for there in extremes]
    most = [max(there, default=None) for there in extremes]
    # In the order of the columns: to put their names together takes longer than all of this.
    return dict(zip(ROLLED_UP, (*counts, *sums, *least, *most), strict=True))


def merge(into: Row, row: Row) -> None:
    """Add one rollup to another: sums add up, of the extremes the outer ones stay."""
    for name in (*COUNTS, *SUMS):
        into[name] += row[name]
    for name in MINIMA:
        if into[name] is None or (row[name] is not None and row[name] < into[name]):
            into[name] = row[name]
    for name in MAXIMA:
        if into[name] is None or (row[name] is not None and row[name] > into[name]):
            into[name] = row[name]

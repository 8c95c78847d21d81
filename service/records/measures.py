"""What is measured of one result: what trends are drawn of and limits are held against."""

import math
from typing import Any

import numpy as np

from service.acquire import Acquisition
from service.records.tables import COUNTS, MAXIMA, MINIMA, SUMS
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


def contribution(result: Row) -> Row:
    """What one current result is to the trends: the columns of a rollup of it alone."""
    observed, status = result["observed"], result["status"]
    values = {
        "residual_rms_arcsec": result["residual_rms_arcsec"],
        "predicted_rms_arcsec": result["predicted_rms_arcsec"],
        "residual_ratio": residual_ratio(result),
        "magnitude_offset_mag": result["magnitude_offset_mag"],
        "a_priori_angle_deg": result["a_priori_angle_deg"],
    }
    shares = {
        "ambiguous_share": result["ambiguous"] / observed if observed else None,
        "unmatched_share": result["unmatched"] / observed if observed else None,
    }
    row: Row = {
        "batches": 1,
        "observed": observed,
        "unique": result["unique"],
        "ambiguous": result["ambiguous"],
        "unmatched": result["unmatched"],
        "solved": int(status is not None),
        "suspect": int(status == "suspect"),
    }
    for name, value in values.items():
        row[f"{name}_n"], row[f"{name}_sum"] = int(value is not None), value or 0.0
    for name, value in (shares | values).items():
        row[f"{name}_min"] = row[f"{name}_max"] = value
    return row


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

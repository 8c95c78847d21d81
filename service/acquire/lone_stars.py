"""Stars of a batch that is too poor for an attitude, identified by the predicted one.

One star has no pair that could tell it from others.  Where the attitude is predicted well
enough, its place and its magnitude tell: a catalog star is weighed against chance, which is
a point that is no star, or a prediction that has failed.
"""

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from service.identify.hypotheses.evidence import LOG_CLUTTER_SPAN, log_magnitudes
from service.identify.hypotheses.verified import UNIQUE_PROBABILITY
from service.identify.identification import Identification, Outcome
from service.observations.calibrate import CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

CLUTTER = 0.1
"""The probability that a point is no catalog star, as `hypotheses.evidence` expects it."""
FAILED = 0.01
"""The probability that a prediction has failed, as at a flip that no mission declares."""
GATE = 30.0
"""Of chi-square with two degrees of freedom: catalog stars beyond it weigh nothing."""


def identify_lone_stars(
    corrected: Sequence[CorrectedObservations],
    identifications: Sequence[Identification],
    attitude: Matrix,
    covariance_arcsec2: Matrix,
    run_catalog: RunCatalog,
    inertial: Vector,
) -> list[Identification]:
    """The identifications with the stars that a predicted attitude identifies by itself.

    `attitude` (3, 3), inertial to body, is the predicted one with its covariance about the body
    axes; `inertial` (N, 3) are the apparent directions of the run catalog's stars.  A star is
    unique from the same probability on as under `verified`.
    """
    found = [
        _of_tracker(each, identified, attitude, covariance_arcsec2, run_catalog, inertial)
        for each, identified in zip(corrected, identifications, strict=True)
    ]
    rows = [int(row) for each in found for row in each.star if row >= 0]
    # Of two points that are one star nothing tells which it is.
    return found if len(set(rows)) == len(rows) else list(identifications)


def _of_tracker(
    corrected: CorrectedObservations,
    identified: Identification,
    attitude: Matrix,
    covariance_arcsec2: Matrix,
    run_catalog: RunCatalog,
    inertial: Vector,
) -> Identification:
    outcome, star = identified.outcome.copy(), identified.star.copy()
    probability = identified.probability.copy()
    hypothesis = None if identified.hypothesis is None else identified.hypothesis.copy()
    radius_rad = math.radians(corrected.tracker.field_of_view_radius_deg)
    view_sr = 2.0 * math.pi * (1.0 - math.cos(radius_rad))
    chance = CLUTTER / view_sr + FAILED * len(run_catalog) / (4.0 * math.pi)
    predicted = inertial @ attitude.T
    for k in np.flatnonzero(~identified.unique).tolist():
        row, likely = _likeliest(
            corrected.direction_body[k],
            float(corrected.sigma_rad[k]),
            float(corrected.magnitude_mag[k]),
            predicted,
            covariance_arcsec2 / ARCSEC_PER_RADIAN**2,
            run_catalog.magnitude_mag,
            chance,
        )
        if likely >= UNIQUE_PROBABILITY:
            outcome[k], star[k], probability[k] = int(Outcome.UNIQUE), row, likely
            if hypothesis is not None:
                hypothesis[k] = row
    rivals = tuple(
        () if is_unique else each
        for is_unique, each in zip(star >= 0, identified.rivals, strict=True)
    )
    likely_rivals = identified.rival_probability
    if likely_rivals:
        likely_rivals = tuple(
            () if is_unique else each
            for is_unique, each in zip(star >= 0, likely_rivals, strict=True)
        )
    return replace(
        identified,
        outcome=outcome,
        star=star,
        probability=probability,
        hypothesis=hypothesis,
        rivals=rivals,
        rival_probability=likely_rivals,
    )


def _likeliest(
    seen: Vector,
    sigma_rad: float,
    magnitude_mag: float,
    predicted: Vector,
    covariance_rad2: Matrix,
    catalog_mag: Vector,
    chance: float,
) -> tuple[int, float]:
    """The likeliest catalog star at a point in body axes, and its probability; else -1 and 0.

    `chance` is the density of what else may be there, per steradian.
    """
    first = np.cross(seen, np.eye(3)[int(np.argmin(np.abs(seen)))])
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(seen, first)])
    # A rotation about one axis across moves the point along the other.
    turned = np.stack([across[1], -across[0]])
    covariance = turned @ covariance_rad2 @ turned.T + sigma_rad**2 * np.eye(2)
    off = (predicted - seen) @ across.T
    squares = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    near = np.flatnonzero((squares < GATE) & (predicted @ seen > 0.0))
    if not len(near):
        return -1, 0.0
    log_peak = -math.log(2.0 * math.pi) - 0.5 * math.log(float(np.linalg.det(covariance)))
    weights = log_peak - 0.5 * squares[near]
    log_chance = math.log(chance)
    if not math.isnan(magnitude_mag):
        apart = magnitude_mag - catalog_mag[near]
        weights += [log_magnitudes.py_func(1, each, each * each) for each in apart.tolist()]
        log_chance -= LOG_CLUTTER_SPAN
    weights = np.exp(weights + math.log((1.0 - CLUTTER) * (1.0 - FAILED)) - log_chance)
    best = int(np.argmax(weights))
    return int(near[best]), float(weights[best] / (1.0 + weights.sum()))

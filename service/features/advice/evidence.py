"""Evidence on mission settings: observed minus catalog differences of identified stars.

The stars are those that verified identification names.  It does not look at
the tolerances, so differences beyond a tolerance are visible too; pairs
accepted by the votes could only confirm the tolerance that accepted them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from service.acquire import Acquisition
from service.acquire.choices import aberration_velocity
from service.acquire.result import Path, TrackerResult
from service.attitude.solution import AttitudeSolution
from service.identify.attitude_from_matches import attitude_of
from service.missions.mission import Band
from service.observations.batch import BoresightPrior
from service.sky.ephemeris import sun_distance_au
from service.times import Utc
from service.vectors import Matrix, Vector, angle_between_deg, unit


@dataclass(frozen=True)
class StarEvidence:
    """Identified stars (n): number of batch and tracker, observed and catalog magnitude.

    `pole_angle_deg` is the difference between the observed angle to the pole,
    through the a priori attitude, and the catalog's; NaN in caps.
    """

    batch: npt.NDArray[np.int64]
    tracker: npt.NDArray[np.int64]
    observed_mag: Vector
    catalog_mag: Vector
    pole_angle_deg: Vector


@dataclass(frozen=True)
class PairEvidence:
    """Differences of pairs (n) of identified stars of one tracker, within the largest indexed
    separation.

    `separation_deg` is observed minus catalog.  `pole_difference_deg` is that
    between the observed and the catalog difference of the angles to the pole
    (GTODIF and GTRDIF).  `cross_product_deg` is the angle between the observed
    and the catalog cross product (CRSSEP), NaN where the votes do not ask for it.
    `magnitude_difference_mag` is the observed difference of the magnitudes less the
    catalog's: a pair that differs by more is in its right order by brightness.
    """

    batch: npt.NDArray[np.int64]
    separation_deg: Vector
    pole_difference_deg: Vector
    cross_product_deg: Vector
    magnitude_difference_mag: Vector


_Columns = TypeVar("_Columns", StarEvidence, PairEvidence)


@dataclass(frozen=True)
class TrackerAttitude:
    """Attitude of one tracker alone in one batch: its quaternion, covariance, fit and time."""

    batch: int
    tracker: int
    quaternion: Vector
    covariance_arcsec2: Matrix
    taste: float
    degrees_of_freedom: int
    time: Utc


@dataclass(frozen=True)
class Evidence:
    """Star pairs, magnitudes and single-tracker attitudes from verified batches."""

    stars: StarEvidence
    pairs: PairEvidence
    fits: tuple[TrackerAttitude, ...]

    @property
    def batches(self) -> int:
        """Number of batches with at least one identified star."""
        return len(np.unique(self.stars.batch))


def evidence_of(batch: int, acquisition: Acquisition) -> Evidence:
    """Evidence from one acquisition with verified identification; `batch` is its number in the
    sample.

    Tests and zones are judged by the prior attitude: an acquisition whose attitude
    came from the whole sky gives no evidence.
    """
    mission = acquisition.mission
    names = [tracker.name for tracker in mission.trackers]
    stars, pairs, fits = [], [], []
    for result in acquisition.trackers:
        used = _uniquely_identified(result)
        if not used.any() or acquisition.prior is None or result.region is None:
            continue
        if acquisition.path is not Path.ZONE:
            continue
        presumed = acquisition.prior.attitude
        tracker = names.index(result.corrected.tracker.name)
        row = result.identification.star[used]
        brightness = (
            result.corrected.magnitude_mag[used],
            acquisition.run_catalog.magnitude_mag[row],
        )
        observed = result.corrected.direction_body[used] @ presumed
        catalog = acquisition.run_catalog.direction_at(acquisition.batch.time)[row]
        polar = [np.full(len(row), np.nan)] * 2
        if isinstance(mission.zone, Band):
            polar = [angle_between_deg(each, result.region.axis) for each in (observed, catalog)]
        stars.append(
            StarEvidence(
                np.full(len(row), batch),
                np.full(len(row), tracker),
                *brightness,
                polar[0] - polar[1],
            )
        )
        fainter_by = brightness[0] - brightness[1]
        pairs.append(_pairs(batch, acquisition, observed, catalog, polar, fainter_by))
        solution = _tracker_attitude(acquisition, result, used)
        if solution is not None:
            fits.append(
                TrackerAttitude(
                    batch,
                    tracker,
                    solution.quaternion,
                    solution.covariance_arcsec2,
                    solution.taste,
                    solution.degrees_of_freedom,
                    acquisition.batch.time,
                )
            )
    return Evidence(_joined(StarEvidence, stars), _joined(PairEvidence, pairs), tuple(fits))


def merged(parts: Iterable[Evidence]) -> Evidence:
    """Concatenate the evidence of several batches."""
    parts = list(parts)
    return Evidence(
        _joined(StarEvidence, [part.stars for part in parts]),
        _joined(PairEvidence, [part.pairs for part in parts]),
        tuple(fit for part in parts for fit in part.fits),
    )


def _uniquely_identified(result: TrackerResult) -> npt.NDArray[np.bool_]:
    """Mask of unique stars; two observed stars with one catalog star are excluded."""
    star = result.identification.star
    names, count = np.unique(star, return_counts=True)
    return result.identification.unique & ~np.isin(star, names[count > 1])


def _pairs(
    batch: int,
    acquisition: Acquisition,
    observed: Vector,
    catalog: Vector,
    polar: Sequence[Vector],
    fainter_by_mag: Vector,
) -> PairEvidence:
    tolerances = acquisition.choices.tolerances
    i, j = np.triu_indices(len(observed), 1)
    between = angle_between_deg(catalog[i], catalog[j])
    near = between <= tolerances.pair_separation_max_deg
    i, j, between = i[near], j[near], between[near]
    apart = [np.abs(each[i] - each[j]) for each in polar]
    crossing = angle_between_deg(
        unit(np.cross(observed[i], observed[j])), unit(np.cross(catalog[i], catalog[j]))
    )
    # If both differences determine the order, votes compare only the angles to the pole.
    crossing[np.minimum(*apart) > tolerances.pole_difference_deg] = np.nan
    if isinstance(acquisition.batch.a_priori, BoresightPrior):
        crossing[:] = np.nan
    return PairEvidence(
        np.full(len(i), batch),
        angle_between_deg(observed[i], observed[j]) - between,
        np.abs(apart[0] - apart[1]),
        crossing,
        fainter_by_mag[i] - fainter_by_mag[j],
    )


def _tracker_attitude(
    acquisition: Acquisition, result: TrackerResult, used: npt.NDArray[np.bool_]
) -> AttitudeSolution | None:
    """Attitude from the stars of one tracker alone, independent of the other trackers."""
    solved = attitude_of(
        result.corrected.direction_body,
        result.corrected.sigma_rad,
        np.where(used, result.identification.star, -1),
        None,
        (result.corrected.tracker.name,),
        acquisition.run_catalog.direction_at(acquisition.batch.time),
        aberration_velocity(acquisition.batch),
        sun_distance_au(acquisition.batch.time),
        "quest",
    )
    return solved if isinstance(solved, AttitudeSolution) else None


def _joined(kind: type[_Columns], parts: Sequence[_Columns]) -> _Columns:
    """Concatenate the columns of several objects of a class; without any, the columns are empty."""
    return kind(**{each.name: _column(each.name, parts) for each in fields(kind)})


def _column(name: str, parts: Sequence[StarEvidence] | Sequence[PairEvidence]) -> npt.NDArray[Any]:
    kind = np.int64 if name in ("batch", "tracker") else np.float64
    return np.concatenate([np.empty(0, kind), *(vars(part)[name] for part in parts)])

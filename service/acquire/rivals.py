"""Two groups of stars in one batch, with an attitude each.

Reflections double every star, and a slew within a batch splits the stars. The group of larger
weight becomes the answer, the other one its rival.
"""

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from service.acquire.result import RivalAttitude
from service.acquire.search import SearchResult, find
from service.acquire.zone_search import Search, ZoneResult, ZoneSearch
from service.attitude.solution import DIFFERENT_CHI_SQUARE, AttitudeSolution
from service.identify.hypotheses import groups
from service.observations.calibrate import CorrectedColumns, CorrectedObservations
from service.vectors import attitude_error_arcsec, read_only

FEWEST_NAMED = 2
"""Least number of one tracker's stars that a second group must identify to have an attitude."""


def find_groups(
    search: Search, corrected: tuple[CorrectedObservations, ...], first_found: ZoneResult | None
) -> tuple[SearchResult, RivalAttitude | None]:
    """Identify the stars; if two groups have an attitude each, the lighter group is the rival.

    The stars that the answer leaves unexplained are acquired separately in the same way. If all
    stars together gave no good result, so are those of the most likely hypothesis, since two groups
    of similar weight leave every star ambiguous. `first_found` is the result for all stars about
    the a priori attitude, if that was searched.
    """
    found = find(search, corrected, first_found)
    if not search.identifier.weighs_hypotheses or not any(mask.any() for mask in found.explained):
        return found, None
    other = _group(search, corrected, [~mask for mask in found.explained])
    if other is None:
        return found, None
    first = found
    if not found.good:
        explained = _group(search, corrected, found.explained)
        if explained is None:
            return found, None
        # The most likely hypothesis may include stars of the other group, and miss some of its own.
        other = _group(search, corrected, [~mask for mask in explained.unique]) or other
        first = _group(search, corrected, [~mask for mask in other.unique]) or explained
    elif not _differ(found.solution, other.solution):
        # Another tracker decided for this group: then the hypothesis gives the remaining stars.
        left = [mask & ~each for mask, each in zip(found.explained, found.unique, strict=True)]
        other = _group(search, corrected, left)
    else:
        # With stars of both groups the search of the whole sky leaves some of the first unnamed.
        alone = _group(search, corrected, [~mask for mask in other.unique])
        if alone is not None and _differ(alone.solution, other.solution):
            first = alone
    if other is None or not _differ(first.solution, other.solution):
        # The same attitude twice, for example because every star was sent twice.
        return found, None
    return _weigh(search, corrected, first, other)


def _group(
    search: Search, corrected: tuple[CorrectedObservations, ...], masks: Sequence[groups.Mask]
) -> SearchResult | None:
    """The search for a subset of stars, expanded to all stars; None if the subset has no attitude.

    The subset needs three stars, two of them identified, since the others may lie outside of the
    zone. An attitude with suspect residuals counts: one sound group in a thousand has these.
    """
    if not groups.may_be_a_group(masks):
        return None
    found = find(search, groups.part_of(corrected, masks))
    if found.in_zones is None or not isinstance(found.in_zones.solved, AttitudeSolution):
        return None
    has_attitude = any(int(mask.sum()) >= FEWEST_NAMED for mask in found.unique)
    return _of_all(found, masks) if has_attitude else None


def _weigh(
    search: Search,
    corrected: tuple[CorrectedObservations, ...],
    one: SearchResult,
    other: SearchResult,
) -> tuple[SearchResult, RivalAttitude]:
    """The heavier of two groups as the answer, and the lighter one as its rival."""
    weights = _log_weight(search, corrected, one), _log_weight(search, corrected, other)
    if weights[0] < weights[1]:
        one, other, weights = other, one, weights[::-1]
    first, second = one.in_zones, other.in_zones
    assert first is not None
    assert second is not None
    stars = tuple(each.star for each in second.identifications)
    share = groups.first_share(*weights, sum(int((rows >= 0).sum()) for rows in stars))
    apart_arcsec = attitude_error_arcsec(other.solution.matrix, one.solution.matrix)
    identifications = [
        groups.shared(mine, its, share)
        for mine, its in zip(first.identifications, second.identifications, strict=True)
    ]
    in_zones = replace(
        first, identifications=identifications, solved=replace(one.solution, suspect=True)
    )
    angle_deg = math.hypot(*apart_arcsec) / 3600.0
    rival = RivalAttitude(other.solution, stars, 1.0 - share, angle_deg)
    return replace(one, in_zones=in_zones), rival


def _log_weight(
    search: Search, corrected: tuple[CorrectedObservations, ...], found: SearchResult
) -> float:
    """The log weight of all stars under the attitude of one group, up to a common constant.

    The prior is the a priori attitude, or else the attitude that was found.
    """
    in_zones = found.in_zones
    assert in_zones is not None
    prior = in_zones.prior if search.prior is None else search.prior
    regions = [place.region for place in in_zones.places]
    zones = ZoneSearch(CorrectedColumns.of(corrected))
    zones.add(0, search, prior, regions=regions)
    return sum(
        groups.log_weight_of_group(
            zones.seen, s, search.zone(region)[0], identification.star, search.run_catalog
        )
        for s, (region, identification) in enumerate(
            zip(regions, in_zones.identifications, strict=True)
        )
    )


def _differ(one: AttitudeSolution, other: AttitudeSolution) -> bool:
    """True if the attitudes of two groups of stars differ by more than their noise explains."""
    apart_arcsec = attitude_error_arcsec(other.matrix, one.matrix)
    covariance_arcsec2 = one.covariance_arcsec2 + other.covariance_arcsec2
    weighted = float(apart_arcsec @ np.linalg.solve(covariance_arcsec2, apart_arcsec))
    return weighted > DIFFERENT_CHI_SQUARE


def _of_all(found: SearchResult, masks: Sequence[groups.Mask]) -> SearchResult:
    """The search result for a subset of stars, expanded to all stars with the others unmatched."""
    in_zones, solution = found.in_zones, found.solution
    assert in_zones is not None
    every = np.concatenate(masks)
    residual = np.full(len(every), np.nan)
    residual[every] = solution.residual_arcsec
    return replace(
        found,
        in_zones=replace(
            in_zones,
            identifications=[
                groups.of_all(each, mask)
                for each, mask in zip(in_zones.identifications, masks, strict=True)
            ],
            solved=replace(solution, residual_arcsec=read_only(residual)),
        ),
        explained=tuple(masks),
    )

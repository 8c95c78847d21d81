"""Causes of ambiguous and unmatched stars, from the recorded answers of a period.

A period is compared with an earlier one, where that has batches.  Nothing is identified again:
the stars of solved batches are compared with the catalog at the recorded attitude.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.acquire.choices import aberration_velocity
from service.contract.answers import Answer
from service.features.advice.records import Cause
from service.intervals import Interval, share_of
from service.missions.mission import Band, Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedObservations, correct
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent
from service.sky.model import SkyModel
from service.storage.queries.period import PeriodSample
from service.storage.queries.results import answer_from_json
from service.storage.queries.star_field import presumed_attitude
from service.times import unix_seconds, utc_of_unix
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    angle_between_deg,
    matrix_from_quaternion,
)

NEAR_DEG = 0.1
"""Distance in degrees beyond which a catalog star is not taken for the observed star."""
SURROUNDINGS_DEG = 10.0
"""Radius in degrees about the boresight in which catalog stars are counted for field density."""
RADIAL_MEDIAN = 1.1774
"""Ratio of the median radial error to the standard deviation per axis, for Gaussian errors."""
NOISY, DENSER, FEWER, FAR = 1.5, 1.4, 0.75, 1.5
"""Ratios to the earlier period at which noise, density, star numbers or angles count as changed."""
BRIGHTER_MAG, OFFSET_MAG = 0.4, 0.25
FITTING_SHARE = 0.6
"""Least share of a batch's stars with a catalog star nearby if its attitude is right."""
LEAST_STARS, LEAST_BATCHES = 20, 5
FALSE_SHARE = 0.02
USUAL_SHARE = 0.15
"""Normal share of batches with a priori errors beyond the zone, not reported as a cause."""
OVER_CHANCE = 0.001
"""Chance below which no batch at the end of a period has a cause that lasts."""

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class StarTable:
    """Observed stars (n) of a sample of batches (b) with trackers (t).

    `outcome` (n,) is u, a or m: unique, ambiguous, unmatched.  `offset_sigmas` is the distance
    to the nearest catalog star, NaN without an attitude and inf beyond `NEAR_DEG`;
    `offset_mag` is observed minus catalog.  `density` (b, t) counts the catalog stars near
    each boresight.  `solved` (b,) is True for a good attitude; `a_priori_deg` (b,) is NaN without
    one, and `room_deg` (b,) is the a priori error that the zone leaves room for.
    """

    total: int
    trackers: tuple[str, ...]
    time_ns: npt.NDArray[np.int64]
    solved: Flags
    a_priori_deg: Vector
    room_deg: Vector
    density: Vector
    batch: npt.NDArray[np.int64]
    tracker: npt.NDArray[np.int64]
    outcome: npt.NDArray[np.str_]
    magnitude: Vector
    off_axis: Vector
    """Angle of a star from the boresight, divided by the radius of the field of view."""
    offset_sigmas: Vector
    offset_mag: Vector
    rivals: tuple[tuple[str, ...], ...]

    @property
    def batches(self) -> int:
        """Number of batches in the sample."""
        return len(self.time_ns)

    @property
    def ambiguous(self) -> Flags:
        """Mask (n,) of the ambiguous stars."""
        return np.asarray(self.outcome == "a")

    def reported(self, tracker: int) -> Vector:
        """Number of stars (b,) that a tracker reported in each batch."""
        own = self.batch[self.tracker == tracker]
        return np.bincount(own, minlength=self.batches).astype(float)

    def noise(self, tracker: int) -> float:
        """Robust estimate of a tracker's noise in units of its sigma; NaN with too few stars."""
        own = (self.tracker == tracker) & np.isfinite(self.offset_sigmas)
        if np.count_nonzero(own) < LEAST_STARS:
            return float("nan")
        return float(np.median(self.offset_sigmas[own])) / RADIAL_MEDIAN


def star_table(sample: PeriodSample, sky: SkyModel) -> StarTable:
    """Build the table of observed stars from a sample of recorded batches and their answers."""
    names = tuple(dict.fromkeys(t.name for m in sample.missions.values() for t in m.trackers))
    count = len(sample.rows)
    density = np.full((count, len(names)), np.nan)
    room_deg = np.full(count, np.nan)
    columns: list[list[Any]] = [[] for _ in range(7)]
    rivals, solved = [], []
    for place, row in enumerate(sample.rows):
        mission = sample.missions[row["mission_digest"]]
        batch = submission_from_json(row["input"]).batch
        answer = answer_from_json(row["answer"])
        solved.append(answer.attitude is not None and answer.attitude.status == "good")
        room_deg[place] = _room_deg(mission)
        catalog = sky.run_catalog(mission, batch.time)
        seen_by = correct(batch, mission) if answer.observations else ()
        presumed = presumed_attitude(batch, answer, mission)
        attitude = None if presumed is None else presumed.attitude
        if answer.attitude is not None and solved[-1]:
            attitude = matrix_from_quaternion(answer.attitude.quaternion)
        offsets_of = _offsets_of(answer, seen_by, catalog, batch)
        for seen, found, offsets in zip(seen_by, answer.observations, offsets_of, strict=True):
            number = names.index(seen.tracker.name)
            if attitude is not None:
                boresight = seen.tracker.boresight_body @ attitude
                near = catalog.direction @ boresight > np.cos(np.radians(SURROUNDINGS_DEG))
                density[place, number] = np.count_nonzero(near)
            angle_deg = angle_between_deg(seen.direction_body, seen.tracker.boresight_body)
            parts = (
                np.full(len(found.stars), place),
                np.full(len(found.stars), number),
                [{"unmatched": "m"}.get(each.outcome, each.outcome[0]) for each in found.stars],
                seen.magnitude_mag,
                angle_deg / seen.tracker.field_of_view_radius_deg,
                *offsets,
            )
            for column, part in zip(columns, parts, strict=True):
                column.append(part)
            rivals += [
                tuple(sorted(each.rivals))
                for each in found.stars
                if each.outcome == "ambiguous" and each.rivals
            ]
    # A wrong identification gives an angle of any size, and no good attitude.
    angles = [
        row["a_priori_angle_deg"] if is_good else None
        for row, is_good in zip(sample.rows, solved, strict=True)
    ]
    kinds = (np.int64, np.int64, "U1", *[np.float64] * 4)
    # The empty first part gives each column its type if the sample has no star; numpy's own
    # annotations cannot express a sequence of kinds.
    batch_of, tracker_of, outcome, magnitude, off_axis, offset_sigmas, offset_mag = (
        np.concatenate([np.empty(0, kind), *parts])  # type: ignore[call-overload]
        for kind, parts in zip(kinds, columns, strict=True)
    )
    return StarTable(
        total=sample.total,
        trackers=names,
        time_ns=np.array([row["time_ns"] for row in sample.rows], np.int64),
        solved=np.array(solved, bool),
        a_priori_deg=np.array([np.nan if each is None else each for each in angles], float),
        room_deg=room_deg,
        density=density,
        batch=batch_of,
        tracker=tracker_of,
        outcome=outcome,
        magnitude=magnitude,
        off_axis=off_axis,
        offset_sigmas=offset_sigmas,
        offset_mag=offset_mag,
        rivals=tuple(rivals),
    )


def _room_deg(mission: Mission) -> float:
    zone = mission.zone
    size_deg = zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg
    return size_deg - max(each.field_of_view_radius_deg for each in mission.trackers)


def _offsets_of(
    answer: Answer,
    seen_by: Sequence[CorrectedObservations],
    catalog: RunCatalog,
    batch: ObservationBatch,
) -> list[Vector]:
    """Distance in sigmas and magnitude difference (2, n) of each star to its nearest catalog star.

    NaN without an attitude, and where it is wrong: few stars then have a neighbour.
    """
    unknown = [np.full((2, len(each.magnitude_mag)), np.nan) for each in seen_by]
    if answer.attitude is None:
        return unknown
    attitude = matrix_from_quaternion(answer.attitude.quaternion)
    covariance = np.array(answer.attitude.covariance_arcsec2)
    found = [_offsets(each, attitude, covariance, catalog, batch) for each in seen_by]
    distances = np.concatenate([each[0] for each in found])
    return found if np.isfinite(distances).mean() >= FITTING_SHARE else unknown


def _offsets(
    seen: CorrectedObservations,
    attitude: Matrix,
    covariance_arcsec2: Matrix,
    catalog: RunCatalog,
    batch: ObservationBatch,
) -> Vector:
    direction = seen.direction_body
    inertial = direction @ attitude
    row = np.argmax(inertial @ catalog.direction.T, axis=1)
    natural = catalog.direction_at(batch.time)[row]
    away_deg = angle_between_deg(
        inertial, apparent(natural, aberration_velocity(batch), batch.time)
    )
    # The error of the attitude about the star's own direction does not move it.
    along = np.einsum("ni,ij,nj->n", direction, covariance_arcsec2, direction)
    sigma = np.sqrt(seen.sigma_arcsec**2 + (np.trace(covariance_arcsec2) - along) / 2.0)
    is_near = away_deg < NEAR_DEG
    sigmas = np.where(is_near, np.radians(away_deg) * ARCSEC_PER_RADIAN / sigma, np.inf)
    fainter = np.where(is_near, seen.magnitude_mag - catalog.magnitude_mag[row], np.nan)
    return np.stack([sigmas, fainter])


@dataclass(frozen=True, eq=False)
class Factor:
    """Suspected cause of lost stars, with masks of the affected batches (b,) and stars (n,)."""

    batches: Flags
    stars: Flags
    text: str
    evidence: str
    remedy: str


def causes(now: StarTable, before: StarTable | None) -> list[Cause]:
    """Causes of ambiguous and unmatched stars, the cause with the most batches first."""
    if not len(now.outcome):
        return []
    lost = now.outcome != "u"
    found = []
    for make in FACTORS:
        for factor in make(now, before):
            hit = factor.stars & lost
            explained = factor.batches & ~now.solved
            explained[now.batch[hit]] = True
            if hit.any() and np.count_nonzero(explained) >= LEAST_BATCHES:
                found.append(_cause(factor, now, hit, explained))
    return sorted(found, key=lambda each: -each.batches)


def _cause(factor: Factor, now: StarTable, hit: Flags, explained: Flags) -> Cause:
    count, lost = int(np.count_nonzero(hit)), int(np.count_nonzero(now.outcome != "u"))
    last_s = float(unix_seconds(now.time_ns[explained])[-1])
    return Cause(
        batches=int(np.count_nonzero(explained)),
        text=factor.text,
        evidence=factor.evidence,
        remedy=factor.remedy,
        effect=f"{count} of {lost} ambiguous or unmatched stars.",
        over_since=utc_of_unix(last_s).text if is_over(explained, now.time_ns) else None,
    )


def is_over(explained: Flags, time_ns: npt.NDArray[np.int64]) -> bool:
    """True if a cause is over: the last batches (b,) without it are more than chance and a pause.

    The chance is that of a random order of the batches, in which none of the last ones has the
    cause; a cause that came back after a pause as long as the time since it was seen may again.
    """
    places = np.flatnonzero(explained)
    left = len(explained) - np.arange(len(places))
    quiet = len(explained) - 1 - places[-1]
    pause_ns = np.max(np.diff(time_ns[places]), initial=0)
    chance = np.prod(1.0 - quiet / left)
    return bool(chance < OVER_CHANCE and time_ns[-1] - time_ns[places[-1]] > pause_ns)


def _a_priori(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect a priori attitude errors beyond the zone: errors that grew, or a small zone."""
    beyond = now.a_priori_deg > now.room_deg
    angle, room = (
        float(np.nanmedian(each)) if np.isfinite(each).any() else np.nan
        for each in (now.a_priori_deg, now.room_deg)
    )
    evidence = (
        f"The zone leaves room for {room:.2f}°; the angle from the a priori attitude has a median "
        f"of {angle:.2f}°"
    )
    text = "The zone is too small for the errors of the a priori attitude."
    remedy = "Widen the zone, or correct the a priori attitude."
    if before is not None and np.isfinite(before.a_priori_deg).any():
        earlier = float(np.nanmedian(before.a_priori_deg))
        room_before = float(np.nanmedian(before.room_deg))
        evidence += f", before {earlier:.2f}°"
        if room < room_before - 0.01:
            text = "The zone was made smaller than the errors of the a priori attitude."
            evidence += f"; before, the zone left room for {room_before:.2f}°"
            remedy = "Put the former zone back."
        elif angle > FAR * earlier:
            text = "The a priori attitude is worse than before."
            remedy = "Correct its source; until then send the batches as lost in space."
        elif beyond.mean() <= NOISY * np.mean(before.a_priori_deg > before.room_deg) + USUAL_SHARE:
            # No statement: wrong attitudes are far from correct a priori ones, too.
            return
    evidence += "."
    if not now.solved.all() and np.count_nonzero(beyond) > np.count_nonzero(now.solved) / 2:
        beyond |= ~now.solved
        evidence += (
            " Batches without a good attitude count here, too: their angle is not known, and most "
            "of the others are beyond the zone."
        )
    yield Factor(beyond, beyond[now.batch], text, evidence, remedy)


def _wider_zone(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect a zone that was made larger, so that more catalog stars compete."""
    if before is None:
        return
    room_before = float(np.nanmedian(before.room_deg))
    wider = now.room_deg > room_before + 0.01
    if wider.any():
        yield Factor(
            wider,
            wider[now.batch],
            "The zone was made larger: more stars of the catalog compete for each observed one.",
            f"It leaves room for a priori errors of {now.room_deg[wider].max():.2f}°, before of "
            f"{room_before:.2f}°.",
            "Put the former zone back if the errors of the a priori attitude fit in it.",
        )


def _noise(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect trackers with more noise than the mission's sigma and than in the earlier period."""
    ratios = [now.noise(number) for number in range(len(now.trackers))]
    worst = max((each for each in ratios if np.isfinite(each)), default=0.0)
    for number, (name, ratio) in enumerate(zip(now.trackers, ratios, strict=True)):
        earlier = _earlier(before, name, StarTable.noise)
        # The attitude follows the noisiest tracker, and with it the residuals of the others.
        if not ratio > NOISY * max(1.0, np.nan_to_num(earlier), worst / 4.0):
            continue
        own = now.tracker == number
        was = "" if np.isnan(earlier) else f", before {earlier:.1f} times"
        yield Factor(
            np.bincount(now.batch[own], minlength=now.batches) > 0,
            own,
            f"{name} is noisy.",
            f"Its stars lie {ratio:.1f} times the mission's sigma from the catalog{was}.",
            f"Look at {name} first; leave it out of the batches, or raise its sigma_arcsec, until "
            "it is mended.",
        )


def _sensitivity(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect trackers that report fewer or only brighter stars than in the earlier period."""
    for number, name in enumerate(now.trackers):
        mean, mean_before = _both(now, before, number, lambda t, k: float(t.reported(k).mean()))
        faint, faint_before = _both(
            now, before, number, lambda t, k: _percentile(t.magnitude[t.tracker == k], 90.0)
        )
        if not (mean < FEWER * mean_before or faint < faint_before - BRIGHTER_MAG):
            continue
        usual = _earlier(before, name, lambda t, k: float(np.median(t.reported(k))))
        few = now.reported(number) < max(usual, 1.0)
        yield Factor(
            few,
            few[now.batch],
            f"{name} has lost sensitivity: it reports fewer stars.",
            f"{mean:.1f} stars a batch, before {mean_before:.1f}; nine of ten are brighter than "
            f"{faint:.1f} mag, before {faint_before:.1f} mag.",
            "Look for stray light, temperature or a changed threshold of the tracker.",
        )


def _density(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect fields of view with more catalog stars than 90 % of the earlier ones."""
    for number, name in enumerate(now.trackers):
        middle, middle_before = _both(
            now, before, number, lambda t, k: _percentile(t.density[:, k], 50.0)
        )
        usual = _earlier(before, name, lambda t, k: _percentile(t.density[:, k], 90.0))
        dense = now.density[:, number] > max(DENSER * middle_before, usual)
        if not middle > DENSER * middle_before:
            continue
        yield Factor(
            dense,
            dense[now.batch] & (now.tracker == number),
            f"{name} looks at dense fields.",
            f"{middle:.0f} catalog stars within {SURROUNDINGS_DEG:.0f}° of its boresight, before "
            f"{middle_before:.0f}.",
            "It passes when the pointing leaves them; a better a priori attitude or a smaller "
            "sigma leaves fewer rivals. Stars named wrongly meanwhile raise the residuals and the "
            "angle from the a priori attitude, too.",
        )


def _false_stars(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect trackers whose points often have no catalog star nearby."""
    for number, name in enumerate(now.trackers):
        share, earlier = _both(now, before, number, _false_share)
        if not share > FALSE_SHARE + NOISY * np.nan_to_num(earlier):
            continue
        false = (now.tracker == number) & np.isinf(now.offset_sigmas)
        was = "" if np.isnan(earlier) else f", before {100 * earlier:.1f} %"
        yield Factor(
            np.isin(np.arange(now.batches), now.batch[false]),
            false,
            f"{name} reports points that are no stars of the catalog.",
            f"{100 * share:.1f} % of its stars lie more than {NEAR_DEG:g}° from every catalog "
            f"star{was}.",
            "Look for particles, planets, radiation or reflections; see the objects that move.",
        )


def _false_share(table: StarTable, tracker: int) -> float:
    known = table.offset_sigmas[(table.tracker == tracker) & ~np.isnan(table.offset_sigmas)]
    return float(np.isinf(known).mean()) if len(known) else 0.0


def _magnitudes(now: StarTable, before: StarTable | None) -> Iterator[Factor]:
    """Detect trackers whose magnitudes shifted relative to the catalog."""
    for number, name in enumerate(now.trackers):
        offset, earlier = _both(
            now, before, number, lambda t, k: _percentile(t.offset_mag[t.tracker == k], 50.0)
        )
        if not abs(offset - np.nan_to_num(earlier)) > OFFSET_MAG:
            continue
        was = "" if np.isnan(earlier) else f", before {earlier:+.2f} mag"
        own = now.tracker == number
        yield Factor(
            np.isin(np.arange(now.batches), now.batch[own]),
            own,
            f"The magnitudes of {name} have shifted.",
            f"Observed minus catalog is {offset:+.2f} mag{was}.",
            "Calibrate its magnitudes; until then widen the magnitude tolerance.",
        )


def _both(
    now: StarTable,
    before: StarTable | None,
    number: int,
    value: Callable[[StarTable, int], float],
) -> tuple[float, float]:
    return value(now, number), _earlier(before, now.trackers[number], value)


FACTORS: tuple[Callable[[StarTable, StarTable | None], Iterator[Factor]], ...] = (
    _a_priori,
    _wider_zone,
    _noise,
    _sensitivity,
    _density,
    _false_stars,
    _magnitudes,
)


def _earlier(
    before: StarTable | None, tracker: str, value: Callable[[StarTable, int], float]
) -> float:
    """Value of one tracker computed for the earlier period; NaN without that period or tracker."""
    if before is None or tracker not in before.trackers:
        return float("nan")
    return value(before, before.trackers.index(tracker))


def _percentile(values: Vector, percent: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if len(known) else float("nan")


@dataclass(frozen=True)
class Part:
    """Share of ambiguous stars in a group of stars, now and in the earlier period."""

    name: str
    stars: int
    share: Interval
    before: Interval | None

    @property
    def points(self) -> float | None:
        """Change of the share of ambiguous stars in percentage points; None: no earlier share."""
        return None if self.before is None else 100.0 * (self.share.value - self.before.value)

    def with_shares(self, stars: int, share: float, before: float) -> "Part":
        """Part with the shares of whole periods, in place of those of a sample."""
        earlier = self.before and self.before.moved(before - self.before.value)
        return Part(self.name, stars, self.share.moved(share - self.share.value), earlier)

    @property
    def is_certain(self) -> bool:
        """True if the change is beyond chance: the intervals of the two periods differ."""
        return self.before is not None and self.share.differs(self.before)


def parts(now: StarTable, before: StarTable | None) -> list[Part]:
    """Ambiguous shares of groups of stars: all, by tracker, brightness and place in the field."""
    found = [_part("all stars", now, before, lambda t: np.ones(len(t.batch), bool))]
    if len(now.trackers) > 1:
        found += [_part(name, now, before, _of_tracker(name)) for name in now.trackers]
    middle = _percentile((before or now).magnitude, 50.0)
    if np.isfinite(middle):
        bright = f"{middle:.1f} mag or brighter"
        found.append(_part(bright, now, before, lambda t: t.magnitude <= middle))
        found.append(_part("fainter", now, before, lambda t: t.magnitude > middle))
    half = np.sqrt(0.5)
    found.append(_part("inner half of the field", now, before, lambda t: t.off_axis < half))
    found.append(_part("outer half", now, before, lambda t: t.off_axis >= half))
    return [each for each in found if each is not None]


def _of_tracker(name: str) -> Callable[[StarTable], Flags]:
    return lambda table: (
        table.tracker == (table.trackers.index(name) if name in table.trackers else -1)
    )


def _part(
    name: str, now: StarTable, before: StarTable | None, chosen: Callable[[StarTable], Flags]
) -> Part | None:
    shares = []
    for table in (now, before):
        of = chosen(table) if table is not None else np.empty(0, bool)
        shares.append(
            share_of(table.ambiguous[of], table.batch[of])
            if table is not None and of.any()
            else None
        )
    return (
        None
        if shares[0] is None
        else Part(name, int(np.count_nonzero(chosen(now))), shares[0], shares[1])
    )


def common_rivals(now: StarTable) -> list[tuple[str, int]]:
    """Most frequent groups of rival catalog stars, with their numbers of ambiguous stars."""
    return [(", ".join(names), n) for names, n in Counter(now.rivals).most_common(5)]

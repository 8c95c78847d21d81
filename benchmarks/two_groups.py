"""Views in which two groups of stars are consistent, or none is: what is called good must be right.

python -m benchmarks two_groups

Ghosts: every star is doubled by a reflection .05 to 1 deg away, as bright or up to 3 mag fainter,
in part with the magnitudes of the ghosts shuffled.  Slews: half of the stars were exposed after an
unreported slew of .05 to 5 deg.  Mirrored axes, and points that are no stars at all.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.acquire import Acquisition, acquire
from service.attitude.solution import AttitudeSolution
from service.missions.mission import Band, Mission, load_missions
from service.observe.batch import ObservationBatch, Options, QuaternionPrior, TrackerStars
from service.simulate.motion import pointed, random_axis, tilted, turned
from service.simulate.sightings import anywhere, shaken
from service.sky.catalog import load_embedded
from service.sky.ephemeris import sun_direction
from service.sky.run_catalog import RunCatalog
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.times import parse_utc
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    attitude_error_arcsec,
    coordinate_rotation,
    quaternion_from_matrix,
    read_only,
)

Rows = npt.NDArray[np.intp]

MISSIONS = ("XTE", "SWAS", "SOHO")
MOMENT = parse_utc("1996-03-01T00:00:00Z")
GHOST_SHIFT_DEG, SLEW_DEG = (0.05, 1.0), (0.05, 5.0)
GHOST_DIMMING_MAG = (0.0, 0.0, 1.0, 2.0, 3.0)
SAME_ATTITUDE_DEG = 0.03
"""An attitude nearer to another than this is taken for the same: the least shift is .05 deg."""
LARGEST_ERROR = 40.0
"""e^T P^-1 e of an error that noise explains: more than this chi-square of three hardly ever is."""
CAP_PRIOR_DEG, BAND_PRIOR_DEG = 3.0, 0.1
"""How far the a priori attitude is off at most: each angle in a cap, the pole in a band."""


@dataclass(frozen=True)
class Group:
    """Stars of one attitude: directions in tracker axes, magnitudes, rows of the run catalog."""

    attitude: Matrix
    direction: Vector
    magnitude_mag: Vector
    star: Rows

    def __len__(self) -> int:
        return len(self.magnitude_mag)


@dataclass(frozen=True)
class Views:
    """Draws groups of stars for one mission, and makes batches of them."""

    mission: Mission
    sky: Sky
    rng: np.random.Generator

    @property
    def run_catalog(self) -> RunCatalog:
        """The run catalog that batches are identified in."""
        return self.sky.run_catalog(self.mission, MOMENT)

    def attitude(self) -> Matrix:
        """Anywhere; a mission with a band keeps its pole near the Sun."""
        roll = self.rng.uniform(0.0, math.tau)
        if isinstance(self.mission.zone, Band):
            tilt = math.radians(self.rng.uniform(0.0, BAND_PRIOR_DEG))
            return pointed(
                self.mission.axis_body, tilted(sun_direction(MOMENT, None), tilt, self.rng), roll
            )
        return pointed(self.mission.axis_body, random_axis(self.rng), roll)

    def prior(self, attitude: Matrix) -> QuaternionPrior:
        """An a priori attitude that is off as the mission's is."""
        if isinstance(self.mission.zone, Band):
            roll = self.rng.uniform(0.0, math.tau)
            presumed = pointed(self.mission.axis_body, sun_direction(MOMENT, None), roll)
        else:
            psi, theta, phi = self.rng.uniform(-CAP_PRIOR_DEG, CAP_PRIOR_DEG, 3)
            error = coordinate_rotation(0, psi) @ coordinate_rotation(1, theta)
            presumed = (error @ coordinate_rotation(2, phi)).T @ attitude
        return QuaternionPrior(read_only(quaternion_from_matrix(presumed)))

    def visible(self, attitude: Matrix) -> Rows:
        """The stars in the field of view, in random order."""
        tracker, catalog = self.mission.trackers[0], self.run_catalog
        boresight = attitude.T @ tracker.body_from_tracker[:, 2]
        least = math.cos(math.radians(tracker.field_of_view_radius_deg))
        return self.rng.permutation(np.flatnonzero(catalog.direction @ boresight >= least))

    def group(self, attitude: Matrix, star: Rows) -> Group:
        """These stars as they are measured at an attitude."""
        tracker, catalog = self.mission.trackers[0], self.run_catalog
        exact = catalog.direction[star] @ attitude.T @ tracker.body_from_tracker
        noise_mag = self.rng.normal(0.0, tracker.magnitude_sigma_mag, len(star))
        return Group(
            attitude,
            shaken(exact, tracker.sigma_arcsec / ARCSEC_PER_RADIAN, self.rng),
            catalog.magnitude_mag[star] + noise_mag,
            star,
        )

    def field(self, stars: int) -> Group:
        """So many stars at an attitude that shows as many."""
        while True:
            attitude = self.attitude()
            star = self.visible(attitude)
            if len(star) >= stars:
                return self.group(attitude, star[:stars])

    def shifted(self, attitude: Matrix, least_deg: float, most_deg: float) -> Matrix:
        """The attitude after a turn across the boresight."""
        boresight = self.mission.trackers[0].body_from_tracker[:, 2]
        axis = np.cross(boresight, random_axis(self.rng))
        axis /= np.linalg.norm(axis)
        return turned(attitude, axis * math.radians(self.rng.uniform(least_deg, most_deg)))

    def ghosts(self, stars: int) -> tuple[Group, Group]:
        """So many stars and as many reflections of them."""
        real = self.field(stars)
        ghost = self.group(self.shifted(real.attitude, *GHOST_SHIFT_DEG), real.star)
        magnitude = ghost.magnitude_mag + self.rng.choice(GHOST_DIMMING_MAG)
        if self.rng.random() < 0.5:
            magnitude = self.rng.permutation(magnitude)
        return real, replace(ghost, magnitude_mag=magnitude)

    def slew(self, stars: int) -> tuple[Group, Group]:
        """Half of so many stars before a slew and half after it."""
        half = stars // 2
        while True:
            before = self.attitude()
            after = self.shifted(before, *SLEW_DEG)
            here, there = self.visible(before), self.visible(after)
            there = there[~np.isin(there, here[:half])]
            if min(len(here), len(there)) >= half:
                return self.group(before, here[:half]), self.group(after, there[:half])

    def random_points(self, points: int) -> Group:
        """Points that are no stars, as bright as stars of the catalog."""
        tracker, catalog = self.mission.trackers[0], self.run_catalog
        radius = math.radians(tracker.field_of_view_radius_deg)
        return Group(
            self.attitude(),
            anywhere(radius, points, self.rng),
            self.rng.choice(catalog.magnitude_mag, points),
            np.full(points, -1),
        )

    def batch(
        self, *groups: Group, prior: QuaternionPrior | None, options: Options | None = None
    ) -> tuple[ObservationBatch, npt.NDArray[np.intp]]:
        """A batch of these groups' stars in random order, and that order."""
        direction = np.concatenate([group.direction for group in groups])
        magnitude = np.concatenate([group.magnitude_mag for group in groups])
        order = self.rng.permutation(len(magnitude))
        n = len(order)
        stars = TrackerStars(
            self.mission.trackers[0].name,
            read_only(direction[order]),
            read_only(np.full((n, 2), np.nan)),
            read_only(magnitude[order]),
            read_only(np.zeros(n)),
            read_only(np.full(n, np.nan)),
        )
        batch = ObservationBatch(
            spacecraft=self.mission.name,
            batch="two-groups",
            run="benchmark",
            time=MOMENT,
            a_priori=prior,
            body_rates_deg_per_s=read_only(np.zeros(3)),
            velocity_km_per_s=None,
            aberration="ignore",
            observations=(stars,),
            options=options or Options(),
        )
        return batch, order

    def acquire(self, batch: ObservationBatch) -> Acquisition:
        """The answer to a batch."""
        return acquire(batch, self.mission, self.sky)


def is_good(found: Acquisition) -> bool:
    """Whether the answer has an attitude that it calls good."""
    return found.solution is not None and not found.solution.suspect


def is_at(solution: AttitudeSolution, attitude: Matrix) -> bool:
    """Whether a solution is at an attitude, but for noise: few stars may fix an axis badly."""
    off_arcsec = attitude_error_arcsec(solution.matrix, attitude)
    if math.hypot(*off_arcsec) < 3600.0 * SAME_ATTITUDE_DEG:
        return True
    weighted = off_arcsec @ np.linalg.solve(solution.covariance_arcsec2, off_arcsec)
    return float(weighted) < LARGEST_ERROR


@dataclass
class Counted:
    """What came of the batches of one row."""

    batches: int = 0
    good: int = 0
    answered: int = 0
    good_and_wrong: int = 0
    named: int = 0
    named_wrong: int = 0
    smaller_good_alone: int = 0
    of_these_with_rival: int = 0
    missed: list[int] = field(default_factory=list)

    @property
    def wrong_pct(self) -> float:
        """Good answers that are wrong, or leave out a group that would give a good one."""
        return 100.0 * self.good_and_wrong / self.batches

    @property
    def named_right_pct(self) -> float:
        """Of the stars that are named as certain, those named rightly."""
        return 100.0 * (1.0 - self.named_wrong / max(self.named, 1))

    @property
    def rival_pct(self) -> float:
        """Of the batches whose other group alone gives a good attitude, those that name it."""
        return 100.0 * self.of_these_with_rival / max(self.smaller_good_alone, 1)


def two_groups(
    views: Views,
    kind: str,
    stars: int,
    with_prior: bool,
    batches: int,
    step: Callable[[int], object] = int,
) -> Counted:
    """Batches of ghosts or slews, counted."""
    counted = Counted()
    for number in range(batches):
        first, second = views.ghosts(stars) if kind == "ghosts" else views.slew(stars)
        prior = views.prior(first.attitude) if with_prior else None
        batch, order = views.batch(first, second, prior=prior)
        found = views.acquire(batch)
        _count(counted, views, kind, found, order, first, second, prior, number)
        step(1)
    return counted


def _count(
    counted: Counted,
    views: Views,
    kind: str,
    found: Acquisition,
    order: Rows,
    first: Group,
    second: Group,
    prior: QuaternionPrior | None,
    number: int,
) -> None:
    counted.batches += 1
    good = is_good(found)
    counted.good += good
    identification = found.trackers[0].identification
    # A reflection is no star; of a slew either group is real.
    second_star = np.full(len(second), -1) if kind == "ghosts" else second.star
    truth = np.concatenate([first.star, second_star])[order]
    certain = identification.unique
    counted.named += int(certain.sum())
    counted.named_wrong += int((certain & (identification.star != truth)).sum())
    told = [] if found.solution is None else [found.solution]
    rival = found.rival
    if rival is not None:
        told.append(rival.solution)
    named = [any(is_at(solution, each.attitude) for solution in told) for each in (first, second)]
    right = (named[0],) if kind == "ghosts" else named
    is_wrong = not any(right)
    if found.solution is not None:
        counted.answered += 1
        for group, is_named in ((first, named[0]), (second, named[1])):
            if is_at(found.solution, group.attitude):
                continue
            alone = views.acquire(views.batch(group, prior=prior)[0])
            if _is_right(alone, group.attitude):
                counted.smaller_good_alone += 1
                counted.of_these_with_rival += is_named
                if not is_named:
                    counted.missed.append(number)
                    is_wrong = True
    counted.good_and_wrong += good and is_wrong


def _is_right(found: Acquisition, attitude: Matrix) -> bool:
    """Whether the answer is good, and at this attitude."""
    solution = found.solution
    return solution is not None and not solution.suspect and is_at(solution, attitude)


def mirrored(views: Views, stars: int, batches: int, step: Callable[[int], object] = int) -> int:
    """How many batches of a tracker with one axis of the wrong sign are called good."""
    good = 0
    for _ in range(batches):
        group = views.field(stars)
        image = replace(group, direction=read_only(group.direction * np.array([-1.0, 1.0, 1.0])))
        good += is_good(views.acquire(views.batch(image, prior=views.prior(group.attitude))[0]))
        step(1)
    return good


def random_points(
    views: Views, points: int, batches: int, step: Callable[[int], object] = int
) -> int:
    """How many batches without any star are called good."""
    good = 0
    for _ in range(batches):
        group = views.random_points(points)
        good += is_good(views.acquire(views.batch(group, prior=views.prior(group.attitude))[0]))
        step(1)
    return good


@dataclass
class Nominal:
    """What came of batches of real stars alone."""

    batches: int = 0
    good: int = 0
    flagged: int = 0
    """With a rival or called mirrored."""


def nominal(
    views: Views, fewest: int, most: int, batches: int, step: Callable[[int], object] = int
) -> Nominal:
    """Batches of so many real stars, as the mission sees them."""
    counted = Nominal()
    for _ in range(batches):
        group = views.field(int(views.rng.integers(fewest, most + 1)))
        found = views.acquire(views.batch(group, prior=views.prior(group.attitude))[0])
        counted.batches += 1
        counted.good += _is_right(found, group.attitude)
        counted.flagged += found.rival is not None or any(
            each.identification.mirrored for each in found.trackers
        )
        step(1)
    return counted

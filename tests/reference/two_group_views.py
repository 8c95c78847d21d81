"""Views with known truth in which two groups of stars are consistent, or none is.

Ghosts double every star by a reflection; a slew within the batch leaves two
halves.  Beside them single groups, and points that are no stars.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service import vectors
from service.missions.mission import Band, Mission
from service.observations.batch import ObservationBatch, Options, QuaternionPrior, TrackerStars
from service.simulate.motion import pointed, random_axis, tilted, turned_by
from service.simulate.sightings import anywhere, shaken
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_direction
from service.sky.model import SkyModel
from service.times import parse_utc

Rows = npt.NDArray[np.intp]

MOMENT = parse_utc("1996-03-01T00:00:00Z")
GHOST_SHIFT_DEG, SLEW_DEG = (0.05, 1.0), (0.05, 5.0)
GHOST_DIMMING_MAG = (0.0, 0.0, 1.0, 2.0, 3.0)
CAP_PRIOR_DEG, BAND_PRIOR_DEG = 3.0, 0.1
"""How far the a priori attitude is off at most: each angle in a cap, the pole in a band."""


@dataclass(frozen=True)
class Group:
    """Stars of one attitude: directions in tracker axes, magnitudes, rows of the run catalog."""

    attitude: vectors.Matrix
    direction: vectors.Vector
    magnitude_mag: vectors.Vector
    star: Rows

    def __len__(self) -> int:
        return len(self.magnitude_mag)


@dataclass(frozen=True)
class Views:
    """Draws groups of stars for one mission, and makes batches of them."""

    mission: Mission
    sky: SkyModel
    rng: np.random.Generator

    @property
    def run_catalog(self) -> RunCatalog:
        """The run catalog that batches are identified in."""
        return self.sky.run_catalog(self.mission, MOMENT)

    def attitude(self) -> vectors.Matrix:
        """Anywhere; a mission with a band keeps its pole near the Sun."""
        roll = self.rng.uniform(0.0, math.tau)
        if isinstance(self.mission.zone, Band):
            tilt = math.radians(self.rng.uniform(0.0, BAND_PRIOR_DEG))
            return pointed(
                self.mission.axis_body, tilted(sun_direction(MOMENT, None), tilt, self.rng), roll
            )
        return pointed(self.mission.axis_body, random_axis(self.rng), roll)

    def prior(self, attitude: vectors.Matrix) -> QuaternionPrior:
        """An a priori attitude that is off as the mission's is."""
        if isinstance(self.mission.zone, Band):
            roll = self.rng.uniform(0.0, math.tau)
            presumed = pointed(self.mission.axis_body, sun_direction(MOMENT, None), roll)
        else:
            psi, theta, phi = self.rng.uniform(-CAP_PRIOR_DEG, CAP_PRIOR_DEG, 3)
            error = vectors.coordinate_rotation(0, psi) @ vectors.coordinate_rotation(1, theta)
            presumed = (error @ vectors.coordinate_rotation(2, phi)).T @ attitude
        return QuaternionPrior(vectors.read_only(vectors.quaternion_from_matrix(presumed)))

    def visible(self, attitude: vectors.Matrix) -> Rows:
        """The stars in the field of view, in random order."""
        tracker, catalog = self.mission.trackers[0], self.run_catalog
        boresight = attitude.T @ tracker.body_from_tracker[:, 2]
        least = math.cos(math.radians(tracker.field_of_view_radius_deg))
        return self.rng.permutation(np.flatnonzero(catalog.direction @ boresight >= least))

    def group(self, attitude: vectors.Matrix, star: Rows) -> Group:
        """These stars as they are measured at an attitude."""
        tracker, catalog = self.mission.trackers[0], self.run_catalog
        exact = catalog.direction[star] @ attitude.T @ tracker.body_from_tracker
        noise_mag = self.rng.normal(0.0, tracker.magnitude_sigma_mag, len(star))
        return Group(
            attitude,
            shaken(exact, tracker.sigma_arcsec / vectors.ARCSEC_PER_RADIAN, self.rng),
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

    def shifted(
        self, attitude: vectors.Matrix, least_deg: float, most_deg: float
    ) -> vectors.Matrix:
        """The attitude after a turn across the boresight."""
        boresight = self.mission.trackers[0].body_from_tracker[:, 2]
        axis = np.cross(boresight, random_axis(self.rng))
        axis /= np.linalg.norm(axis)
        return turned_by(attitude, axis * math.radians(self.rng.uniform(least_deg, most_deg)))

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
            early, late = self.visible(before), self.visible(after)
            late = late[~np.isin(late, early[:half])]
            if min(len(early), len(late)) >= half:
                return self.group(before, early[:half]), self.group(after, late[:half])

    def mirrored(self, stars: int) -> Group:
        """So many stars as a tracker with one axis of the wrong sign measures them."""
        group = self.field(stars)
        return replace(
            group, direction=vectors.read_only(group.direction * np.array([-1.0, 1.0, 1.0]))
        )

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
    ) -> tuple[ObservationBatch, Rows]:
        """A batch of these groups' stars in random order, and that order."""
        direction = np.concatenate([group.direction for group in groups])
        magnitude = np.concatenate([group.magnitude_mag for group in groups])
        order = self.rng.permutation(len(magnitude))
        n = len(order)
        stars = TrackerStars(
            self.mission.trackers[0].name,
            vectors.read_only(direction[order]),
            vectors.read_only(np.full((n, 2), np.nan)),
            vectors.read_only(magnitude[order]),
            vectors.read_only(np.zeros(n)),
            vectors.read_only(np.full(n, np.nan)),
        )
        batch = ObservationBatch(
            spacecraft=self.mission.name,
            batch="two-groups",
            run="benchmark",
            time=MOMENT,
            a_priori=prior,
            body_rates_deg_per_s=vectors.read_only(np.zeros(3)),
            velocity_km_per_s=None,
            aberration="ignore",
            observations=(stars,),
            options=options or Options(),
        )
        return batch, order

"""Table of identified stars of many batches, the input of a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.missions.mission import Tracker
from service.vectors import Matrix, Vector

Indices = npt.NDArray[np.int64]

LEAST_STARS = 2
"""Least number of stars of a batch: one star alone determines no attitude, so no calibration."""


@dataclass(frozen=True, eq=False)
class IdentifiedStars:
    """Observed stars (n,) with their catalog directions, and the batches (K,) they belong to.

    `batch` and `tracker` are indices into the batches and into `trackers`.
    `measured_rad` (n, 2) are the angles h, v as the tracker sent them, `angles_rad`
    the same through its present focal-plane calibration: the direction is that of
    (tan h, tan v, 1) in tracker axes.  `reference` (n, 3) are inertial unit vectors,
    apparent as the spacecraft sees them.  `sigma_rad` is one standard deviation per
    tangent axis; `time_offset_s` a star's time minus its batch's.  `temperature_c`
    is NaN where it is not known.

    Batches are in order of time: `time_s` from any epoch, `attitude` (K, 3, 3) from
    inertial to body axes, approximate, and `rates_rad_per_s` (K, 3) in body axes.
    """

    trackers: tuple[Tracker, ...]
    batch: Indices
    tracker: Indices
    measured_rad: Vector
    angles_rad: Vector
    reference: Vector
    sigma_rad: Vector
    time_offset_s: Vector
    temperature_c: Vector
    time_s: Vector
    attitude: Matrix
    rates_rad_per_s: Vector

    def __post_init__(self) -> None:
        if not len(self.time_s):
            raise BadInput(Fault("stars", "must be of at least one batch", "0 batches"))
        if (np.diff(self.time_s) < 0.0).any():
            raise BadInput(Fault("time_s", "must not decrease"))

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def batches(self) -> int:
        """Number of batches in the table."""
        return len(self.time_s)

    def chosen(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> "IdentifiedStars":
        """Table with the stars in the given rows; the batches stay unchanged."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _OF_STARS})

    def usable(self, attitudes_known: bool) -> "IdentifiedStars":
        """Stars sorted by tracker and batch, without batches of fewer than two stars.

        Batches with one star are kept if attitudes are known.  Raises `BadInput` if no batch is
        left.
        """
        stars = self if attitudes_known else self._with_enough_stars()
        return stars.chosen(np.lexsort((stars.batch, stars.tracker)))

    def _with_enough_stars(self) -> "IdentifiedStars":
        count = np.bincount(self.batch, minlength=self.batches)
        kept = count >= LEAST_STARS
        if kept.all():
            return self
        place = np.cumsum(kept) - 1
        stars = self.chosen(kept[self.batch])
        return replace(
            stars,
            batch=place[stars.batch],
            time_s=self.time_s[kept],
            attitude=self.attitude[kept],
            rates_rad_per_s=self.rates_rad_per_s[kept],
        )


_OF_STARS = (
    "batch",
    "tracker",
    "measured_rad",
    "angles_rad",
    "reference",
    "sigma_rad",
    "time_offset_s",
    "temperature_c",
)
_OF_BATCHES = ("time_s", "attitude", "rates_rad_per_s")


def joined(parts: Sequence[IdentifiedStars]) -> IdentifiedStars:
    """Merge tables of identified stars from disjoint batches into one, in order of time."""
    shift = np.cumsum([0, *(part.batches for part in parts)])
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for each in fields(IdentifiedStars)
        if (name := each.name) in _OF_STARS + _OF_BATCHES
    }
    columns["batch"] = np.concatenate(
        [part.batch + first for part, first in zip(parts, shift[:-1], strict=True)]
    )
    order = np.argsort(columns["time_s"], kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    columns["batch"] = place[columns["batch"]]
    for name in _OF_BATCHES:
        columns[name] = columns[name][order]
    return IdentifiedStars(trackers=parts[0].trackers, **columns)

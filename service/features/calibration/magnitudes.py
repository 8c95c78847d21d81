"""Zero point, scale and colour term of each tracker's magnitudes, from identified stars.

A robust line for each tracker: observed minus catalog magnitude is

    z + s (m - p) + c (b - q),

m the catalog magnitude and b the colour B-V of the star, p and q their medians over the
tracker's stars.  Sigmas take the observations of one star together, because what the catalog
has wrong of a star is the same in every batch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from service.errors import BadInput, Fault
from service.features.calibration.elimination import NotObservable
from service.features.calibration.stars import Indices
from service.missions.mission import AS_MEASURED, Magnitudes, Tracker
from service.vectors import Matrix, Vector

ZERO, SCALE, COLOR = "magnitude zero", "magnitude scale", "magnitude colour"
UNITS = {ZERO: "mag", SCALE: "1", COLOR: "mag/mag"}
PLAUSIBLE = {ZERO: 1.0, SCALE: 0.3, COLOR: 0.5}
"""Largest sigma, in the unit of each, with which a magnitude unknown still counts as observable."""
LARGEST = {ZERO: 20.0, SCALE: 0.4, COLOR: 1.0}
"""Largest plausible value of a magnitude unknown; more means constant data or other units."""
REASONS = {
    ZERO: "too few different stars with a magnitude",
    SCALE: "the stars are all about as bright as each other",
    COLOR: "the stars have too few different colours that the catalog knows: it looks like the "
    "magnitude zero",
}
LEAST_STARS = 10
"""Least number of different stars per estimated unknown: fewer give no reliable scatter."""
LEAST_SPREAD_MAG = 0.05
"""Least rms spread of magnitudes or colours that must remain after the other unknowns."""
HUBER, WRONG = 1.5, 5.0
"""Bounds of a residual in sigmas: above the first its weight falls, above the second it is 0."""
ROUNDS = 50
SETTLED_MAG = 1e-6
MEDIAN_SIZE = 0.6744897501960817
"""Median absolute value of a Gaussian residual, in sigmas."""


@dataclass(frozen=True, eq=False)
class MagnitudeStars:
    """Observations (n,) of identified stars that have a measured magnitude.

    `tracker` are indices into the trackers and `star` rows of the star catalog.  `observed_mag`
    is as corrected by the settings in force, `catalog_mag` the instrument magnitude of the run
    catalog, `color_bv_mag` B-V, NaN where it is not known.
    """

    tracker: Indices
    star: Indices
    observed_mag: Vector
    catalog_mag: Vector
    color_bv_mag: Vector


@dataclass(frozen=True, eq=False)
class MagnitudeCalibration:
    """Magnitude calibration of a tracker: `value` (p,) and `covariance` (p, p) of the terms
    `names`.

    The zero point is that of a star of magnitude `pivot_mag` and colour `pivot_bv_mag`.
    `scatter_mag` is the sigma of one observation.
    """

    tracker: int
    names: tuple[str, ...]
    value: Vector
    covariance: Matrix
    pivot_mag: float
    pivot_bv_mag: float
    scatter_mag: float
    stars: int
    not_observable: tuple[NotObservable, ...]

    @property
    def sigma(self) -> Vector:
        """Standard deviation (p,) of each magnitude term."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def value_of(self, name: str) -> float:
        """Value of a magnitude term; 0 if not estimated."""
        return float(self.value[self.names.index(name)]) if name in self.names else 0.0


@dataclass(frozen=True, eq=False)
class _Line:
    """Fitted line: values (p,), covariance (p, p), sigma of one observation, mask of used ones."""

    value: Vector
    covariance: Matrix
    scatter: float
    used: npt.NDArray[np.bool_]


def joined(parts: Sequence[MagnitudeStars]) -> MagnitudeStars | None:
    """Concatenate the observations of several batches; None without any."""
    if not parts:
        return None
    names = ("tracker", "star", "observed_mag", "catalog_mag", "color_bv_mag")
    return MagnitudeStars(
        **{name: np.concatenate([getattr(each, name) for each in parts]) for name in names}
    )


def calibrate_magnitudes(
    stars: MagnitudeStars | None, trackers: Sequence[str], settings: Mapping[str, Magnitudes]
) -> tuple[MagnitudeCalibration, ...]:
    """Calibrate the magnitudes of every tracker; terms that its stars do not determine are named.

    A result that would give a tracker magnitude settings outside of the range of mission files is
    dropped and named as well.
    """
    found = []
    for index, name in enumerate(trackers):
        each = _of_tracker(stars, index, name)
        try:
            _corrected(settings.get(name, AS_MEASURED), each, 0.0)
        except BadInput as error:
            (fault, *_) = error.faults
            each = _nothing(index, name, dict.fromkeys(UNITS, f"it {fault.message}"))
        found.append(each)
    return tuple(found)


def calibrated_settings(
    trackers: Sequence[Tracker], found: Sequence[MagnitudeCalibration], names: Sequence[str]
) -> dict[str, Magnitudes]:
    """Magnitude settings of all trackers by name, updated with the calibrations of the trackers
    `names`.

    `trackers` have the settings that the observations were corrected with.  The run catalog has the
    mean colour term of all trackers, so that each is right at its median colour.
    """
    by_name = {names[each.tracker]: each for each in found if each.names}
    change = sum(each.value_of(COLOR) for each in by_name.values()) / len(trackers)
    return {
        each.name: _corrected(each.magnitudes, by_name[each.name], change)
        if each.name in by_name
        else each.magnitudes
        for each in trackers
    }


def _corrected(
    present: Magnitudes, found: MagnitudeCalibration, color_change_mag: float
) -> Magnitudes:
    stretch = 1.0 + found.value_of(SCALE)
    zero_mag = present.zero_mag - found.value_of(ZERO) + found.value_of(SCALE) * found.pivot_mag
    try:
        return Magnitudes(
            zero_mag=round(zero_mag / stretch + color_change_mag * found.pivot_bv_mag, 6),
            scale=round(present.scale / stretch, 8),
            color_mag=round(present.color_mag + found.value_of(COLOR), 6),
        )
    except ValidationError as error:
        (first, *_) = error.errors()
        message = f"would have {first['loc'][0]} {first['input']:g}, which no mission file may have"
        raise BadInput(Fault("magnitudes", message)) from None


def _of_tracker(stars: MagnitudeStars | None, index: int, tracker: str) -> MagnitudeCalibration:
    own = np.zeros(0, np.int64) if stars is None else np.flatnonzero(stars.tracker == index)
    if stars is None or len(np.unique(stars.star[own])) < LEAST_STARS:
        return _nothing(index, tracker)
    off = stars.observed_mag[own] - stars.catalog_mag[own]
    catalog_mag, color = stars.catalog_mag[own], stars.color_bv_mag[own]
    colored = np.isfinite(color)
    pivot_mag = float(np.median(catalog_mag))
    pivot_bv_mag = float(np.median(color[colored])) if colored.any() else 0.0
    columns = {
        ZERO: np.ones(len(own)),
        SCALE: catalog_mag - pivot_mag,
        COLOR: np.where(colored, color, pivot_bv_mag) - pivot_bv_mag,
    }
    kept = _with_spread(columns, stars.star[own])
    reasons = dict(REASONS)
    while kept:
        # A star of unknown colour cannot be used to estimate a colour term.
        rows = colored if COLOR in kept else np.ones(len(own), dtype=np.bool_)
        design = np.column_stack([columns[name] for name in kept])[rows]
        line = _robust_line(design, off[rows], stars.star[own][rows])
        # One star that is seen far more often than the others may leave none of them.
        used = np.flatnonzero(rows)[np.zeros(0, np.int64) if line is None else line.used]
        of_used = {name: each[used] for name, each in columns.items()}
        if line is None or not set(kept) <= set(_with_spread(of_used, stars.star[own][used])):
            kept.pop()
            continue
        beyond = _beyond(kept, line)
        reasons |= {
            name: f"it would be {value:.3g} {UNITS[name]}, which is that of no tracker"
            for name, value in zip(kept, line.value.tolist(), strict=True)
            if abs(value) > LARGEST[name]
        }
        if not beyond:
            count = int(rows.sum())
            missing = _missing(tracker, kept, reasons)
            return MagnitudeCalibration(
                index,
                tuple(kept),
                *(line.value, line.covariance, pivot_mag, pivot_bv_mag, line.scatter),
                *(count, missing),
            )
        kept.remove(beyond[-1])
    return _nothing(index, tracker, reasons)


def _beyond(names: Sequence[str], line: _Line) -> list[str]:
    """Magnitude unknowns with a sigma too large to count as observable, or an implausible value."""
    sigma = np.sqrt(np.diag(line.covariance))
    return [
        name
        for name, value, each in zip(names, line.value, sigma, strict=True)
        if abs(value) > LARGEST[name] or (not each <= PLAUSIBLE[name] and name != ZERO)
    ]


def _with_spread(columns: dict[str, Vector], star: Indices) -> list[str]:
    """Names of magnitude unknowns that the spread of the stars determines; none with few stars."""
    _, first = np.unique(star, return_index=True)
    if len(first) < LEAST_STARS:
        return []
    kept = [ZERO]
    for name in (SCALE, COLOR):
        before = np.column_stack([columns[each][first] for each in kept])
        own = columns[name][first]
        left = own - before @ np.linalg.lstsq(before, own, rcond=None)[0]
        enough = len(first) >= LEAST_STARS * (len(kept) + 1)
        if enough and math.sqrt(float(np.mean(left**2))) > LEAST_SPREAD_MAG:
            kept.append(name)
    return kept


def _robust_line(design: Matrix, off: Vector, star: Indices) -> _Line | None:
    """Robust line fit with the columns of `design` (n, p); None if the remaining data are singular.

    The covariance sums the contributions of each star (Huber 1967; Liang & Zeger 1986).
    """
    try:
        return _fitted(design, off, star)
    except np.linalg.LinAlgError:
        return None


def _fitted(design: Matrix, off: Vector, star: Indices) -> _Line:
    n, p = design.shape
    value = np.zeros(p)
    value[0] = np.median(off)
    scatter, weight = 1.0, np.ones(n)
    for number in range(ROUNDS):
        residual = off - design @ value
        size = float(np.median(np.abs(residual))) / MEDIAN_SIZE
        scatter = max(size * math.sqrt(n / max(n - p, 1)), 1e-6)
        length = np.abs(residual) / scatter
        weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-300))
        # In the first iterations the line may be far off, and a good star look wrong.
        weight[(length > WRONG) & (number > 2)] = 0.0
        step = np.linalg.solve(
            design.T @ (design * weight[:, None]), design.T @ (weight * residual)
        )
        value = value + step
        if number > 2 and float(np.abs(step).max()) < SETTLED_MAG:
            break
    residual = off - design @ value
    # Beyond the bound the weighted residual is constant, with slope zero.
    slope = (np.abs(residual) <= HUBER * scatter).astype(np.float64)
    inverse = np.linalg.inv(design.T @ (design * slope[:, None]))
    _, place = np.unique(star, return_inverse=True)
    pulls = np.zeros((int(place.max()) + 1, p))
    np.add.at(pulls, place.reshape(-1), design * (weight * residual)[:, None])
    count = len(pulls)
    inner = pulls.T @ pulls * (count / max(count - p, 1))
    return _Line(value, np.asarray(inverse @ inner @ inverse), scatter, weight > 0.0)


def _missing(
    tracker: str, kept: Sequence[str], reasons: Mapping[str, str]
) -> tuple[NotObservable, ...]:
    return tuple(
        NotObservable(f"{tracker} {name}", reason)
        for name, reason in reasons.items()
        if name not in kept
    )


def _nothing(
    index: int, tracker: str, reasons: Mapping[str, str] = REASONS
) -> MagnitudeCalibration:
    missing = tuple(NotObservable(f"{tracker} {name}", reasons[ZERO]) for name in UNITS)
    none = np.zeros(0)
    return MagnitudeCalibration(index, (), none, np.zeros((0, 0)), 0.0, 0.0, 0.0, 0, missing)

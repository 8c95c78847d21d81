"""Claims of IM-11: finding stars by raster sums, and the pattern constant."""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.features.pictures.centroids.psf import GaussianPsf
from service.features.pictures.centroids.window import Array
from service.observations.scans.lines import line_peaks
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import ARCSEC_PER_RADIAN, unit
from studies.star_image_report.claims import Claim, Picture, Row, Study

SIGMA_ARCSEC = 35.25
"""Angle of a pixel in the lost-in-space paper's camera, in arcsec."""
STORES = (10, 30, 100, 300, 1000, 3000)
STARS = (3, 5, 8)
LEAST_FIELDS = 600
RADIUS_DEG, FAINTEST_MAG = 5.0, 6.0


def patterns(study: Study) -> Row:
    """Check the claims of IM-11 on raster sums and the pattern constant."""
    rng = study.rng(11)
    shares = _discrimination(study)
    return Row(
        "IM-11",
        "Raster finder and pattern constant",
        (
            _identity(rng),
            _noise(rng, study.trials(20_000)),
            *_rasters(rng, 100 if study.quick else 400),
            _recogniser(shares),
            _pointing(rng),
        ),
        {
            "imaging-pattern": Picture(
                "How often K alone knows a field again (V 6, brightest within 5°, errors of "
                "35.25″ per axis): only one stored field within three sigma, and the nearest.",
                (8.0, 3.2),
                lambda figure: _draw(figure, shares),
            )
        },
    )


def _identity(rng: np.random.Generator) -> Claim:
    worst = shuffled = 0.0
    for _ in range(200):
        x, y = rng.uniform(-1, 1, (2, int(rng.integers(2, 12))))
        pairs = sum(
            (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2
            for i, j in itertools.combinations(range(len(x)), 2)
        )
        constant = pattern_constant(x, y)
        worst = max(worst, abs(constant / pairs - 1.0))
        shuffled = max(shuffled, abs(pattern_constant(x, rng.permutation(y)) / constant - 1.0))
    return Claim(
        "7.43",
        "K is the sum of all squared distances, whichever y belongs to which x",
        f"to {worst:.0e} in 200 fields; shuffled, to {shuffled:.0e}",
        "confirmed",
        max(worst, shuffled) < 1e-12,
        {"identity": worst, "shuffled": shuffled},
    )


def _noise(rng: np.random.Generator, trials: int) -> Claim:
    field, sigma = rng.uniform(-1, 1, (2, 6)), 1e-3
    constant = pattern_constant(*field)
    found = [pattern_constant(*each) for each in field + rng.normal(0, sigma, (trials, 2, 6))]
    predicted = constant_sigma(constant, 6, sigma)
    scatter = float(np.std(found))
    return Claim(
        "7.8",
        "recognised if the difference of K is within some bound",
        f"sigma of K is 2 sigma √(N K): {scatter:.5f} measured, {predicted:.5f}; so √(K/N) has the "
        "noise of a coordinate, and is what is stored",
        "added",
        abs(scatter / predicted - 1.0) < max(0.03, 4.0 / math.sqrt(2.0 * trials)),
        {"measured": scatter, "law": predicted},
    )


def _rasters(rng: np.random.Generator, fields: int) -> tuple[Claim, ...]:
    psf, grid = GaussianPsf(1.2), np.arange(128.0)
    right = refused = wrong = 0
    worst = 0.0
    for _ in range(fields):
        places = rng.uniform(8, 120, (4, 2))
        image = rng.normal(0, 0.5, (128, 128))
        for u, v in places:
            image += 2000.0 * psf.pixel(grid[None, :] - u, grid[:, None] - v)
        found = find_by_rasters(image, 0.5)
        if found.refused is not None:
            refused += 1
        elif len(found.u_px) != 4:
            wrong += 1
        else:
            right += 1
            both = (found.u_px, np.sort(places[:, 0])), (found.v_px, np.sort(places[:, 1]))
            worst = max(worst, *(float(np.abs(a - b).max()) for a, b in both))
    return (
        Claim(
            "7.8",
            "sums of rows and columns locate every star",
            f"of {fields} fields of four stars {right / fields:.0%} are right, each star to "
            f"{worst:.1f} px; {refused / fields:.0%} are refused, stars standing in one line; "
            f"{wrong / fields:.0%} lose a star on both axes unseen",
            "qualified",
            right / fields > 0.4 and worst < 1.5,
            {"right": right, "refused": refused, "unseen": wrong, "worst (px)": worst},
        ),
    )


def _fields(rng: np.random.Generator, number: int, stars: int) -> list[Array]:
    """Unit vectors of the brightest stars within 5° of random directions with enough stars."""
    catalog = load_embedded()
    bright = catalog.direction[: int(np.searchsorted(catalog.magnitude_v_mag, FAINTEST_MAG))]
    fields: list[Array] = []
    while len(fields) < number:
        centre = unit(rng.normal(size=3))
        near = np.flatnonzero(bright @ centre > math.cos(math.radians(RADIUS_DEG)))
        if len(near) >= stars:
            fields.append(bright[near[:stars]])
    return fields


def _discrimination(study: Study) -> dict[int, list[tuple[int, float, float]]]:
    """By number of stars: rows of store size, share unique within 3 sigma, share nearest right."""
    rng = study.rng(111)
    sigma = SIGMA_ARCSEC / ARCSEC_PER_RADIAN
    sizes = STORES[:4] if study.quick else STORES
    shares: dict[int, list[tuple[int, float, float]]] = {}
    for stars in STARS:
        fields = _fields(rng, max(LEAST_FIELDS, *sizes), stars)
        keys = [chord_constant(field) for field in fields]
        shares[stars] = []
        for size in sizes:
            # Average over several small stores, so that one unusual field does not decide.
            unique = nearest = draws = 0
            for first in range(0, max(size, LEAST_FIELDS // size * size), size):
                store = store_of({str(k): (stars, keys[k]) for k in range(first, first + size)})
                for k in rng.integers(first, first + size, min(size, 1000)).tolist():
                    seen = unit(fields[k] + rng.normal(0, sigma, fields[k].shape))
                    constant = chord_constant(seen)
                    unique += store.within(stars, constant, sigma) == [str(k)]
                    nearest += store.nearest(stars, constant) == str(k)
                    draws += 1
            shares[stars].append((size, unique / draws, nearest / draws))
    return shares


def _recogniser(shares: dict[int, list[tuple[int, float, float]]]) -> Claim:
    def percent(size: int, which: int) -> str:
        rows = [next(row for row in rows if row[0] == size) for rows in shares.values()]
        return " / ".join(f"{row[which]:.0%}" for row in rows)

    small = min(row[2] for rows in shares.values() for row in rows if row[0] == 10)
    large = max(row[1] for rows in shares.values() for row in rows if row[0] == 300)
    return Claim(
        "7.8",
        "K, compared with a stored set, recognises the pattern",
        "for 3 / 5 / 8 stars, nearest K right among 10 stored fields: "
        f"{percent(10, 2)}, 30: {percent(30, 2)}, 100: {percent(100, 2)}, "
        f"300: {percent(300, 2)}; the only one within 3 sigma among 300: {percent(300, 1)}",
        "qualified",
        small > 0.85 and large < 0.25,
        {f"{stars} stars": rows for stars, rows in shares.items()},
    )


def _pointing(rng: np.random.Generator) -> Claim:
    """Check how much K of flat coordinates changes when the telescope points elsewhere."""
    sigma = SIGMA_ARCSEC / ARCSEC_PER_RADIAN
    moved, chords = [], []
    for field in _fields(rng, 300, 5):
        aim = unit(field.mean(axis=0))
        aside = unit(np.cross(aim, rng.normal(size=3)))
        off = math.radians(float(rng.uniform(2, 3)))
        other = unit(math.cos(off) * aim + math.sin(off) * aside)
        one, two = (pattern_constant(*_flat(field, at)) for at in (aim, other))
        moved.append(abs(key_of(5, two) - key_of(5, one)) / sigma)
        chords.append(chord_constant(field))
    middle, far = np.percentile(moved, [50, 90])
    return Claim(
        "7.8",
        "K does not change when the field moves or turns",
        f"flat coordinates: by {middle:.1f} sigma (a tenth by more than {far:.1f}) when pointed "
        "2 to 3° aside; of unit vectors not at all, which is what a wide field should use",
        "qualified",
        bool(0.3 < middle < 3.0),
        {"median (sigma)": float(middle), "90 % (sigma)": float(far)},
    )


def _flat(field: Array, aim: Array) -> tuple[Array, Array]:
    across = unit(np.cross(aim, [0.3, 0.5, 0.8]))
    along = np.cross(aim, across)
    depth = field @ aim
    return np.asarray(field @ across / depth), np.asarray(field @ along / depth)


def _draw(figure: Any, shares: dict[int, list[tuple[int, float, float]]]) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    for stars, rows in shares.items():
        sizes, unique, nearest = np.array(rows).T
        axes[0].semilogx(sizes, 100 * unique, "o-", label=f"{stars} stars")
        axes[1].semilogx(sizes, 100 * nearest, "o-", label=f"{stars} stars")
    axes[0].set(xlabel="stored fields", ylabel="%", title="alone within 3 sigma")
    axes[1].set(xlabel="stored fields", title="nearest is right")
    axes[0].legend(fontsize=7)


def pattern_constant(u: npt.ArrayLike, v: npt.ArrayLike) -> float:
    """Pattern constant K = (N - 1)(sum u² + sum v²) - sum over i, j of (u_i u_j + v_i v_j) (7.43).

    Points need no order.  Computed as N sum |r - mean|², which is equal and free of cancellation.
    (In the report 7.42 has "a" for its second 2, and 7.46 pairs x with y where both are equal.)
    """
    x, y = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 1:
        raise BadInput(Fault("v", "must be as many as u", f"{x.shape}, {y.shape}"))
    spread = float(np.sum((x - x.mean()) ** 2) + np.sum((y - y.mean()) ** 2))
    return len(x) * spread


def chord_constant(vectors: npt.ArrayLike) -> float:
    """Pattern constant of unit vectors (n, 3) by their chords, exact for any pointing."""
    v = np.asarray(vectors, dtype=np.float64)
    return len(v) * float(np.sum((v - v.mean(axis=0)) ** 2))


def constant_sigma(constant: float, stars: int, position_sigma: float) -> float:
    """Standard deviation of the pattern constant, sigma_K = 2 sigma sqrt(N K)."""
    return 2.0 * position_sigma * math.sqrt(stars * constant)


@dataclass(frozen=True)
class PatternStore:
    """Known star fields by (number of stars, sqrt(K / N)), the latter with equal noise sigma.

    A missing or false star changes a field's pattern; the key alone distinguishes about thirty
    fields, and narrows the search among more.
    """

    names: tuple[str, ...]
    stars: npt.NDArray[np.intp]
    keys: Array

    def within(
        self, stars: int, constant: float, position_sigma: float, sigmas: float = 3.0
    ) -> list[str]:
        """Stored fields with the same number of stars within the tolerance, nearest first."""
        order, distance = self._ranked(stars, constant)
        return [self.names[i] for i in order if distance[i] <= sigmas * position_sigma]

    def nearest(self, stars: int, constant: float) -> str | None:
        """Nearest stored field with the same number of stars; None without any."""
        order, _ = self._ranked(stars, constant)
        return self.names[order[0]] if len(order) else None

    def _ranked(self, stars: int, constant: float) -> tuple[npt.NDArray[np.intp], Array]:
        distance = np.abs(self.keys - key_of(stars, constant))
        same = np.flatnonzero(self.stars == stars)
        return same[np.argsort(distance[same], kind="stable")], distance


def key_of(stars: int, constant: float) -> float:
    """Key of a star pattern with equal noise for all fields, sqrt(K / N)."""
    return math.sqrt(constant / stars)


def store_of(patterns: dict[str, tuple[int, float]]) -> PatternStore:
    """Build a store from fields by name, each with number of stars and K."""
    counts = np.array([stars for stars, _ in patterns.values()], dtype=np.intp)
    keys = np.array([key_of(stars, constant) for stars, constant in patterns.values()])
    return PatternStore(tuple(patterns), counts, keys)


@dataclass(frozen=True)
class RasterStars:
    """Star positions along each axis in pixels, ascending, not paired, or reason for refusal."""

    u_px: Array
    v_px: Array
    refused: str | None = None


def find_by_rasters(
    image: Array, noise_sigma: float, threshold_sigmas: float = 6.0, background: float = 0.0
) -> RasterStars:
    """Find the stars of a field by row and column sums, to about a pixel.

    A line holds a star if its sum is a maximum `threshold_sigmas` above the noise of such a sum.
    Two stars in one band of rows or columns look like one: the counts then differ and the field is
    refused; if both axes have such a pair, it goes unnoticed.
    """
    light = image - background
    u = line_peaks(light.sum(axis=0), noise_sigma * np.sqrt(image.shape[0]) * threshold_sigmas)
    v = line_peaks(light.sum(axis=1), noise_sigma * np.sqrt(image.shape[1]) * threshold_sigmas)
    if len(u) != len(v):
        why = f"{len(u)} stars by columns, {len(v)} by rows: some stand in one line"
        return RasterStars(u, v, why)
    return RasterStars(u, v, None if len(u) else "no line stands out of the noise")

"""The run catalog: the stars that a mission's identifier uses, at the epoch of one year.

It is made from the star catalog in five steps: proper motion to the epoch, instrument magnitude,
merging of stars that the tracker cannot separate, the magnitude limit, and rejection. Index order,
brightest first, is the brightness rank that the pair index uses.

The catalog's own directions are those seen from the solar system's barycentre at its epoch, and are
used for zones. `direction_at` gives the directions seen from the Earth on the day of a batch, used
for attitudes and residuals.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.csv_cells import neutralised, quoted
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.star_catalog import Catalog, motion_in, moved
from service.sky.files import Content
from service.sky.geometry.pairs import build_pairs
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Vector, from_ra_dec, read_only, to_ra_dec, unit

UNKNOWN_COLOR_BV_MAG = 0.6
"""Colour index B-V assumed for a star of unknown colour: Sun-like, near the catalog's median."""

J2000_YEAR, J2000_JD, DAYS_PER_YEAR = 2000.0, 2451545.0, 365.25
_ARRAYS = ("ra_deg", "dec_deg", "motion", "parallax_rad", "magnitude_mag", "catalog_row")
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Rejection:
    """A star that is bright enough for the run catalog but left out, with the reason."""

    star_id: str
    reason: str


@dataclass(frozen=True, eq=False)
class RunCatalog:
    """The stars of a run catalog by instrument magnitude, brightest first, ties by catalog row.

    Arrays have one entry per star and are read-only.
    """

    epoch_year: float
    ra_deg: Vector
    dec_deg: Vector
    """Right ascension and declination of the stars, ICRS at the epoch, as exported."""
    motion: Vector
    """Change of unit vectors per Julian year (N, 3), radians; flux-weighted for merged stars."""
    parallax_rad: Vector
    """Parallaxes in radians; zero if unknown or negative."""
    magnitude_mag: Vector
    """Instrument magnitudes; of the combined light for merged stars."""
    catalog_row: Rows
    star_id: tuple[str, ...]
    rejected: tuple[Rejection, ...]
    digest: str
    """Digest of the exported numbers and the epoch, "sha256:…"."""

    def __len__(self) -> int:
        return len(self.star_id)

    @property
    def nbytes(self) -> int:
        """The size of the run catalog in memory in bytes, with identifiers estimated."""
        arrays = [self.ra_deg, self.dec_deg, self.magnitude_mag, self.direction, self.motion]
        floats = sum(array.nbytes for array in (*arrays, self.parallax_rad))
        return floats + self.catalog_row.nbytes + 64 * len(self.star_id)

    @property
    def content(self) -> Content:
        """The run catalog as the content of a sky file."""
        facts = {
            "epoch_year": self.epoch_year,
            "digest": self.digest,
            "rejected": [(each.star_id, each.reason) for each in self.rejected],
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        return Content(facts, arrays | {"star_id": np.array(self.star_id, np.str_)})

    @classmethod
    def of_content(cls, content: Content) -> "RunCatalog":
        """A run catalog from the content of a sky file."""
        facts, arrays = content
        return cls(
            epoch_year=facts["epoch_year"],
            star_id=tuple(arrays["star_id"].tolist()),
            rejected=tuple(Rejection(*each) for each in facts["rejected"]),
            digest=facts["digest"],
            **{name: read_only(arrays[name]) for name in _ARRAYS},
        )

    @cached_property
    def direction(self) -> Vector:
        """Unit vectors (N, 3) computed exactly from `ra_deg` and `dec_deg`."""
        return read_only(from_ra_dec(self.ra_deg, self.dec_deg))

    def direction_at(self, time: Utc) -> Vector:
        """Unit vectors (N, 3) seen from the Earth on the day of a time, without aberration.

        Motion and parallax within the day are ignored: below 0.02 arcsec for every star.
        """
        return _on_day(self, round(time.julian_year * DAYS_PER_YEAR))


@lru_cache(maxsize=32)
def _on_day(run_catalog: RunCatalog, day: int) -> Vector:
    """The directions (N, 3) of a run catalog's stars on a day, counted from Julian year 0."""
    year = day / DAYS_PER_YEAR
    _, of_earth, _ = ufunc.epv00(J2000_JD, DAYS_PER_YEAR * (year - J2000_YEAR))
    seen = run_catalog.direction + (year - run_catalog.epoch_year) * run_catalog.motion
    seen -= run_catalog.parallax_rad[:, None] * of_earth["p"]
    return read_only(unit(seen))


def build_run_catalog(
    catalog: Catalog, settings: RunCatalogSettings, epoch_year: float
) -> RunCatalog:
    """The run catalog for a mission's settings at an epoch in Julian years, such as 1996.0.

    `rejected` lists, in catalog order, every star that is bright enough but has no entry: merged
    into a brighter one, or rejected.
    """
    alone = instrument_magnitude(catalog, settings.color_polynomial_mag)
    known = (
        *(catalog.ra_deg, catalog.dec_deg),
        *(catalog.pm_ra_mas_per_year, catalog.pm_dec_mas_per_year),
    )
    start, motion = moved(*known, epoch_year - J2000_YEAR), motion_in(*known, 1.0)
    leader = merged_into(start, alone, catalog.light_elsewhere, settings.merge_within_arcsec)
    if settings.merge_limit_mag is not None:
        apart = alone > settings.merge_limit_mag
        leader[apart] = np.flatnonzero(apart)
    both, magnitude = combined(np.hstack([start, motion]), alone, catalog.light_elsewhere, leader)
    direction, motion = both[:, :3], both[:, 3:]
    bright = magnitude <= settings.magnitude_limit_mag
    leads = leader == np.arange(len(catalog))
    reasons = {
        int(star): f"merged into {catalog.star_id(leader[star])}"
        for star in np.flatnonzero(~leads & bright)
    }
    reasons |= rejections(catalog, settings, direction, magnitude, leads, leads & bright)
    kept = leads & bright
    kept[list(reasons)] = False
    row = np.flatnonzero(kept)
    row = row[np.argsort(magnitude[row], kind="stable")]
    ra, dec = to_ra_dec(direction[row])
    star_id = tuple(catalog.star_ids(row))
    content = hashlib.sha256(np.float64(epoch_year).tobytes())
    for array in (ra, dec, magnitude[row]):
        content.update(array.tobytes())
    content.update("\n".join(star_id).encode())
    return RunCatalog(
        epoch_year=epoch_year,
        ra_deg=read_only(ra),
        dec_deg=read_only(dec),
        magnitude_mag=read_only(magnitude[row]),
        catalog_row=read_only(row),
        motion=read_only(motion[row]),
        parallax_rad=read_only(
            np.fmax(catalog.parallax_mas[row], 0.0) / (1000.0 * ARCSEC_PER_RADIAN)
        ),
        star_id=star_id,
        rejected=tuple(Rejection(catalog.star_id(star), reasons[star]) for star in sorted(reasons)),
        digest=f"sha256:{content.hexdigest()}",
    )


def instrument_magnitude(catalog: Catalog, color_polynomial_mag: Sequence[float]) -> Vector:
    """Instrument magnitudes V + c0 + c1 (B-V) + c2 (B-V)^2 + … of stars; V without coefficients.

    A star of unknown colour gets UNKNOWN_COLOR_BV_MAG.
    """
    if not color_polynomial_mag:
        return catalog.magnitude_v_mag
    color = np.where(np.isnan(catalog.color_bv_mag), UNKNOWN_COLOR_BV_MAG, catalog.color_bv_mag)
    correction = np.polynomial.polynomial.polyval(color, np.asarray(color_polynomial_mag))
    return np.asarray(catalog.magnitude_v_mag + correction)


def export_csv(run_catalog: RunCatalog, path: Path) -> None:
    """Write a run catalog to CSV, `id,ra_deg,dec_deg,magnitude` in index order, exactly."""
    rows = zip(
        map(neutralised, run_catalog.star_id),
        run_catalog.ra_deg.tolist(),
        run_catalog.dec_deg.tolist(),
        run_catalog.magnitude_mag.tolist(),
        strict=True,
    )
    _write_csv(path, chain([("id", "ra_deg", "dec_deg", "magnitude")], rows))


def export_rejected_csv(run_catalog: RunCatalog, path: Path) -> None:
    """Write `id,reason` of every rejected star to CSV, in catalog order."""
    rows = [(neutralised(one.star_id), one.reason) for one in run_catalog.rejected]
    _write_csv(path, [("id", "reason"), *rows])


def _write_csv(path: Path, rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(",".join(quoted(str(cell)) for cell in row) + "\n" for row in rows)


def rejections(
    catalog: Catalog,
    settings: RunCatalogSettings,
    direction: Vector,
    magnitude: Vector,
    leads: npt.NDArray[np.bool_],
    judged: npt.NDArray[np.bool_],
) -> dict[int, str]:
    """The reasons for rejecting stars, by the catalog rows of those `judged` that are rejected.

    A merged star is rejected with its leader. An unknown property rejects no star. Of several
    reasons the first is given.
    """
    reasons: dict[int, str] = {}
    amplitude, sigma = settings.reject_variable_amplitude_mag, settings.reject_position_sigma_arcsec
    if amplitude is not None:
        for star in np.flatnonzero(judged & (catalog.variability_mag > amplitude)):
            reasons[int(star)] = f"variable by {catalog.variability_mag[star]:.2f} mag"
    if sigma is not None:
        for star in np.flatnonzero(judged & (catalog.position_sigma_arcsec > sigma)):
            shown = f"uncertain position: {catalog.position_sigma_arcsec[star]:.2f} arcsec"
            reasons.setdefault(int(star), shown)
    distance = _nearest_disturbing(catalog, settings, direction, magnitude, leads)
    for star in np.flatnonzero(judged & np.isfinite(distance)):
        reasons.setdefault(int(star), f"neighbour at {distance[star]:.1f} arcsec")
    return reasons


def _nearest_disturbing(
    catalog: Catalog,
    settings: RunCatalogSettings,
    direction: Vector,
    magnitude: Vector,
    leads: npt.NDArray[np.bool_],
) -> Vector:
    """Distance in arcsec of each star's nearest disturbing neighbour; infinite without one.

    Neighbours are the other catalog stars after merging and, for fainter stars, the two neighbours
    whose distance the catalog records; a neighbour within the merging distance is part of the star.
    """
    within = settings.reject_neighbour_within_arcsec
    fainter = settings.reject_neighbour_fainter_by_mag
    distance = np.full(len(catalog), np.inf)
    if within == 0.0:
        return distance
    rows = np.flatnonzero(leads)
    for one, other in rows[pairs_within(direction[rows], within)]:
        apart = float(np.linalg.norm(direction[one] - direction[other])) * ARCSEC_PER_RADIAN
        for star, neighbour in ((one, other), (other, one)):
            if magnitude[neighbour] - magnitude[star] <= fainter:
                distance[star] = min(distance[star], apart)
    for apart_of_all, difference in (
        (catalog.neighbour_arcsec, catalog.neighbour_fainter_by_mag),
        (catalog.rival_arcsec, catalog.rival_fainter_by_mag),
    ):
        counts = (apart_of_all > settings.merge_within_arcsec) & (apart_of_all <= within)
        counts &= difference <= fainter
        distance[counts] = np.minimum(distance[counts], apart_of_all[counts])
    return distance


def merged_into(
    direction: Vector,
    magnitude: Vector,
    light_elsewhere: npt.NDArray[np.bool_],
    within_arcsec: float,
) -> Rows:
    """For every star (N,) the row of the star into which it is merged: its own row if it is single.

    From the brightest down, a star that is not merged yet absorbs every fainter one that is not
    merged yet and within `within_arcsec`; chains end there. Components whose light is part of
    another entry come last, so that they absorb no real star.
    """
    leader = np.arange(len(magnitude))
    if within_arcsec > 0.0:
        rank = np.empty_like(leader)
        rank[np.lexsort((leader, magnitude, light_elsewhere))] = leader
        pairs = pairs_within(direction, within_arcsec)
        swap = rank[pairs[:, 0]] > rank[pairs[:, 1]]
        pairs[swap] = pairs[swap, ::-1]
        for first, second in pairs[np.lexsort(rank[pairs].T[::-1])]:
            if leader[first] == first and leader[second] == second:
                leader[second] = first
    return leader


def pairs_within(direction: Vector, within_arcsec: float) -> Rows:
    """The pairs (P, 2) of rows of stars within a number of arcsec from each other."""
    pairs = build_pairs(direction, within_arcsec / 3600.0)
    return np.stack([pairs.brighter, pairs.dimmer], axis=1).astype(np.intp)


def combined(
    direction: Vector, magnitude: Vector, light_elsewhere: npt.NDArray[np.bool_], leader: Rows
) -> tuple[Vector, Vector]:
    """Directions (N, 3), not normalised, and magnitudes of stars after merging.

    Further columns of `direction`, such as motions, are combined alike. A leader gets the light of
    its group and the group's centre of light; other stars are unchanged.
    """
    direction, magnitude = direction.copy(), magnitude.copy()
    lost = np.flatnonzero((leader != np.arange(len(leader))) & ~light_elsewhere)
    group, place = np.unique(leader[lost], return_inverse=True)
    light = 10.0 ** (-0.4 * magnitude)
    total = light[group] + np.bincount(place, light[lost], len(group))
    for axis in range(direction.shape[1]):
        moment = np.bincount(place, light[lost] * direction[lost, axis], len(group))
        direction[group, axis] = (light[group] * direction[group, axis] + moment) / total
    magnitude[group] = -2.5 * np.log10(total)
    return direction, magnitude

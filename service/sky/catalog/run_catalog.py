"""The run catalog: the stars that a mission's identifier uses, as they stand in one year.

It is made from the star catalog in five steps: proper motion to the epoch,
instrument magnitude, merging of what the tracker cannot separate, the
magnitude limit, and rejection.  Index order, brightest first, is the
brightness rank that the pair index uses.

Directions are those seen from the solar system's barycentre: a catalog that
serves a year cannot carry the annual parallax, which is 0.75 arcsec for alpha
Centauri and below 0.4 arcsec for every other star to V 8.
"""

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from service.csv_cells import neutralised
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.blending import Rows, combined, merged_into
from service.sky.catalog.proper_motion import moved
from service.sky.catalog.rejection import rejections
from service.sky.catalog.star_catalog import Catalog
from service.vectors import Vector, from_ra_dec, read_only, to_ra_dec

UNKNOWN_COLOR_BV_MAG = 0.6
"""The B-V of a star whose colour is not known: a Sun-like one, near the catalog's median."""

J2000_YEAR = 2000.0


@dataclass(frozen=True)
class Rejection:
    """A star that is left out though it is bright enough, and why."""

    star_id: str
    reason: str


@dataclass(frozen=True, eq=False)
class RunCatalog:
    """The stars of a run in index order: by instrument magnitude, ties by catalog row.

    Arrays have one entry per star and are locked against writing.
    """

    epoch_year: float
    ra_deg: Vector
    dec_deg: Vector
    """ICRS at the epoch.  These numbers are exported, and `direction` is computed from them."""
    magnitude_mag: Vector
    """Instrument magnitude, of the combined light where stars were merged."""
    catalog_row: Rows
    star_id: tuple[str, ...]
    rejected: tuple[Rejection, ...]
    digest: str
    """Of the exported numbers and the epoch, "sha256:…"."""

    def __len__(self) -> int:
        return len(self.star_id)

    @property
    def nbytes(self) -> int:
        """Bytes held, the identifiers estimated."""
        arrays = (self.ra_deg, self.dec_deg, self.magnitude_mag, self.catalog_row, self.direction)
        return sum(array.nbytes for array in arrays) + 64 * len(self.star_id)

    @cached_property
    def direction(self) -> Vector:
        """Unit vectors (N, 3) of exactly `ra_deg` and `dec_deg`."""
        return read_only(from_ra_dec(self.ra_deg, self.dec_deg))


def build_run_catalog(
    catalog: Catalog, settings: RunCatalogSettings, epoch_year: float
) -> RunCatalog:
    """The run catalog of a mission's settings and of an epoch in Julian years, e.g. 1996.0.

    `rejected` lists, in catalog order, every star that is bright enough and
    yet no entry: merged into a brighter one, or rejected.
    """
    alone = instrument_magnitude(catalog, settings.color_polynomial_mag)
    start = moved(
        catalog.ra_deg,
        catalog.dec_deg,
        catalog.pm_ra_mas_per_year,
        catalog.pm_dec_mas_per_year,
        epoch_year - J2000_YEAR,
    )
    leader = merged_into(start, alone, catalog.light_elsewhere, settings.merge_within_arcsec)
    if settings.merge_limit_mag is not None:
        apart = alone > settings.merge_limit_mag
        leader[apart] = np.flatnonzero(apart)
    direction, magnitude = combined(start, alone, catalog.light_elsewhere, leader)
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
        star_id=star_id,
        rejected=tuple(Rejection(catalog.star_id(star), reasons[star]) for star in sorted(reasons)),
        digest=f"sha256:{content.hexdigest()}",
    )


def instrument_magnitude(catalog: Catalog, color_polynomial_mag: Sequence[float]) -> Vector:
    """V + c0 + c1 (B-V) + c2 (B-V)^2 + … for every star; without coefficients V itself.

    A star of unknown colour is given UNKNOWN_COLOR_BV_MAG.
    """
    if not color_polynomial_mag:
        return catalog.magnitude_v_mag
    color = np.where(np.isnan(catalog.color_bv_mag), UNKNOWN_COLOR_BV_MAG, catalog.color_bv_mag)
    correction = np.polynomial.polynomial.polyval(color, np.asarray(color_polynomial_mag))
    return np.asarray(catalog.magnitude_v_mag + correction)


def export_csv(run_catalog: RunCatalog, path: Path) -> None:
    """Writes `id,ra_deg,dec_deg,magnitude` in index order, numbers that read back exactly."""
    rows = zip(
        map(neutralised, run_catalog.star_id),
        run_catalog.ra_deg.tolist(),
        run_catalog.dec_deg.tolist(),
        run_catalog.magnitude_mag.tolist(),
        strict=True,
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["id", "ra_deg", "dec_deg", "magnitude"])
        writer.writerows(rows)


def export_rejected_csv(run_catalog: RunCatalog, path: Path) -> None:
    """Writes `id,reason` of every rejected star, in catalog order."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["id", "reason"])
        writer.writerows((neutralised(one.star_id), one.reason) for one in run_catalog.rejected)

"""The star catalog: positions and motions at J2000.0, magnitudes, neighbours, identifiers.

The embedded catalog is complete to V 9.0 and travels with the service (see `catalogs/README.md`); a
site may bring its own. A mission's identifier uses a run catalog made from it, see
`service.sky.catalog.run_catalog`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from service.errors import BadConfiguration, BadFile, Fault, NotFound
from service.resources import shipped
from service.sky.catalog import csv_file as catalog_csv
from service.sky.catalog import sky2000
from service.sky.catalog.coding import COLUMNS, LABEL, file_digest, pack, unpack
from service.sky.catalog.neighbours import nearest_neighbours
from service.sky.files import Content, kept
from service.times import J2000_YEAR
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Vector,
    from_ra_dec,
    read_only,
    to_ra_dec,
    unit,
)

CatalogFormat = Literal["csv", "sky2000"]
POSITION_AND_MOTION = ("ra_deg", "dec_deg", "pm_ra_mas_per_year", "pm_dec_mas_per_year")


@dataclass(frozen=True, eq=False)
class Catalog:
    """A star catalog as read-only arrays with one entry per star.

    Rows are sorted by V, brightest first, ties in a fixed order. Positions are ICRS at J2000.0
    (epoch and, within 0.02 arcsec, equinox). Unknown magnitudes, colours, neighbours and sigmas are
    NaN; missing numbers of other catalogs are 0.
    """

    name: str
    digest: str
    """Digest of the file from which the catalog was read, "sha256:…"."""
    ra_deg: Vector
    dec_deg: Vector
    pm_ra_mas_per_year: Vector
    """Proper motion in right ascension times cos(declination), as an arc, mas per year."""
    pm_dec_mas_per_year: Vector
    parallax_mas: Vector
    magnitude_v_mag: Vector
    color_bv_mag: Vector
    neighbour_arcsec: Vector
    """Distance of the nearest neighbour of any known magnitude; NaN for none within a degree."""
    neighbour_fainter_by_mag: Vector
    """V of the nearest neighbour minus the star's: negative for a brighter neighbour."""
    rival_arcsec: Vector
    """Distance of the nearest neighbour at most 2 mag fainter; NaN for none within a degree."""
    rival_fainter_by_mag: Vector
    variability_mag: Vector
    """Amplitude of variability in magnitudes, brightest to faintest; NaN if not known to vary."""
    position_sigma_arcsec: Vector
    components: npt.NDArray[np.uint8]
    light_elsewhere: npt.NDArray[np.bool_]
    """True for stars whose light is in a neighbour's magnitude, so that merging must not add it."""
    hip: npt.NDArray[np.int32]
    tyc: npt.NDArray[np.uint16]
    hd: npt.NDArray[np.int32]
    sao: npt.NDArray[np.int32]
    label: npt.NDArray[np.str_] | None = None
    """Identifiers of a site's own catalog, such as "SKYMAP 1234"; None with HIP or TYC numbers."""

    def __len__(self) -> int:
        return len(self.ra_deg)

    @cached_property
    def direction(self) -> Vector:
        """Unit vectors (N, 3) of the catalog's stars, ICRS at J2000.0."""
        return read_only(from_ra_dec(self.ra_deg, self.dec_deg))

    def star_id(self, row: int) -> str:
        """The identifier of one star: "HIP 26311", "TYC 1234-567-1" or the site's own text."""
        return self.star_ids([row])[0]

    def star_ids(self, rows: Sequence[int] | npt.NDArray[np.intp] | slice) -> list[str]:
        """The identifiers of many stars, in the order of the rows."""
        if self.label is not None:
            return [str(text) for text in self.label[rows]]
        numbers = zip(self.hip[rows].tolist(), self.tyc[rows].tolist(), strict=True)
        return [f"HIP {hip}" if hip else _tycho_id(tyc) for hip, tyc in numbers]

    @cached_property
    def _row_of(self) -> dict[str, int]:
        return {star_id: row for row, star_id in enumerate(self.star_ids(slice(None)))}

    def row_of(self, star_id: str) -> int:
        """The catalog row of a star's identifier; raises NotFound for an unknown one."""
        row = self._row_of.get(star_id)
        if row is None:
            raise NotFound(f"star {star_id!r} is not in catalog {self.name}")
        return row


def _tycho_id(numbers: Sequence[int]) -> str:
    return "TYC {}-{}-{}".format(*numbers)


def _catalog(name: str, digest: str, columns: Mapping[str, npt.NDArray[Any]]) -> Catalog:
    return Catalog(
        name=name, digest=digest, **{key: read_only(array) for key, array in columns.items()}
    )


def load(path: Path) -> Catalog:
    """The catalog in a file written by `save` or the build; its name is the file's stem.

    Raises BadFile if the file is missing or damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadFile(Fault(str(path), f"cannot be read: {error.strerror}")) from error
    digest = file_digest(data)
    content = kept("catalog", digest, lambda: Content({}, unpack(data, path)))
    return _catalog(path.stem, digest, content.arrays)


@cache
def load_embedded() -> Catalog:
    """The catalog that comes with the service, read once."""
    return load(shipped("catalogs", "stars.npz"))


def open_catalog(file: Path | None) -> Catalog:
    """The site's catalog, or the embedded one without a file; raises `BadConfiguration` if bad."""
    if file is None:
        return load_embedded()
    try:
        return import_csv(file) if file.suffix.lower() == ".csv" else load(file)
    except BadFile as error:
        raise BadConfiguration(f"ACQUIRE_CATALOG: {error}") from None


def import_csv(path: Path, epoch_year: float = J2000_YEAR) -> Catalog:
    """A site's own catalog from a CSV file with a header.

    Columns `id`, `ra_deg`, `dec_deg` and `magnitude` are required; those of
    `service.sky.catalog.csv_file.OPTIONAL` are optional. Positions are ICRS at the Julian year in
    the column `epoch`, or else at `epoch_year`; proper motion moves them to J2000.0. Proper motion
    in right ascension is times cos(declination), as in Hipparcos and Gaia. Stars of equal magnitude
    keep the order of the file. Neighbours are searched within the catalog itself. Raises BadFile
    naming line, column and value of up to twenty faults.
    """
    columns = catalog_csv.read_csv_catalog(path)
    epoch = columns.pop("epoch_year")
    epoch = np.where(np.isnan(epoch), epoch_year, epoch)
    # Positions at J2000.0 are unchanged to the last bit.
    for year in np.unique(epoch[epoch != J2000_YEAR]).tolist():
        rows = np.flatnonzero(epoch == year)
        ra, dec, pm_ra, pm_dec = (columns[name][rows] for name in POSITION_AND_MOTION)
        ra_deg, dec_deg = to_ra_dec(moved(ra, dec, pm_ra, pm_dec, J2000_YEAR - year))
        columns["ra_deg"][rows], columns["dec_deg"][rows] = ra_deg, dec_deg
    return _of_a_site(path, columns)


def import_sky2000(
    path: Path, step: Callable[[], object] = lambda: None
) -> tuple[Catalog, tuple[str, ...]]:
    """SKYMAP's SKY2000 catalog from its fixed-width records, and the stars without a magnitude.

    Every star is known by its Skymap number, "SKYMAP 1234".  `step` is called
    after each record.  Raises BadFile naming line, bytes and value of up to
    twenty faults.
    """
    found = sky2000.read_sky2000(path, step)
    return _of_a_site(path, found.columns), found.without_magnitude


def import_catalog(path: Path, form: CatalogFormat | None = None) -> Catalog:
    """A site's own catalog in CSV or SKY2000 format; by default told by the first bytes."""
    if (form or catalog_format(path)) == "sky2000":
        return import_sky2000(path)[0]
    return import_csv(path)


def catalog_format(path: Path) -> CatalogFormat:
    """The format of a site's catalog file: SKY2000 if it begins like its records, else CSV."""
    return "sky2000" if sky2000.is_sky2000(path) else "csv"


def _of_a_site(path: Path, columns: Mapping[str, npt.NDArray[Any]]) -> Catalog:
    """The catalog made of a site's columns: sorted by magnitude, with neighbours within itself."""
    order = np.argsort(columns["magnitude_v_mag"], kind="stable")
    columns = {key: column[order] for key, column in columns.items()}
    direction = from_ra_dec(columns["ra_deg"], columns["dec_deg"])
    magnitude = columns["magnitude_v_mag"]
    columns |= nearest_neighbours(direction, magnitude, direction, magnitude)
    return _catalog(path.stem, file_digest(_packed(columns)), columns)


def save(catalog: Catalog, path: Path) -> None:
    """Write a catalog to a file for `load`, with unchanged numbers."""
    columns = {name: getattr(catalog, name) for name in COLUMNS}
    if catalog.label is not None:
        columns[LABEL] = catalog.label
    path.write_bytes(_packed(columns))


def _packed(columns: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """The bytes of a site's catalog file, with its columns in a fixed order."""
    return pack({name: columns[name] for name in (*COLUMNS, LABEL) if name in columns})


def moved(
    ra_deg: npt.ArrayLike,
    dec_deg: npt.ArrayLike,
    pm_ra_mas_per_year: npt.ArrayLike,
    pm_dec_mas_per_year: npt.ArrayLike,
    years: float,
) -> Vector:
    """Unit vectors (N, 3) of stars moved by some Julian years, seen from the barycentre.

    A star moves in space along a straight line in the direction of its proper motion, which is
    valid near the pole too; radial velocities are assumed zero.
    """
    shift = motion_in(ra_deg, dec_deg, pm_ra_mas_per_year, pm_dec_mas_per_year, years)
    return unit(from_ra_dec(ra_deg, dec_deg) + shift)


def motion_in(
    ra_deg: npt.ArrayLike,
    dec_deg: npt.ArrayLike,
    pm_ra_mas_per_year: npt.ArrayLike,
    pm_dec_mas_per_year: npt.ArrayLike,
    years: float,
) -> Vector:
    """The change (N, 3) of stars' unit vectors in some Julian years by proper motion, in radians.

    Motion in right ascension is times cos(declination).
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    east = years / (1000.0 * ARCSEC_PER_RADIAN) * np.asarray(pm_ra_mas_per_year)
    north = years / (1000.0 * ARCSEC_PER_RADIAN) * np.asarray(pm_dec_mas_per_year)
    return np.stack(
        [
            -sin_ra * east - sin_dec * cos_ra * north,
            cos_ra * east - sin_dec * sin_ra * north,
            cos_dec * north,
        ],
        axis=-1,
    )

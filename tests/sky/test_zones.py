"""Zones hold exactly the stars within their bounds; the shelf's are wide enough for every aim."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.sky.cache import LruCache
from service.sky.zones import SearchRegion, build_zone, count_within, snapped, zone_for
from service.vectors import angle_between_deg, from_ra_dec, unit
from tests.reference.small_sky import run_catalog

directions = st.tuples(st.floats(0, 360, exclude_max=True), st.floats(-90, 90)).map(
    lambda place: from_ra_dec(*place)
)
grids = st.sampled_from([0.05, 0.25, 1.0, 3.0, 7.0, 10.0])


def sky(seed, count=400):
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(count, 3))
    return run_catalog(v, rng.uniform(0, 8, count))


def within(catalog, axis, least_deg, most_deg):
    """Rows whose angle to the axis lies within the bounds, one after another."""
    rows = []
    for row, v in enumerate(catalog.direction):
        angle = math.degrees(math.atan2(np.linalg.norm(np.cross(v, axis)), v @ axis))
        if least_deg <= angle <= most_deg:
            rows.append(row)
    return rows


def counts_within(zone, region):
    """The numbers of a zone's stars and pairs within a region."""
    found = np.empty((1, 2), np.int64)
    bounds = np.array([[math.radians(region.least_deg)], [math.radians(region.most_deg)]])
    count_within(zone, np.zeros(1, np.int64), np.array([region.axis]), *bounds, found)
    return tuple(found[0].tolist())


aims = st.one_of(
    st.tuples(st.just("cap"), directions, st.just(0.0), st.floats(0.1, 180)),
    st.tuples(st.just("band"), directions, st.floats(0, 175), st.floats(0.1, 60)).map(
        lambda a: (a[0], a[1], a[2], min(180.0, a[2] + a[3]))
    ),
).map(lambda a: SearchRegion(*a))


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), region=aims)
def test_a_zone_is_what_brute_force_selects_brightest_first(seed, region):
    catalog = sky(seed)
    zone = build_zone("X", catalog, region, 8.0)
    assert zone.star.tolist() == within(catalog, region.axis, region.least_deg, region.most_deg)
    assert (np.diff(zone.magnitude_mag) >= 0).all()
    assert (zone.direction == catalog.direction[zone.star]).all()
    assert zone.summary()["stars"] == len(zone.star)


@given(axis=directions, grid_deg=grids)
def test_a_snapped_axis_is_no_farther_than_half_a_cell_s_diagonal(axis, grid_deg):
    assert angle_between_deg(np.array(snapped(*axis, grid_deg)), axis) <= grid_deg / math.sqrt(2.0)


@given(axis=directions, grid_deg=grids)
def test_snapping_a_grid_point_gives_it_back(axis, grid_deg):
    point = np.array(snapped(*axis, grid_deg))
    assert angle_between_deg(np.array(snapped(*point, grid_deg)), point) < 1e-9


@pytest.mark.parametrize("grid_deg", [0.25, 1.0, 7.0])
@pytest.mark.parametrize(
    "place", [(0, 90), (0, -90), (359.9999999, 0), (1e-13, 0), (180, 89.99), (77, -89.6)]
)
def test_poles_and_the_zero_meridian_snap_like_any_other_place(place, grid_deg):
    axis = from_ra_dec(*place)
    assert angle_between_deg(np.array(snapped(*axis, grid_deg)), axis) <= grid_deg / math.sqrt(2.0)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), region=aims, grid_deg=grids)
def test_the_shelf_s_zone_holds_every_star_of_the_exact_one(seed, region, grid_deg):
    catalog, cache = sky(seed), LruCache(1 << 20)
    wide, cached = zone_for(cache, "X", catalog, region, 8.0, grid_deg)
    exact, _ = zone_for(cache, "X", catalog, region, 8.0, 0.0)
    assert not cached
    assert set(exact.star.tolist()) <= set(wide.star.tolist())
    assert exact.star.tolist() == within(catalog, region.axis, region.least_deg, region.most_deg)
    assert counts_within(wide, region) == counts_within(exact, region)
    assert counts_within(exact, region) == (len(exact.star), exact.pairs.count)


def test_aims_of_one_grid_cell_share_a_zone_and_others_do_not():
    catalog, cache = sky(3), LruCache(1 << 20)

    def zone(
        ra_deg,
        dec_deg,
        mission="X",
        most_deg=10.66,
        separation_deg=8.0,
        grid_deg=1.0,
        stars=catalog,
    ):
        region = SearchRegion("cap", from_ra_dec(ra_deg, dec_deg), 0.0, most_deg)
        return zone_for(cache, mission, stars, region, separation_deg, grid_deg)

    first, cached = zone(83.1, -2.4)
    assert not cached
    assert zone(83.2, -2.3) == (first, True)
    for other in (
        zone(85.0, -2.4),
        zone(83.1, -2.4, mission="Y"),
        zone(83.1, -2.4, most_deg=11.0),
        zone(83.1, -2.4, separation_deg=4.0),
        zone(83.1, -2.4, grid_deg=0.0),
        zone(83.1, -2.4, stars=sky(4)),
    ):
        assert other[0] is not first
        assert not other[1]


@pytest.mark.parametrize(
    ("boresight_deg", "radius_deg", "past"),
    [(0.0, 4.0, False), (6.65, 4.0, False), (6.67, 4.0, True), (170.0, 4.0, True)],
)
def test_a_field_that_reaches_past_a_cap_s_edge_is_noticed(boresight_deg, radius_deg, past):
    region = SearchRegion("cap", from_ra_dec(0, 0), 0.0, 10.66)
    assert region.reaches_past(from_ra_dec(boresight_deg, 0), radius_deg) == past


@pytest.mark.parametrize(
    ("latitude_deg", "past"), [(0.0, False), (0.09, False), (0.11, True), (-0.11, True)]
)
def test_a_field_that_reaches_past_a_band_s_edge_is_noticed_on_either_side(latitude_deg, past):
    region = SearchRegion("band", from_ra_dec(0, 90), 87.9, 92.1)
    assert region.reaches_past(from_ra_dec(200, latitude_deg), 2.0) == past


def test_what_is_held_is_counted():
    zone = build_zone("X", sky(5), SearchRegion("cap", unit([1.0, 2.0, 3.0]), 0.0, 30.0), 8.0)
    own = zone.star.nbytes + zone.direction.nbytes + zone.magnitude_mag.nbytes
    assert zone.nbytes >= own + zone.pairs.nbytes

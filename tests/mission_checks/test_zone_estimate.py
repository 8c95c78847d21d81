"""Stars, pairs and memory that are predicted of zones, against the zones that are built."""

import json

import numpy as np
import pytest

from service.mission_checks.zone_census import zone_censuses, zone_counts
from service.mission_checks.zone_estimate import (
    neighbours_of,
    predicted,
    shape_of,
    zone_bytes,
    zone_estimates,
)
from service.missions.mission import SHIPPED_FOLDER
from service.simulate.motion import random_axis
from service.sky.zones import SearchRegion, build_zone
from service.times import parse_utc
from tests.scale import size

TIME = parse_utc("2000-01-01T12:00:00Z")


def region_of(mission, axis):
    zone = mission.zone
    if zone.kind == "cap":
        return SearchRegion("cap", axis, 0.0, zone.radius_deg)
    least, most = (zone.coelevation_deg + k * zone.half_width_deg for k in (-1, 1))
    return SearchRegion("band", axis, least, most)


@pytest.mark.torture
@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_pairs_and_memory_are_predicted_within_15_percent(sky, missions, rng, name, figures):
    """Random zones; a thousand at full size."""
    mission = missions[name]
    limit_deg = mission.tolerances.pair_separation_max_deg
    run_catalog = sky.run_catalog(mission, TIME)
    neighbours = neighbours_of(run_catalog.direction, limit_deg)
    off, memory = [], []
    first = region_of(mission, random_axis(rng))
    shape = shape_of(first.least_deg, first.most_deg, limit_deg)
    for _ in range(size(1000, 10)):
        region = region_of(mission, random_axis(rng))
        zone = build_zone(mission.name, run_catalog, region, limit_deg)
        stars, pairs = predicted(neighbours, shape, region.axis)
        assert stars == len(zone.star)
        off.append(pairs / zone.pairs.count - 1.0)
        memory.append(zone_bytes(stars, pairs, name == "SOHO") / zone.nbytes - 1.0)
    figures(
        zones=len(off),
        worst=f"{np.abs(off).max():.3f}",
        bias=f"{np.mean(off):.3f}",
        worst_memory=f"{np.abs(memory).max():.3f}",
    )
    assert np.abs(off).max() <= 0.15
    assert abs(np.mean(off)) <= 0.03
    assert np.abs(memory).max() <= 0.1


def test_stars_spread_evenly_have_the_share_of_pairs_of_two_random_points(rng):
    """The share of all pairs of a cap of 20 deg that are within 10 deg, by drawing points."""
    direction = rng.normal(size=(40_000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    neighbours = neighbours_of(direction, 10.0)
    stars, pairs = predicted(neighbours, shape_of(0.0, 20.0, 10.0), np.array([0.0, 0.0, 1.0]))
    drawn = direction[direction[:, 2] >= np.cos(np.radians(20.0))]
    near = drawn @ drawn.T >= np.cos(np.radians(10.0))
    assert stars == len(drawn)
    assert pairs == pytest.approx((near.sum() - stars) / 2, rel=0.01)


def test_a_zone_of_the_whole_sky_holds_all_pairs(rng):
    direction = rng.normal(size=(300, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    neighbours = neighbours_of(direction, 30.0)
    _, pairs = predicted(neighbours, shape_of(0.0, 180.0, 30.0), direction[0])
    near = direction @ direction.T >= np.cos(np.radians(30.0))
    assert pairs == pytest.approx((near.sum() - 300) / 2)


def test_the_worst_of_the_sky_is_that_of_the_census(sky, missions):
    mission = missions["XTE"]
    run_catalog = sky.run_catalog(mission, TIME)
    neighbours = neighbours_of(run_catalog.direction, 8.0)
    (found,) = zone_estimates(mission, run_catalog, neighbours)
    (census,) = zone_censuses(mission, run_catalog)
    assert found.stars == census.spread["stars"]
    assert found.pairs.most == pytest.approx(found.pairs_counted, rel=0.05)
    assert found.pairs_counted == pytest.approx(census.spread["pairs"].most, rel=0.005)
    assert found.richest_deg == pytest.approx(census.richest_deg(), abs=1.0)
    assert found.pairs.median == pytest.approx(census.spread["pairs"].median, rel=0.02)
    assert found.k_g_areas == pytest.approx(0.4224, abs=5e-5)
    # Equation 1 with it.
    most = found.stars.most
    assert found.pairs_bound == round(found.k_g_areas * most * (most - 1) / 2)


@pytest.mark.slow
@pytest.mark.torture
@pytest.mark.parametrize(
    ("name", "cap_deg"),
    [("XTE", None), ("SWAS", None), ("SOHO", None), ("IMAGER", None), ("XTE", 6.0)],
)
def test_no_random_axis_has_a_poorer_or_richer_zone_than_the_extremes(
    sky, missions, rng, name, cap_deg, figures
):
    """100,000 axes at full size; the pairs are counted of the 300 with the most stars."""
    mission = missions[name]
    if cap_deg:
        zone = mission.zone.model_copy(update={"radius_deg": cap_deg})
        mission = mission.model_copy(update={"zone": zone})
    run_catalog = sky.run_catalog(mission, TIME)
    limit_deg = mission.tolerances.pair_separation_max_deg
    direction, near = run_catalog.direction, neighbours_of(run_catalog.direction, limit_deg)
    (found,) = zone_estimates(mission, run_catalog, near)
    region = region_of(mission, np.array([0.0, 0.0, 1.0]))
    farthest, nearest = np.cos(np.radians((region.most_deg, region.least_deg)))
    axes = rng.normal(size=(size(100_000, 1_000), 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    stars = np.concatenate(
        [
            ((part >= farthest) & (part <= nearest)).sum(axis=1)
            for part in (axes[k : k + 100] @ direction.T for k in range(0, len(axes), 100))
        ]
    )
    densest = axes[np.argsort(stars)[-size(300, 30) :]]
    bounds = region.least_deg, region.most_deg, limit_deg
    pairs = max(zone_counts(direction, axis, *bounds)[1] for axis in densest)
    figures(
        stars=f"{stars.min()} to {stars.max()} in {found.stars.least} to {found.stars.most}",
        pairs=f"{pairs} in {found.pairs_counted}, bound {found.pairs_bound}",
    )
    assert found.stars.least <= stars.min()
    assert stars.max() <= found.stars.most
    assert pairs <= found.pairs_counted <= found.pairs_bound


@pytest.mark.slow
def test_the_command_says_where_the_sky_exceeds_the_bound(acquire):
    code, out, _ = acquire("mission", "estimate", "XTE", "--size", "10.66", "15", "--epoch", "2000")
    assert code == 0
    assert "counted exceeds the bound: cap with a radius of 15 deg\n" in out + "\n"


def test_the_command_estimates_each_size_and_limit(acquire, tmp_path):
    text = (SHIPPED_FOLDER / "xte.toml").read_text().replace('"XTE"', '"MINE"')
    (tmp_path / "mine.toml").write_text(text)
    arguments = ("mission", "estimate", "mine.toml", "--size", "6", "12", "--epoch", "2000")
    code, out, err = acquire(*arguments, "--magnitude-limit", "5", "6", "--json")
    assert code == 0, err
    found = json.loads(out)["zones"]
    assert [(each["magnitude_limit_mag"], each["size_deg"]) for each in found] == [
        (limit, size) for limit in (5.0, 6.0) for size in (6.0, 12.0)
    ]
    assert [each["pairs"]["most"] for each in found[2:]] > [each["pairs"]["most"] for each in found]
    code, out, _ = acquire(*arguments)
    assert code == 0
    assert "cap with a radius of 12 deg" in out


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["XTE", "--size", "200"], "--size"),
        (["SOHO", "--size", "0"], "--size"),
        (["XTE", "--pair-separation-max", "90"], "--pair-separation-max"),
        (["XTE", "--magnitude-limit", "-10"], "--magnitude-limit"),
        (["XTE", "--epoch", "1"], "--epoch"),
        (["NOWHERE"], "NOWHERE"),
    ],
)
def test_what_no_mission_file_could_have_is_refused_by_name(acquire, given, named):
    code, out, err = acquire("mission", "estimate", *given)
    assert code in (1, 2)
    assert out == ""
    assert named in err

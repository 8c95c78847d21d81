"""Bits that tell whether a star may stand near a point: never a star too few."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.sky.geometry.star_hashes import (
    REACH_RAD,
    build_star_voxels,
    level_for,
    star_within_reach,
)
from service.vectors import unit


@pytest.mark.parametrize("level", range(len(REACH_RAD)))
def test_no_star_within_reach_is_missed(rng, level):
    """Points just within reach of a star, off the sphere too, against every star's ball."""
    direction = unit(rng.normal(size=(3000, 3)))
    voxels = build_star_voxels(direction)
    off = unit(rng.normal(size=(3000, 3))) * REACH_RAD[level] * rng.uniform(0, 1, (3000, 1))
    assert all(star_within_reach(voxels, level, *place) for place in direction + off)


def test_few_points_away_from_all_stars_are_taken_for_near(rng):
    """In the finest level at most one in ten is, of those that no star is within reach of."""
    direction = unit(rng.normal(size=(3000, 3)))
    voxels = build_star_voxels(direction)
    places = unit(rng.normal(size=(20_000, 3)))
    away = cKDTree(direction).query(places)[0] > REACH_RAD[0]
    taken = [star_within_reach(voxels, 0, *place) for place in places[away]]
    assert np.mean(taken) < 0.1


def test_a_gate_gets_the_finest_level_that_reaches_as_far():
    """Exactly as far is far enough; beyond the widest there is none."""
    assert [level_for(reach) for reach in REACH_RAD] == list(range(len(REACH_RAD)))
    assert level_for(REACH_RAD[0] * 1.0001) == 1
    assert level_for(REACH_RAD[-1] * 1.0001) == -1


@pytest.mark.parametrize("stars", [0, 1])
def test_a_zone_without_stars_or_with_one_has_bits_too(stars):
    """They are all clear, or tell of the one."""
    voxels = build_star_voxels(np.array([[0.0, 0.0, 1.0]])[:stars])
    assert star_within_reach(voxels, 0, 0.0, 0.0, 1.0) == stars
    assert not star_within_reach(voxels, 0, 1.0, 0.0, 0.0)

"""The whole sky made ready: what is looked up is what brute force finds."""

import math

import numpy as np
import pytest

from service.compiled.jit import njit
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.run_catalog import build_run_catalog
from service.sky.catalog.star_catalog import load_embedded
from service.sky.whole_sky.bitmap import (
    CELLS,
    build_sky_bitmap,
    cell_of,
    cells_of_pairs,
    cells_of_points,
)
from service.sky.whole_sky.index import (
    BUCKET_RAD,
    FURTHER_MAG,
    MAX_PAIR_DEG,
    build_sky_index,
    index_in,
    patch_of,
)
from service.vectors import angle_between_deg, unit

LIMIT_MAG = 6.5


@pytest.fixture(scope="module")
def run_catalog():
    return build_run_catalog(load_embedded(), RunCatalogSettings(magnitude_limit_mag=7.0), 2000.0)


@pytest.fixture(scope="module")
def index(run_catalog):
    return build_sky_index(run_catalog, LIMIT_MAG, 7.1)


def test_every_pair_of_its_stars_stands_in_its_class_and_bucket(index):
    """Against all separations of a sample of stars, worked out one by one."""
    stars, pairs, offset = index.arrays.stars, index.arrays.pairs, index.arrays.offset
    held = {}
    for c in range(offset.shape[0]):
        for b in np.flatnonzero(np.diff(offset[c])):
            for at in range(offset[c, b], offset[c, b + 1]):
                held[tuple(pairs[at].tolist())] = (c, b)
    assert len(held) == index.pairs
    within = int(np.searchsorted(stars[:, 3], LIMIT_MAG, "right"))
    for row in range(0, within, 97):
        apart = np.radians(angle_between_deg(stars[:within, :3], stars[row, :3]))
        near = np.flatnonzero(apart <= math.radians(MAX_PAIR_DEG))
        for other in near[near > row]:
            c, b = held[(row, int(other))]
            assert b == int(apart[other] / BUCKET_RAD)
            assert stars[other, 3] <= index.arrays.class_edge[c, 0]
            assert c == 0 or stars[other, 3] > index.arrays.class_edge[c - 1, 0]


def test_it_holds_the_stars_to_the_limit_and_those_further_ones_that_there_are(index, run_catalog):
    """The run catalog ends half a magnitude beyond the limit; pairs end at the limit."""
    assert index.stars == len(run_catalog)
    within = np.searchsorted(run_catalog.magnitude_mag, LIMIT_MAG, "right")
    assert index.arrays.pairs.max() == within - 1
    alone = build_sky_index(run_catalog, LIMIT_MAG - FURTHER_MAG, 7.1)
    assert alone.stars == within
    assert np.array_equal(index.arrays.stars[:, :3], run_catalog.direction[: index.stars])


def test_a_bitmap_never_denies_a_star(rng):
    direction = unit(rng.normal(size=(200, 3)))
    # Edges and corners of the unfolding.
    direction = np.concatenate([direction, np.eye(3), -np.eye(3), unit([[1, -1, 0], [0, 1, -1]])])
    for radius in (1e-4, 2e-3, 7e-3):
        bits = build_sky_bitmap(direction, radius)
        for star in direction:
            for _ in range(20):
                away = np.cross(star, unit(rng.normal(size=3)))
                angle = radius * rng.uniform(0.0, 0.999)
                p = star * math.cos(angle) + unit(away) * math.sin(angle)
                cell = cell_of(*(p * rng.uniform(0.5, 2.0)))
                assert bits[cell >> 3] >> (cell & 7) & 1
        share = np.unpackbits(bits).mean()
        widened = len(direction) * math.pi * (radius + 7.0 / CELLS) ** 2 / (4.0 * math.pi)
        assert share < widened


def test_the_rim_of_a_disc_is_never_denied_in_single_precision_either(rng):
    """Many directions at once: what the search asks most often."""
    direction = unit(rng.normal(size=(60, 3)) * rng.choice([1.0, 0.01], size=(60, 3)))
    for radius in (1e-4, 9e-4, 7e-3):
        bits = build_sky_bitmap(direction, radius)
        for star in direction:
            away = unit(np.cross(star, unit(rng.normal(size=(40, 3)))))
            rim = star * math.cos(radius) + away * math.sin(radius)
            other = unit(np.cross(rim, away))
            pair = np.concatenate([rim.T, other.T]).astype(np.float32)
            cell = np.empty((2, len(rim)), np.int32)
            scale = np.float32(rng.uniform(0.5, 2.0))
            cells_of_pairs(len(rim), scale, np.float32(0.0), np.float32(0.0), pair, cell)
            assert ((bits[cell[0] >> 3] >> (cell[0] & 7)) & 1).all()


def test_many_points_of_one_candidate_lie_where_one_point_of_many_does(rng):
    pair = np.concatenate([unit(rng.normal(size=(50, 3))).T, unit(rng.normal(size=(50, 3))).T])
    pair = pair.astype(np.float32)
    coefficients = rng.normal(size=(3, 8)).astype(np.float32)
    of_points, of_turned = np.empty(8, np.int32), np.empty(8, np.int32)
    of_candidates = np.empty((2, 50), np.int32)
    for q in range(50):
        cells_of_points(8, coefficients, pair[:3, q], pair[3:, q], of_points)
        cells_of_points(8, coefficients, pair[3:, q], pair[:3, q], of_turned)
        exact = coefficients.T.astype(float) @ np.array(
            [pair[:3, q], pair[3:, q], np.cross(pair[:3, q].astype(float), pair[3:, q])]
        )
        for s in range(8):
            cells_of_pairs(50, *coefficients[:, s], pair, of_candidates)
            assert of_candidates[0, q] == of_points[s]
            assert of_candidates[1, q] == of_turned[s]
            u, v = np.divmod(of_points[s], CELLS)
            expected = np.divmod(cell_of(*exact[s]), CELLS)
            # Beside an edge single precision may fall on the other side of it.
            at_fold = {0, CELLS - 1} & {int(u), int(v), *map(int, expected)}
            assert at_fold or max(abs(u - expected[0]), abs(v - expected[1])) <= 1


def test_a_store_holds_the_index_as_it_is(index):
    """Compiled code cuts the same arrays from the one block."""
    assert not index.store.flags.writeable
    for cut, array in zip(_cut(index.store), index.arrays, strict=True):
        assert cut.dtype == array.dtype
        assert np.array_equal(cut, array)
        assert not array.flags.writeable


@njit
def _cut(store):
    """Copies, for what is cut from a block is only borrowed."""
    index = index_in(store)
    return (
        *(index.stars.copy(), index.pairs.copy(), index.offset.copy(), index.class_edge.copy()),
        *(index.bits.copy(), index.face.copy(), index.cell_start.copy(), index.cell_rows.copy()),
        *(index.patch_start.copy(), index.patch_rows.copy(), index.place.copy()),
        *(index.cell_place.copy(), index.brighter.copy()),
    )


def test_single_precision_places_are_those_of_the_stars(index):
    arrays = index.arrays
    assert np.array_equal(arrays.place, arrays.stars.astype(np.float32))
    assert np.array_equal(arrays.cell_place, arrays.place[arrays.cell_rows])


def test_a_patch_lists_every_star_of_a_field_about_it_brightest_first(index, rng):
    start, rows = index.arrays.patch_start, index.arrays.patch_rows
    for _ in range(40):
        boresight = unit(rng.normal(size=3))
        patch = patch_of(boresight)
        listed = rows[start[patch] : start[patch + 1]]
        assert (np.diff(listed.astype(int)) > 0).all()
        inside = angle_between_deg(index.arrays.stars[:, :3], boresight) <= index.radius_deg
        assert set(np.flatnonzero(inside)) <= set(listed.tolist())


def test_it_is_small(index):
    assert index.nbytes <= 15e6


def test_of_a_deep_catalog_the_brightest_are_kept():
    settings = RunCatalogSettings(magnitude_limit_mag=9.0)
    deep = build_sky_index(build_run_catalog(load_embedded(), settings, 2000.0), 9.0, 4.0)
    assert deep.stars < 40_000
    assert deep.nbytes <= 20e6

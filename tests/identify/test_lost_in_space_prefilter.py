"""The sieves of a lost-in-space search lose nothing that brute force finds."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from service.attitude.covariance import within
from service.identify.lost_in_space.decision import LARGEST_SIGMA_RAD
from service.identify.lost_in_space.pair_order import rows_of_magnitude
from service.identify.lost_in_space.prefilter import pairs_of
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace
from service.identify.lost_in_space.workspace import CHUNK, Chunk
from service.sky.whole_sky.index import build_sky_index
from studies.scenes import Conditions, SceneSky, draw_random_points, draw_scenes


@pytest.fixture(scope="module")
def sky():
    return SceneSky.for_conditions(Conditions())


@pytest.fixture(scope="module")
def index(sky):
    return build_sky_index(sky.run_catalog, 6.5, FieldOfView.square(10.0).radius_deg)


@pytest.fixture
def chunk():
    return Chunk(
        np.empty((6, CHUNK), np.float32),
        np.empty(CHUNK, np.int32),
        np.empty((2, CHUNK), np.int32),
        np.empty(CHUNK, np.int32),
        np.empty(2 * CHUNK, np.int32),
    )


def test_the_rows_of_a_magnitude_are_all_within_its_gate_and_few_more(index, rng):
    magnitude = index.arrays.stars[:, 3]
    for seen in (*rng.uniform(-3.0, 9.0, 60), -10.0, 20.0):
        for gate in (0.0, 0.3, 1.7):
            first, last = rows_of_magnitude(index.arrays.brighter, seen, gate)
            wanted = np.flatnonzero(np.abs(magnitude - seen) <= gate)
            assert len(wanted) == 0 or (first <= wanted[0] and wanted[-1] < last)
            got = magnitude[first:last]
            assert (got >= seen - gate - 0.051).all()
            assert (got <= seen + gate + 0.051).all()
    first, last = rows_of_magnitude(index.arrays.brighter, math.nan, 1.0)
    assert first == 0
    assert last >= index.stars


def test_candidates_are_all_pairs_of_a_run_both_ways_round(index, chunk, rng):
    arrays = index.arrays
    for _ in range(30):
        start = int(rng.integers(index.pairs - 400))
        end = start + int(rng.integers(0, 400))
        rows_i, rows_j = (tuple(sorted(rng.integers(0, 9000, 2).tolist())) for _ in range(2))
        found, at = [], start
        while at < end:
            count = min(CHUNK, end - at)
            candidates = pairs_of(arrays.pairs, arrays.place, at, count, rows_i, rows_j, chunk)
            assert candidates == sum(int(bits).bit_count() for bits in chunk.allowed[:count])
            for q, pair in enumerate(arrays.pairs[at : at + count].tolist()):
                found += [
                    pair[::-1] if turned else pair
                    for turned in (0, 1)
                    if chunk.allowed[q] >> turned & 1
                ]
                assert np.array_equal(chunk.places[:3, q], arrays.place[pair[0], :3])
                assert np.array_equal(chunk.places[3:, q], arrays.place[pair[1], :3])
            at += count
        expected = [
            [a, b]
            for r, s in arrays.pairs[start:end].tolist()
            for a, b in ((r, s), (s, r))
            if rows_i[0] <= a < rows_i[1] and rows_j[0] <= b < rows_j[1]
        ]
        assert found == expected


def test_an_attitude_is_told_where_every_axis_is_known_well_enough(rng):
    """Against the eigenvalues."""
    told = 0
    for _ in range(300):
        root = rng.normal(size=(3, 3)) * LARGEST_SIGMA_RAD * rng.uniform(0.1, 1.0)
        covariance = root @ root.T
        largest = np.linalg.eigvalsh(covariance)[-1]
        assert within(covariance, LARGEST_SIGMA_RAD**2) == (largest < LARGEST_SIGMA_RAD**2)
        told += largest < LARGEST_SIGMA_RAD**2
    assert 30 < told < 270


def test_one_solver_serves_many_threads(sky, index, seed, rng):
    """Each search has a block to work in, and more points than usual get a larger one."""
    solver = LostInSpace(index, FieldOfView.square(10.0))
    scenes = [
        *draw_scenes(sky, Conditions(), 40, seed),
        *(draw_random_points(sky, Conditions(), n, rng) for n in (0, 2, 12, 100)),
    ]

    def solved(scene):
        return solver.solve(scene.direction, scene.magnitude_mag, scene.sigma_rad)

    alone = [solved(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(solved, scenes * 5))
    for k, result in enumerate(together):
        expected = alone[k % len(scenes)]
        assert result.refusal is expected.refusal
        assert result.work == expected.work
        assert np.array_equal(result.matrices, expected.matrices)
        assert np.array_equal(result.star, expected.star)

"""PTP: how uncertain a projection is, who validates whom, and what the attitude check refuses."""

import numpy as np
import pytest

from service.identify.identification import Outcome
from service.identify.triangles.attitude_check import log_chance
from service.identify.triangles.ptp import (
    SIGMA_FLOOR_ARCSEC,
    identify_triangles,
    observed_triangles,
    propose,
)
from service.identify.triangles.triangle_match import (
    count_pairs,
    projection_sigma,
    side_sigma,
    validate,
)
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.run_catalog import build_run_catalog
from service.sky.catalog.star_catalog import load_embedded
from service.sky.geometry.triangles import REACH_DEG, chord, project
from service.sky.whole_sky.guide import build_guide
from service.vectors import ARCSEC_PER_RADIAN, angle_between_deg, coordinate_rotation, unit
from tests.chance import at_least
from tests.scale import draws

PIXEL_RAD = 12e-3 / 70.2262
HALF_FIELD = 6.144 / 70.2262
FIELDS = draws(20, 40)
AT_REST = np.zeros(3)


@pytest.fixture(scope="module")
def catalog():
    settings = RunCatalogSettings(magnitude_limit_mag=6.0, merge_within_arcsec=60.0)
    return build_run_catalog(load_embedded(), settings, 2000.0)


@pytest.fixture(scope="module")
def guide(catalog):
    return build_guide(catalog, REACH_DEG)


def attitude(rng):
    return coordinate_rotation(0, rng.uniform(0, 360)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def proper(rng):
    matrix = attitude(rng)
    return matrix * np.sign(np.linalg.det(matrix))


def noisy(direction, sigma_rad, rng):
    """Unit vectors with Gaussian noise of one sigma along either tangent."""
    noise = rng.normal(size=direction.shape) * sigma_rad
    across = noise - (noise * direction).sum(axis=1, keepdims=True) * direction
    return unit(direction + across)


def field(catalog, rng, px, fewest=6):
    """Stars of a square field in camera axes, with noise; their rows; the attitude."""
    while True:
        matrix = proper(rng)
        seen = catalog.direction @ matrix.T
        row = np.flatnonzero((np.abs(seen[:, :2]) <= HALF_FIELD * seen[:, 2:]).all(axis=1))
        if len(row) >= fewest:
            return noisy(seen[row], px * PIXEL_RAD, rng), row, matrix


def random_field(rng, points):
    place = rng.uniform(-HALF_FIELD, HALF_FIELD, (points, 2))
    return unit(np.column_stack([place, np.ones(points)]))


def sigma_of(direction, px):
    return np.full(len(direction), max(px, 0.25) * PIXEL_RAD)


class TestHowUncertain:
    @pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (0.3, 1.0, 2.0)])
    def test_sigma_of_a_projection_is_what_monte_carlo_scatters(self, guide, catalog, rng, sigmas):
        """And three of them cover 99.7 % of the draws: the law behind the search range."""
        sigma = np.array(sigmas) * PIXEL_RAD
        axis, mean = guide.triangles.axis, guide.triangles.mean
        for row in rng.integers(0, guide.triangles.count, 5):
            m, i, j = catalog.direction[guide.triangles.star[row]]
            draws = [
                noisy(np.repeat(v[None], 20_000, 0), s, rng)
                for v, s in zip((m, i, j), sigma, strict=True)
            ]
            a, b, c = draws
            sides = 1e4 * np.column_stack(
                [np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (a, c), (b, c))]
            )
            scattered = project(sides, axis, mean)
            told = projection_sigma(m, i, j, axis, *sigma)
            assert scattered.std() == pytest.approx(told, rel=0.03)
            inside = np.abs(scattered - scattered.mean()) <= 3.0 * told
            assert inside.mean() == pytest.approx(0.9973, abs=0.0016)
            for k, (x, y, s, t) in enumerate(((m, i, 0, 1), (m, j, 0, 2), (i, j, 1, 2))):
                assert sides[:, k].std() == pytest.approx(
                    side_sigma(x, y, sigma[s], sigma[t]), rel=0.03
                )

    def test_a_pixel_is_about_three_units_of_projection(self, guide, catalog):
        """The order of the paper's figures: sides of 2.4, projections near 2.9."""
        told = [
            projection_sigma(*catalog.direction[rows], guide.triangles.axis, *[PIXEL_RAD] * 3)
            for rows in guide.triangles.star[::97]
        ]
        assert np.mean(told) == pytest.approx(2.87, abs=0.1)

    def test_a_true_triangle_is_within_three_sigmas_of_its_own_guide(self, guide, catalog, rng):
        """Of the triangles of real fields at a pixel of noise 99 of 100 find themselves."""
        found = held = 0
        known = {tuple(rows): at for at, rows in enumerate(guide.triangles.star.tolist())}
        for _ in range(FIELDS):
            direction, row, _ = field(catalog, rng, 1.0)
            image, _ = observed_triangles(direction, guide.triangles)
            proposals = propose(
                direction, sigma_of(direction, 1.0), 0.0, guide.triangles, len(catalog)
            )
            named = set(zip(proposals.image.tolist(), proposals.star.tolist(), strict=True))
            for rows in image.tolist():
                if tuple(row[rows].tolist()) in known:
                    held += 1
                    found += all((k, int(row[k])) in named for k in rows)
        assert held > 2 * FIELDS
        assert found >= at_least(held, 0.98)


class TestWhoIsIdentified:
    @pytest.mark.parametrize("px", [0.0, 1.0, 2.0])
    def test_stars_of_the_sky_are_named_rightly_in_nearly_every_field(
        self, guide, catalog, rng, px
    ):
        right = wrong = 0
        for _ in range(FIELDS):
            direction, row, _ = field(catalog, rng, px)
            found = identify_triangles(direction, sigma_of(direction, px), AT_REST, guide)
            unique = found.unique
            wrong += int((found.star[unique] != row[unique]).sum())
            right += unique.sum() >= 0.8 * len(row)
        assert wrong == 0
        assert right >= at_least(FIELDS, 0.95)

    def test_the_axes_in_which_a_field_is_given_do_not_matter(self, guide, catalog, rng):
        """Nothing of an a priori attitude is asked: any rotation gives the same names."""
        for _ in range(10):
            direction, _, _ = field(catalog, rng, 1.0)
            sigma = sigma_of(direction, 1.0)
            one = identify_triangles(direction, sigma, AT_REST, guide)
            turned = np.ascontiguousarray(direction @ proper(rng).T)
            other = identify_triangles(turned, sigma, AT_REST, guide)
            assert one.star.tolist() == other.star.tolist()
            assert one.votes.tolist() == other.votes.tolist()

    def test_votes_are_distinct_triangles_that_name_the_star(self, guide, catalog, rng):
        direction, _, _ = field(catalog, rng, 0.0, fewest=12)
        found = identify_triangles(direction, sigma_of(direction, 0.0), AT_REST, guide)
        image, _ = observed_triangles(direction, guide.triangles)
        for k in np.flatnonzero(found.unique):
            distinct = {tuple(sorted(rows)) for rows in image.tolist() if k in rows}
            assert found.votes[k] <= len(distinct)
            assert found.runner_up[k] <= found.votes[k]
        assert np.isnan(found.probability).all()

    def test_aberration_is_no_hindrance_and_is_taken_off(self, guide, catalog, rng):
        """Apparent directions at 30 km/s, sigmas of three arcseconds: twenty arcsec matter."""
        velocity_c = unit(rng.normal(size=3)) * 1e-4
        named = 0
        for _ in range(10):
            matrix = proper(rng)
            apparent = unit(catalog.direction + velocity_c) @ matrix.T
            row = np.flatnonzero(
                (np.abs(apparent[:, :2]) <= HALF_FIELD * apparent[:, 2:]).all(axis=1)
            )
            sigma = np.full(len(row), 3.0 / ARCSEC_PER_RADIAN)
            direction = noisy(np.ascontiguousarray(apparent[row]), 3.0 / ARCSEC_PER_RADIAN, rng)
            found = identify_triangles(direction, sigma, velocity_c, guide)
            assert (found.star[found.unique] == row[found.unique]).all()
            named += found.unique.sum() >= 0.8 * len(row)
        assert named >= 8


class TestWhatIsRefused:
    def test_a_mirrored_sky(self, guide, catalog, rng):
        """Sides are the same in a mirror, and stars share as before: the rotation is not there."""
        shared = 0
        for _ in range(FIELDS):
            direction, _, _ = field(catalog, rng, 1.0)
            mirrored = direction * [-1.0, 1.0, 1.0]
            sigma = sigma_of(mirrored, 1.0)
            proposals = propose(mirrored, sigma, 0.0, guide.triangles, len(catalog))
            shared += (proposals.validated(len(mirrored)) >= 0).sum() >= 3
            found = identify_triangles(mirrored, sigma, AT_REST, guide)
            assert (found.outcome == Outcome.UNMATCHED).all()
        assert shared >= at_least(FIELDS, 0.8)

    @pytest.mark.parametrize("px", [0.5, 1.0, 2.0])
    def test_random_points(self, guide, rng, px):
        for _ in range(2 * FIELDS):
            direction = random_field(rng, int(rng.integers(5, 21)))
            found = identify_triangles(direction, sigma_of(direction, px), AT_REST, guide)
            assert (found.outcome == Outcome.UNMATCHED).all()

    @pytest.mark.parametrize("points", [0, 1, 2])
    def test_too_few_stars_for_a_triangle(self, guide, rng, points):
        direction = random_field(rng, points)
        found = identify_triangles(direction, sigma_of(direction, 1.0), AT_REST, guide)
        assert found.outcome.tolist() == [Outcome.UNMATCHED] * points
        assert found.star.tolist() == [-1] * points

    def test_an_empty_sky(self, catalog, rng):
        settings = RunCatalogSettings(magnitude_limit_mag=-2.0)
        empty = build_guide(build_run_catalog(load_embedded(), settings, 2000.0), REACH_DEG)
        direction, _, _ = field(catalog, rng, 1.0)
        found = identify_triangles(direction, sigma_of(direction, 1.0), AT_REST, empty)
        assert not found.unique.any()

    def test_what_chance_can_do_grows_with_noise_and_falls_with_every_star(self):
        """And with every star of the catalog that crowds the place where they are found."""

        def chance(matched, sigma=PIXEL_RAD, density=400.0):
            return log_chance(12, np.full(matched, density), 5055, 0.2, sigma)

        assert (np.diff([chance(m) for m in range(4, 13)]) < 0).all()
        assert chance(5, 2 * PIXEL_RAD) > chance(5)
        assert chance(5, density=4_000.0) > chance(5) + 3 * np.log(10.0)

    def test_a_place_is_as_crowded_as_its_neighbourhood(self, guide, catalog):
        """The Pleiades against the sky's mean, counted by hand."""
        mean = len(catalog) / (4 * np.pi)
        assert guide.density.min() == pytest.approx(mean)
        alcyone = catalog.star_id.index("HIP 17702")
        near = angle_between_deg(catalog.direction[alcyone], catalog.direction) <= 1.0
        solid_angle = 2 * np.pi * (1 - np.cos(np.radians(1.0)))
        assert guide.density[alcyone] == pytest.approx((near.sum() - 1) / solid_angle)
        assert guide.density[alcyone] > 10 * mean


class TestWhatIsAmbiguous:
    def test_two_points_on_one_catalog_star_are_neither(self, guide, catalog, rng):
        """A point doubled by 20 arcsec: the star is a rival for both, and certain for none."""
        doubled = 0
        for _ in range(15):
            direction, row, _ = field(catalog, rng, 0.25, fewest=8)
            twin = unit(direction[0] + rng.normal(size=3) * 20.0 / ARCSEC_PER_RADIAN)
            both = np.vstack([direction, twin])
            found = identify_triangles(both, sigma_of(both, 1.0), AT_REST, guide)
            for k in (0, len(both) - 1):
                assert found.outcome[k] != Outcome.UNIQUE
                if found.outcome[k] == Outcome.AMBIGUOUS:
                    assert int(row[0]) in found.rivals[k]
                    doubled += 1
            unique = np.flatnonzero(found.unique)
            assert (found.star[unique] == row[unique]).all()
        assert doubled >= 20

    def test_a_close_double_is_ambiguous_and_names_both(self, rng):
        """In a catalog that keeps both stars of doubles the tracker cannot tell which it saw."""
        settings = RunCatalogSettings(magnitude_limit_mag=6.0, merge_within_arcsec=0.0)
        catalog = build_run_catalog(load_embedded(), settings, 2000.0)
        guide = build_guide(catalog, REACH_DEG)
        named = checked = 0
        for _ in range(400):
            matrix = proper(rng)
            seen = catalog.direction @ matrix.T
            row = np.flatnonzero((np.abs(seen[:, :2]) <= HALF_FIELD * seen[:, 2:]).all(axis=1))
            apart = np.linalg.norm(seen[row][:, None] - seen[row][None], axis=2) + np.eye(len(row))
            close = np.argwhere(apart < 1.5 * PIXEL_RAD)
            if len(row) < 8 or not len(close):
                continue
            double = close[0]
            left_out = max(double)
            kept = np.delete(np.arange(len(row)), left_out)
            direction = noisy(seen[row][kept], 0.5 * PIXEL_RAD, rng)
            found = identify_triangles(direction, sigma_of(direction, 0.5), AT_REST, guide)
            if not (found.outcome != Outcome.UNMATCHED).any():
                continue
            k = int(np.flatnonzero(kept == min(double))[0])
            assert found.outcome[k] == Outcome.AMBIGUOUS
            assert set(row[double].tolist()) <= set(found.rivals[k])
            checked += 1
            named += found.unique.sum() >= 5
            if checked == 5:
                break
        assert checked == 5
        assert named >= 3


class TestSigmaFloor:
    def test_a_sigma_of_almost_nothing_still_finds_the_sky(self, guide, catalog, rng):
        """Rounded input at a thousandth of an arcsecond would empty every search range."""
        named = 0
        for _ in range(10):
            direction, row, _ = field(catalog, rng, 0.0)
            direction = unit(direction.astype(np.float32))
            found = identify_triangles(direction, np.full(len(row), 5e-9), AT_REST, guide)
            named += (found.star == row).sum() >= 0.8 * len(row)
        assert named >= 9
        assert SIGMA_FLOOR_ARCSEC / ARCSEC_PER_RADIAN > 5e-9


class TestSharing:
    @staticmethod
    def tally(image, star, n, stars=50):
        image, star = np.array(image, np.int32), np.array(star, np.int32)
        pairs, held = np.empty((3, 3 * len(image)), np.int32), np.empty(3 * len(image), np.bool_)
        count = count_pairs(image, star, stars, *pairs, held)
        match = np.empty(n, np.int32)
        validate(*pairs[:, :count], held[:count], match)
        return dict(
            zip(zip(*pairs[:2, :count].tolist(), strict=True), pairs[2], strict=False)
        ), match

    def test_one_triangle_from_two_corners_is_no_second_witness(self):
        votes, match = self.tally([[0, 1, 2], [1, 0, 2]], [[7, 8, 9], [8, 7, 9]], 3)
        assert set(votes.values()) == {1}
        assert (match == -1).all()

    def test_a_star_with_two_equal_rivals_is_dropped(self):
        _, match = self.tally(
            [[0, 1, 2], [0, 3, 4], [0, 5, 6], [0, 1, 5]],
            [[7, 8, 9], [7, 10, 11], [20, 21, 22], [20, 23, 24]],
            7,
        )
        assert match[0] == -1

    def test_a_catalog_star_is_given_away_once(self):
        _, match = self.tally(
            [[0, 1, 2], [0, 1, 3], [4, 5, 6], [4, 5, 7], [0, 2, 3]],
            [[7, 8, 9], [7, 8, 10], [7, 11, 12], [7, 11, 13], [7, 9, 10]],
            8,
        )
        assert match[0] == 7
        assert match[4] == -1

    def test_a_chord_is_a_chord(self):
        assert chord(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])) == pytest.approx(1e4 * 2**0.5)

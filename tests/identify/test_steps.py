"""Steps 1 to 10 and the votes, on skies of a few stars, counted by hand."""

import math

import numpy as np

from service.identify.voting.starid import identify_by_votes
from service.missions.mission import Tests as Switches
from service.sky.zones import build_zone
from tests.reference.batches import rotation
from tests.reference.sightings import identified
from tests.reference.small_sky import (
    ALL_OFF,
    at,
    band,
    cap,
    identify,
    named,
    run_catalog,
    sighting,
)

# Three stars around the cap's axis: separations of 1, 2 and the root of 5 degrees.
STARS = at((0, 0), (1, 0), (0, 2))
MAGNITUDES = [3.0, 4.0, 5.0]
CATALOG = run_catalog(STARS, MAGNITUDES)


def words(identification, catalog=CATALOG):
    return named(identification, catalog)


def test_three_stars_seen_as_they_are_get_one_vote_from_each_pair():
    assert words(identify(CATALOG, STARS, MAGNITUDES)) == [
        ("unique", "STAR 0", 2, 0),
        ("unique", "STAR 1", 2, 0),
        ("unique", "STAR 2", 2, 0),
    ]


def test_without_any_test_each_pair_votes_for_both_pairings():
    assert words(identify(CATALOG, STARS, MAGNITUDES, tests=ALL_OFF)) == [
        ("unique", "STAR 0", 2, 1),
        ("unique", "STAR 1", 2, 1),
        ("unique", "STAR 2", 2, 1),
    ]


def test_two_stars_without_any_test_are_a_tie_with_both_rivals_named():
    rivals = ("STAR 0", "STAR 1")
    assert words(identify(CATALOG, STARS[:2], MAGNITUDES[:2], tests=ALL_OFF)) == [
        ("ambiguous", rivals, 1, 1),
        ("ambiguous", rivals, 1, 1),
    ]


def test_one_vote_is_enough():
    assert words(identify(CATALOG, STARS[:2], MAGNITUDES[:2])) == [
        ("unique", "STAR 0", 1, 0),
        ("unique", "STAR 1", 1, 0),
    ]


def test_a_star_alone_or_no_star_at_all_is_no_error():
    assert words(identify(CATALOG, STARS[:1], [3.0])) == [("unmatched", None, 0, 0)]
    assert words(identify(CATALOG, STARS[:0], [])) == []


def test_a_sky_without_stars_leaves_everything_unmatched():
    empty = run_catalog(np.empty((0, 3)), [])
    assert words(identify(empty, STARS, MAGNITUDES), empty) == [("unmatched", None, 0, 0)] * 3


def test_every_surviving_candidate_pair_votes_again():
    # Two catalog pairs of the same separation share their brighter star.
    sky = at((0, 0), (1, 0), (-1, 0))
    catalog = run_catalog(sky, [3.0, 4.0, 4.0])
    found = words(identify(catalog, sky[:2], [3.0, 4.0], cross_product_deg=180.0), catalog)
    assert found == [("unique", "STAR 0", 2, 0), ("ambiguous", ("STAR 1", "STAR 2"), 1, 1)]


def test_rivals_are_named_brightest_first():
    sky = at((0, 0), (-1, 0), (1, 0))
    catalog = run_catalog(sky, [3.0, 5.0, 4.0])
    limits = {"cross_product_deg": 180.0, "magnitude_mag": 1.0}
    found = words(identify(catalog, sky[:2], [3.0, 4.5], **limits), catalog)
    assert found[1] == ("ambiguous", ("STAR 2", "STAR 1"), 1, 1)


class TestSeparation:
    def test_a_pair_within_the_tolerance_is_a_candidate_and_beyond_it_is_not(self):
        inside, outside = (rotation([0, 0, 1], by) @ STARS[1] for by in (0.0065, 0.0067))
        near = identify(CATALOG, np.array([STARS[0], inside]), [3.0, 4.0])
        far = identify(CATALOG, np.array([STARS[0], outside]), [3.0, 4.0])
        assert near.votes.tolist() == [1, 1]
        assert far.votes.tolist() == [0, 0]

    def test_catalog_pairs_beyond_the_largest_separation_are_no_candidates(self):
        found = identify(CATALOG, STARS, MAGNITUDES, pair_separation_max_deg=1.5)
        assert found.votes.tolist() == [1, 1, 0]


class TestMagnitude:
    def test_a_difference_of_exactly_the_order_tolerance_tells_the_order(self):
        # Both magnitudes are exact in binary, and too far off for XMTOL once the test applies.
        sky, off = STARS[:2], 2.0
        assert identify(CATALOG, sky, [3.0 + off, 3.5 + off]).votes.tolist() == [0, 0]

    def test_below_the_order_tolerance_no_magnitude_is_compared_at_all(self):
        assert identify(CATALOG, STARS[:2], [9.0, 9.25]).votes.tolist() == [1, 1]

    def test_a_difference_of_exactly_the_magnitude_tolerance_passes(self):
        found = identify(CATALOG, STARS[:2], [3.5, 4.5], magnitude_mag=0.5)
        assert found.votes.tolist() == [1, 1]

    def test_the_brighter_is_compared_with_the_brighter(self):
        assert identify(CATALOG, STARS[:2], [4.0, 3.0], cross_product_deg=180.0).star.tolist() == [
            1,
            0,
        ]

    def test_a_star_without_a_magnitude_passes_the_magnitude_tests_by(self):
        found = identify(CATALOG, STARS, [None, 14.0, 15.0])
        # Pairs with star 0 are not compared; the pair of 1 and 2 is, and fails.
        assert found.votes.tolist() == [2, 1, 1]

    def test_the_test_can_be_switched_off(self):
        off = Switches(magnitude=False, pole=False)
        assert identify(CATALOG, STARS[:2], [19.0, 14.0], tests=off).star.tolist() == [0, 1]

    def test_equal_catalog_magnitudes_rank_by_their_row(self):
        catalog = run_catalog(STARS[:2], [4.0, 4.0])
        found = identify(catalog, STARS[:2], [3.75, 4.25], cross_product_deg=180.0)
        assert found.star.tolist() == [0, 1]
        turned = identify(catalog, STARS[:2], [4.25, 3.75], cross_product_deg=180.0)
        assert turned.star.tolist() == [1, 0]


class TestCap:
    """Steps 4 and 5; the observed pair is turned about the first star."""

    @staticmethod
    def turned(angle_deg, magnitudes=(None, None), **tolerances):
        observed = (rotation(STARS[0], angle_deg) @ STARS[:2].T).T
        return identify(CATALOG, observed, magnitudes, **tolerances)

    def test_the_cross_products_order_a_pair_that_the_magnitudes_do_not(self):
        assert self.turned(30.0).star.tolist() == [0, 1]
        assert self.turned(89.9).star.tolist() == [0, 1]
        # Beyond 90 deg the other order is the nearer one: the assumption of step 4 breaks.
        assert self.turned(90.1).star.tolist() == [1, 0]

    def test_a_tolerance_below_90_rejects_both_orders_in_between(self):
        assert self.turned(19.9, cross_product_deg=20.0).star.tolist() == [0, 1]
        assert self.turned(20.1, cross_product_deg=20.0).star.tolist() == [-1, -1]
        assert self.turned(159.9, cross_product_deg=20.0).star.tolist() == [-1, -1]
        assert self.turned(160.1, cross_product_deg=20.0).star.tolist() == [1, 0]

    def test_beyond_90_a_pair_votes_for_both_orders_where_both_pass(self):
        for angle_deg in (60.1, 90.0, 119.9):
            found = words(self.turned(angle_deg, cross_product_deg=120.0))
            assert found == [("ambiguous", ("STAR 0", "STAR 1"), 1, 1)] * 2
        # One order's angle beyond the tolerance: the other order alone.
        assert self.turned(59.9, cross_product_deg=120.0).star.tolist() == [0, 1]
        assert self.turned(120.1, cross_product_deg=120.0).star.tolist() == [1, 0]

    def test_beyond_90_an_order_told_by_the_magnitudes_votes_alone(self):
        found = self.turned(100.0, (3.0, 4.0), cross_product_deg=120.0)
        assert named(found, CATALOG) == [("unique", "STAR 0", 1, 0), ("unique", "STAR 1", 1, 0)]

    def test_a_tolerance_of_180_is_as_good_as_no_test(self):
        for angle_deg in (0.0, 100.0, 180.0):
            observed = (rotation(STARS[0], angle_deg) @ STARS.T).T
            widest = identify(CATALOG, observed, [None] * 3, cross_product_deg=180.0)
            assert words(widest) == words(identify(CATALOG, observed, [None] * 3, tests=ALL_OFF))

    def test_an_order_told_by_the_magnitudes_is_confirmed_or_refuted_alone(self):
        assert self.turned(89.9, (3.0, 4.0)).star.tolist() == [0, 1]
        assert self.turned(90.1, (3.0, 4.0)).star.tolist() == [-1, -1]
        assert self.turned(90.1, (4.0, 3.0)).star.tolist() == [1, 0]

    def test_without_the_test_any_roll_will_do(self):
        off = Switches(cross_product=False, pole=False)
        assert self.turned(170.0, (3.0, 4.0), tests=off).star.tolist() == [0, 1]

    def test_two_stars_in_one_place_have_no_cross_product_and_no_vote(self):
        found = identify(CATALOG, STARS[[0, 0]], [3.0, 4.0], separation_deg=5.0)
        assert found.votes.tolist() == [0, 0]


class TestBand:
    """Steps 6 to 10, about the north pole: the stars' colatitudes are what is compared."""

    PAIR = at((0, 0), (1, 1))
    LEVEL = at((0, 0), (1, 0))

    @staticmethod
    def seen(sky, observed, magnitudes=(None, None), **tolerances):
        return identify(run_catalog(sky, [3.0, 4.0]), observed, magnitudes, band(), **tolerances)

    def test_the_closer_to_the_pole_is_the_closer_to_the_pole_whatever_the_roll(self):
        for roll in (0.0, 90.0, 123.0, 180.0):
            observed = (rotation([0, 0, 1], roll) @ self.PAIR.T).T
            assert self.seen(self.PAIR, observed).star.tolist() == [0, 1]
            assert self.seen(self.PAIR, observed[::-1]).star.tolist() == [1, 0]

    def test_no_cross_product_follows_where_the_pole_told_the_order(self):
        # Mirrored in longitude: the same colatitudes, the cross products far apart.
        observed = at((0, 0), (-1, 1))
        assert self.seen(self.PAIR, observed, cross_product_deg=1.0).star.tolist() == [0, 1]

    def test_a_difference_of_differences_beyond_the_first_tolerance_is_rejected(self):
        tilted = (rotation([1, 0, 0], 10.0) @ self.PAIR.T).T
        difference = abs(math.degrees(math.asin(tilted[1, 2])) - 1.0)
        assert self.seen(self.PAIR, tilted, pole_difference_deg=difference + 0.01).votes[0] == 1
        assert self.seen(self.PAIR, tilted, pole_difference_deg=difference - 0.01).votes[0] == 0

    def test_angles_to_the_pole_beyond_the_second_tolerance_are_rejected(self):
        sunk = (rotation([0, 1, 0], 3.0) @ self.PAIR.T).T
        assert self.seen(self.PAIR, sunk, pole_angle_deg=3.1).votes.tolist() == [1, 1]
        assert self.seen(self.PAIR, sunk, pole_angle_deg=2.9).votes.tolist() == [0, 0]

    def test_magnitudes_that_tell_another_order_than_the_pole_refute_the_pair(self):
        assert self.seen(self.PAIR, self.PAIR, (3.0, 4.0)).star.tolist() == [0, 1]
        assert self.seen(self.PAIR, self.PAIR[::-1], (3.0, 4.0)).votes.tolist() == [0, 0]

    def test_a_level_pair_goes_on_to_the_cross_products(self):
        assert self.seen(self.LEVEL, self.LEVEL).star.tolist() == [0, 1]
        assert self.seen(self.LEVEL, self.LEVEL[::-1]).star.tolist() == [1, 0]
        turned = (rotation([0, 0, 1], 100.0) @ self.LEVEL.T).T
        # In the band's plane the cross product is the pole, whatever the roll.
        assert self.seen(self.LEVEL, turned, cross_product_deg=1.0).star.tolist() == [0, 1]

    def test_a_level_pair_passes_the_second_tolerance_by(self):
        sunk = (rotation([0, 1, 0], 3.0) @ self.LEVEL.T).T
        assert self.seen(self.LEVEL, sunk, pole_angle_deg=0.1).votes.tolist() == [1, 1]

    def test_a_level_pair_votes_for_both_orders_where_both_pass(self):
        # The pair's own axis tilted by 100 deg; its colatitudes stay within both tolerances.
        sky = at((0, 0), (0.1, 0))
        tilted = (rotation([1, 0, 0], 100.0) @ sky.T).T
        found = self.seen(sky, tilted, cross_product_deg=120.0)
        assert [len(rivals) for rivals in found.rivals] == [2, 2]
        assert self.seen(sky, tilted, cross_product_deg=90.0).star.tolist() == [1, 0]

    def test_with_the_pole_off_the_cross_products_alone_decide(self):
        off = Switches(pole=False)
        observed = at((0, 0), (-1, 1))
        found = self.seen(self.PAIR, observed, tests=off, cross_product_deg=80.0)
        assert found.votes.tolist() == [0, 0]

    def test_with_the_cross_products_off_a_level_pair_votes_for_both_pairings(self):
        off = Switches(cross_product=False)
        found = self.seen(self.LEVEL, self.LEVEL, tests=off)
        assert [len(rivals) for rivals in found.rivals] == [2, 2]


def test_stars_beyond_the_zone_get_no_vote_though_the_shelf_may_hold_them():
    asked, held = cap(radius_deg=1.5), cap(radius_deg=4.0)
    zone = build_zone("SMALL", CATALOG, held, 8.0)
    seen = sighting(STARS, MAGNITUDES, asked, zone, Switches(pole=False))
    assert identified(identify_by_votes, seen, weighs=False).votes.tolist() == [1, 1, 0]
    assert len(zone.star) == 3

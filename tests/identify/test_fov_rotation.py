"""The field-of-view rotation: what it measures, and what the switch does to batches."""

import numpy as np
import pytest
from msgspec import structs

from service.acquire import acquire
from service.acquire.choices import choices_of
from service.identify.voting.fov_rotation import rotation_rad
from service.observations.batch import BoresightPrior
from service.observations.schema import OptionsIn
from service.simulate.motion import random_axis, turned_by
from service.vectors import rotate_about, unit
from studies.paper_1994.printed import the_paper
from studies.paper_1994.views import EPOCH, batch_of, draw_zone

BORESIGHT, POLE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def rotation_deg(turn, rng, is_band=False):
    """The rotation measured of a pair in the field that is carried along by a turn."""
    pair = unit(BORESIGHT + 0.03 * rng.normal(size=(2, 3)))
    a, b = turn(pair)
    return np.degrees(rotation_rad(*pair, a, b, BORESIGHT, POLE, is_band))


def about(axis, angle_deg):
    return lambda vectors: rotate_about(np.radians(angle_deg) * np.asarray(axis), vectors)


@pytest.mark.parametrize("angle_deg", [0.0, 3.0, -25.0, 90.0, 179.0])
def test_a_turn_about_the_boresight_is_measured_as_it_is(rng, angle_deg):
    measured = rotation_deg(about(BORESIGHT, angle_deg), rng)
    assert measured == pytest.approx(abs(angle_deg), abs=1e-6)
    assert rotation_deg(about(BORESIGHT, angle_deg), rng, is_band=True) == pytest.approx(measured)


def test_pointing_elsewhere_is_no_rotation_about_the_boresight(rng):
    for angle_deg in (1.0, 10.0, 60.0):
        across = unit(np.cross(BORESIGHT, random_axis(rng)))
        assert rotation_deg(about(across, angle_deg), rng) == pytest.approx(0.0, abs=1e-6)


def test_in_a_band_a_roll_about_the_pole_is_none(rng):
    for angle_deg in (1.0, 90.0, 180.0, 270.0):
        measured = rotation_deg(about(POLE, angle_deg), rng, is_band=True)
        assert measured == pytest.approx(0.0, abs=1e-6)


def test_a_pair_taken_the_wrong_way_round_is_half_a_turn(rng):
    for is_band in (False, True):
        measured = rotation_deg(lambda pair: pair[::-1], rng, is_band)
        assert measured == pytest.approx(180.0, abs=3.0)


def views(sky, missions, world, rng):
    mission = missions[the_paper().worlds[world].mission]
    catalog = sky.run_catalog(mission, EPOCH)
    return mission, list(draw_zone(the_paper().worlds[world], 0, mission, catalog, rng))


def outcomes(view, run, mission, sky, tolerance_deg=10.0, **tests):
    batch = batch_of(view, run, mission, "starid")
    options = structs.replace(
        batch.options,
        tests={**batch.options.tests, **tests},
        tolerances={"fov_rotation_deg": tolerance_deg},
    )
    found = acquire(structs.replace(batch, options=options), mission, sky)
    return found.trackers[0].identification


@pytest.mark.parametrize("world", ["cap_forest", "band_desert"])
def test_both_tests_leave_nominal_stars_identified(sky, missions, rng, world):
    mission, seen = views(sky, missions, world, rng)
    nominal = next(run for run in the_paper().runs if run.world == world)
    correct = total = 0
    for view in seen:
        # Nothing else is on: the rotation alone tells the order of a pair.
        found = outcomes(
            view, nominal, mission, sky,
            fov_rotation=True, match_groups=True, cross_product=False, magnitude=False,
        )  # fmt: skip
        total += len(view.star)
        correct += int(np.sum(found.star == view.star))
    # Nominally 1 star in 500 is not identified; ten times that would be seen here.
    assert total >= 30
    assert correct >= 0.9 * total


def test_a_tracker_rolled_beyond_the_tolerance_is_not_identified(sky, missions, rng):
    mission, seen = views(sky, missions, "cap_forest", rng)
    rolled = next(r for r in the_paper().runs if r.run == "psi30")
    correct, total = {20.0: 0, 40.0: 0}, 0
    for view in seen:
        total += len(view.star)
        for tolerance_deg in correct:
            found = outcomes(view, rolled, mission, sky, tolerance_deg, fov_rotation=True)
            correct[tolerance_deg] += int(np.sum(found.star == view.star))
    assert correct[40.0] >= 0.9 * total
    # Chance pairs of which one star is right still vote for it.
    assert correct[20.0] <= 0.3 * total


def test_the_turn_of_an_attitude_is_that_of_its_pairs(rng):
    attitude = np.eye(3)
    off = turned_by(attitude, np.radians(7.0) * BORESIGHT)
    assert rotation_deg(lambda pair: pair @ off, rng) == pytest.approx(7.0, abs=1e-6)


def test_a_batch_asks_for_both_tests_by_name():
    asked = {
        "tests": {"fov_rotation": True, "match_groups": True},
        "tolerances": {"fov_rotation_deg": 2.5},
    }
    options = OptionsIn.model_validate(asked).to_options()
    assert options.tests == {"fov_rotation": True, "match_groups": True}
    assert options.tolerances == {"fov_rotation_deg": 2.5}


def test_where_the_roll_is_unknown_no_rotation_is_compared(sky, missions, rng):
    mission, seen = views(sky, missions, "cap_forest", rng)
    run = next(run for run in the_paper().runs if run.world == "cap_forest")
    batch = batch_of(seen[0], run, mission, "starid")
    options = structs.replace(batch.options, tests={"fov_rotation": True})
    known = structs.replace(batch, options=options)
    unknown = structs.replace(known, a_priori=BoresightPrior(265.6, -28.917))
    assert choices_of(known, mission).tests.fov_rotation is True
    assert choices_of(unknown, mission).tests.fov_rotation is False

"""An object, two planets and three hot pixels among stars are found, and nothing else is."""

from collections import Counter

import numpy as np
import pytest

from service.features.tracks.finding import figures, find_tracks
from service.features.tracks.kernels import compile_kernels, count_seeds, extend, try_seeds
from service.features.tracks.linking import Batches, Points
from service.times import parse_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, to_ra_dec, unit
from tests.chance import at_least, at_most
from tests.features.tracks.drawn import (
    BATCHES,
    CADENCE_S,
    OBJECT_MAG,
    acquired,
    conjunctions,
    draw,
    gathered,
)
from tests.scale import size

STRETCHES, FEW_STRETCHES = 300, 3
EACH = {"object": 1, "planet": 2, "hot": 3}
"""What there is in a stretch."""


def truth_at(drawn, time_s):
    """The object's direction and rate in rad/s at a time after the first batch."""
    speed = np.linalg.norm(drawn.rate_arcsec_per_s) / ARCSEC_PER_RADIAN
    way = unit(drawn.rate_arcsec_per_s)
    angle = speed * (time_s - drawn.middle_s)
    place = np.cos(angle) * drawn.place + np.sin(angle) * way
    return place, speed * (np.cos(angle) * way - np.sin(angle) * drawn.place)


@pytest.mark.torture
def test_objects_planets_and_hot_pixels_are_found_and_nothing_else(missions, sky, rng, figures):
    mission, found, false, pulls = missions["XTE"], Counter(), 0, []
    wrong, lost, moments = 0, 0, conjunctions(rng, size(STRETCHES, FEW_STRETCHES))
    for moment in moments:
        drawn = draw(mission, sky, moment, rng)
        acquisitions = acquired(drawn.with_points, mission, sky)
        taken = gathered(acquisitions, mission)
        points = taken.points
        solved = [k for k, each in enumerate(acquisitions) if each.solution is not None]
        for track in find_tracks(points, taken.batches):
            what = Counter(
                drawn.where[solved[points.batch[k]]][points.number[k]] for k in track.own
            )
            name, count = what.most_common(1)[0]
            expected = {"object": "moving", "hot": "fixed_on_detector"}.get(name, "planet")
            is_true = name is not None and track.kind == expected and count >= 0.9 * what.total()
            is_true &= track.planet == (name if expected == "planet" else None)
            found[name if expected != "planet" else "planet"] += is_true
            false += not is_true
            if is_true and name == "object":
                _, rate = truth_at(drawn, track.motion.time_s)
                error = track.motion.axes @ (track.motion.rate - rate)
                sigma = np.sqrt(np.diagonal(track.motion.covariance)[2:])
                pulls.extend(np.abs(error / sigma))
        changed, missing = harmed(drawn, acquisitions, acquired(drawn.stars_only, mission, sky))
        wrong, lost = wrong + changed, lost + missing
    count = len(moments)
    figures(
        stretches=count,
        objects=found["object"],
        planets=found["planet"],
        hot_pixels=found["hot"],
        false=false,
        rates_within_3_sigma=float(np.mean(np.array(pulls) < 3.0)),
        stars_lost=lost,
    )
    assert false == 0
    assert wrong == 0
    # Of 1,000 rates 997 are within three sigmas where the sigmas are right.
    assert np.sum(np.array(pulls) >= 3.0) <= at_most(len(pulls), 0.0027)
    if count >= STRETCHES:
        for name, each in EACH.items():
            assert found[name] >= 0.95 * each * count, name
        assert lost <= 0.005 * count * BATCHES
        return
    # The same of a few, where chance counts: of one kind little more than that it is found.
    for name, each in EACH.items():
        assert found[name] >= max(1, at_least(each * count, 0.95)), name
    assert found.total() >= at_least(count * sum(EACH.values()), 0.95)
    assert lost <= at_most(count * BATCHES, 0.005)


def harmed(drawn, with_points, without):
    """Stars that are another's with the points than without them, and stars that are lost."""
    wrong = lost = 0
    for what, one, other in zip(drawn.where, with_points, without, strict=True):
        found = one.trackers[0].identification
        place = [k for k, each in enumerate(what) if each is None]
        sent = one.batch.observations[0].vector
        alone = other.batch.observations[0].vector
        order = [int(np.argmax(sent @ each)) for each in alone]
        assert sorted(order) == place
        was = other.trackers[0].identification.star
        now = found.star[order]
        wrong += int(np.sum((now >= 0) & (was >= 0) & (now != was)))
        lost += int(np.sum((now < 0) & (was >= 0)))
        # And no point is taken for a star.
        wrong += int(
            np.sum(found.star[[k for k, each in enumerate(what) if each is not None]] >= 0)
        )
    return wrong, lost


def made(rng, places, *, on_detector=None, sigma=1e-5, cadence_s=10.0):
    """Points of one tracker at directions (batches, n, 3), and their batches."""
    count, each = places.shape[:2]
    flat = places.reshape(-1, 3)
    noisy = unit(flat + rng.normal(0.0, sigma, flat.shape))
    seen = flat if on_detector is None else on_detector.reshape(-1, 3)
    batch = np.repeat(np.arange(count), each)
    points = Points(
        trackers=("T",),
        field_sr=np.array([0.0153]),
        batch=batch,
        tracker=np.zeros(len(flat), np.int64),
        number=np.tile(np.arange(each), count),
        time_s=batch * cadence_s,
        direction=noisy,
        covariance=sigma**2 * (np.eye(3) - noisy[:, :, None] * noisy[:, None, :]),
        place=unit(seen + rng.normal(0.0, sigma, flat.shape)),
        sigma_rad=np.full(len(flat), sigma),
        magnitude_mag=np.full(len(flat), 5.0),
    )
    start = parse_utc("2001-02-03T00:00:00Z")
    times = tuple(shifted(start, k * cadence_s) for k in range(count))
    return points, Batches(times, np.full((count, 3), np.nan))


def anywhere(rng, count, each):
    """Directions within 4 degrees of an axis away from the ecliptic."""
    off = rng.normal(size=(count, each, 2))
    off *= (np.radians(4.0) * np.sqrt(rng.random((count, each))) / np.linalg.norm(off, axis=2))[
        :, :, None
    ]
    return unit(np.concatenate([off, np.ones((count, each, 1))], axis=2))


def test_every_use_finds_what_was_compiled_at_the_start(rng):
    compile_kernels()
    turn = np.arange(40)[:, None] * np.array([[1e-4, 0.0]])
    moved = unit(np.concatenate([turn, np.ones((40, 1))], axis=1))[:, None]
    hot = np.tile([0.0, 0.0, 1.0], (40, 1, 1))
    assert find_tracks(*made(rng, moved))
    assert find_tracks(*made(rng, moved, on_detector=hot))
    # Another kind of array would be compiled for itself.
    assert [len(each.overloads) for each in (count_seeds, try_seeds, extend)] == [1, 1, 1]


def test_points_without_order_make_no_track(rng):
    for _ in range(20):
        assert find_tracks(*made(rng, anywhere(rng, 60, 6))) == []


def test_an_object_among_points_without_order_is_found(rng):
    for _ in range(10):
        places = anywhere(rng, 40, 6)
        step = np.arange(40)[:, None] * np.array([[1e-4, 5e-5]])
        places[:, 0] = unit(np.concatenate([step, np.ones((40, 1))], axis=1))
        (track,) = find_tracks(*made(rng, places))
        assert track.kind == "moving"
        assert len(track.own) >= 38
        assert set(made(rng, places)[0].number[track.own]) == {0}


def test_a_star_that_is_in_no_catalog_is_fixed_on_the_sky(rng):
    places = np.tile(anywhere(rng, 1, 1), (30, 1, 1))
    moved = unit(places + np.arange(30)[:, None, None] * np.array([2e-4, 0.0, 0.0]))
    (track,) = find_tracks(*made(rng, places, on_detector=moved))
    assert track.kind == "fixed_on_sky"


def test_what_rests_on_sky_and_detector_is_only_called_fixed(rng):
    places = np.tile(anywhere(rng, 1, 1), (30, 1, 1))
    (track,) = find_tracks(*made(rng, places))
    assert track.kind == "fixed"


def test_a_hot_pixel_stays_one_though_an_object_crosses_it(rng):
    turn = np.arange(40)[:, None] * np.array([[1e-4, 0.0]])
    hot = np.tile([0.0, 0.0, 1.0], (40, 1))
    # The sky passes the detector; the object meets the pixel in the middle.
    on_sky = unit(np.concatenate([turn, np.ones((40, 1))], axis=1))
    object_on_detector = unit(
        np.concatenate([(np.arange(40)[:, None] - 20) * [[3e-5, 2e-4]], np.ones((40, 1))], axis=1)
    )
    object_on_sky = unit(object_on_detector + np.concatenate([turn, np.zeros((40, 1))], axis=1))
    found = find_tracks(
        *made(
            rng,
            np.stack([on_sky, object_on_sky], axis=1),
            on_detector=np.stack([hot, object_on_detector], axis=1),
        )
    )
    assert sorted(each.kind for each in found) == ["fixed_on_detector", "moving"]


def test_the_figures_of_a_track_are_those_of_its_motion(rng):
    step = np.arange(40)[:, None] * np.array([[1e-4, 5e-5]])
    places = unit(np.concatenate([step + 0.3, np.ones((40, 1))], axis=1))[:, None]
    points, batches = made(rng, places)
    (track,) = find_tracks(points, batches)
    numbers = figures_of(track, points)
    ra, dec = to_ra_dec(places[[19, 20], 0])
    assert numbers.ra_deg == pytest.approx(ra.mean(), abs=0.01)
    assert numbers.dec_deg == pytest.approx(dec.mean(), abs=0.01)
    rate_ra = (ra[1] - ra[0]) * 360.0 * np.cos(np.radians(dec.mean()))
    assert numbers.rate_ra_arcsec_per_s == pytest.approx(rate_ra, rel=0.01)
    assert numbers.rate_dec_arcsec_per_s == pytest.approx((dec[1] - dec[0]) * 360.0, rel=0.01)
    # A point's sigma is 2.06 arcsec: over the root of 40, and over that of the sum of t^2.
    assert numbers.sigma_ra_arcsec == pytest.approx(2.06 / np.sqrt(40), rel=0.02)
    spread = np.sqrt(np.sum((np.arange(40) - 19.5) ** 2)) * CADENCE_S
    assert numbers.sigma_rate_arcsec_per_s == pytest.approx(2.06 / spread, rel=0.02)
    assert numbers.magnitude_mag == OBJECT_MAG
    assert numbers.sigma_magnitude_mag == 0.0


figures_of = figures

"""Verified identification: what it claims is so, and each part agrees with an outside authority."""

import math
from dataclasses import replace

import erfa
import numpy as np
import pytest
from msgspec import structs
from scipy.stats import multivariate_normal

from service.acquire import acquire
from service.identify.attitude_from_matches import aberrate
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import fit_match, weigh, weigh_without
from service.identify.hypotheses.scene import ObservedStars, ZoneStars, scratch_for
from service.identify.hypotheses.search import _choose_seeds
from service.identify.hypotheses.verified import identify_verified
from service.identify.identification import Outcome
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import load_missions
from service.sky.geometry.star_hashes import build_star_buckets, build_star_voxels, nearest
from service.vectors import ARCSEC_PER_RADIAN, from_ra_dec, read_only, unit
from studies.paper_1994.printed import the_paper
from studies.paper_1994.views import EPOCH, batch_of, draw_zone
from tests.chance import at_least, at_most
from tests.reference.compare import zone_searched
from tests.reference.sightings import identified as identified_alone
from tests.reference.sightings import scene_of as scene_of_sighting
from tests.scale import draws

VIEWS = draws(40, 60)


def identified(sky, rng, table, run_name, views=VIEWS, spoil=None):
    """Views of one run of the paper: per view the identification and the true rows, -1 spurious."""
    paper = the_paper()
    run = next(run for run in paper.runs_of([table]) if run.run == run_name)
    world = paper.worlds[run.world]
    mission = load_missions()[world.mission]
    catalog = sky.run_catalog(mission, EPOCH)
    found, number = [], 0
    while len(found) < views:
        for view in draw_zone(world, number, mission, catalog, rng):
            if len(view.star) < 5:
                continue
            batch, truth = batch_of(view, run, mission, "verified"), view.star.copy()
            if spoil is not None:
                batch = spoil(batch, truth, mission, rng)
            found.append((acquire(batch, mission, sky).trackers[0].identification, truth))
        number += 1
    return found


def assert_named(found, least=0.96, most_spurious=1.0):
    """Hold the shares of real stars that are right and of spurious ones that are named.

    A star is named from a probability of .999: one of 1,000 may be another one.
    """
    right = wrong = real = named = spurious = 0
    for identification, truth in found:
        unique = identification.outcome == Outcome.UNIQUE
        is_real = truth >= 0
        real += is_real.sum()
        spurious += (~is_real).sum()
        right += (unique & is_real & (identification.star == truth)).sum()
        wrong += (unique & is_real & (identification.star != truth)).sum()
        named += (unique & ~is_real).sum()
    assert wrong <= at_most(int(real), 0.001)
    assert right >= at_least(int(real), least)
    assert named <= at_most(int(spurious), most_spurious)


@pytest.mark.parametrize(
    ("table", "run"),
    [
        *((2, "psi100"), (3, "5,5,270"), (4, "sm1.0"), (5, "sm1.0"), (9, "phi100")),
        pytest.param(7, "so12", marks=pytest.mark.slow),
    ],
)
def test_where_votes_fail_it_names_the_stars_and_none_wrongly(sky, rng, table, run):
    assert_named(identified(sky, rng, table, run))


@pytest.mark.parametrize(("table", "run"), [(2, "phi100"), (7, "so12"), (10, "nominal")])
def test_stopping_early_names_what_the_exhaustive_search_names(sky, rng, table, run, monkeypatch):
    """And where they differ, only in how sure they are: no star is named differently."""
    sightings = []

    def both(sighting):
        sightings.append(sighting)
        return identified_alone(identify_verified, sighting, weighs=True)

    entry = replace(IDENTIFIERS["verified"], function=both, by_columns=False)
    monkeypatch.setitem(IDENTIFIERS, "verified", entry)
    identified(sky, rng, table, run, views=30)
    same = 0
    for sighting in sightings:
        early, whole = (
            identified_alone(identify_verified, sighting, weighs=True, exhaustive=exhaustive)
            for exhaustive in (False, True)
        )
        sure = early.unique & whole.unique
        assert np.array_equal(early.star[sure], whole.star[sure])
        same += sure.mean()
    assert same / len(sightings) > 0.97


@pytest.mark.slow
def test_leaving_a_star_out_of_a_fit_is_fitting_without_it(sky, rng, monkeypatch):
    """The hypothesis less one star: taken away from the fit, and fitted anew."""
    caught = []

    def caught_by(sighting):
        identification = identified_alone(identify_verified, sighting, weighs=True)
        caught.append((sighting, identification))
        return identification

    entry = replace(IDENTIFIERS["verified"], function=caught_by, by_columns=False)
    monkeypatch.setitem(IDENTIFIERS, "verified", entry)
    identified(sky, rng, 8, "nominal", views=5)
    assert len(caught) >= 5
    for sighting, identification in caught:
        if not identification.unique.all():
            continue
        seen, stars, _ = scene_of_sighting(sighting)
        rows = np.searchsorted(sighting.zone.star, identification.star).astype(np.int32)
        scratch = scratch_for(len(rows))
        _, square, _ = fit_match(seen, stars, rows, scratch, 2)
        for k in range(len(rows)):
            less = rows.copy()
            less[k] = -1
            quick = weigh_without(seen, stars, less, k, square, scratch)
            anew = weigh(seen, stars, less, scratch_for(len(rows)))
            assert quick == pytest.approx(anew, abs=0.01)


def test_two_hundred_and_fifty_stars_are_named_within_the_bound(sky, rng):
    """As many as a batch may have of one tracker, all real; most are outside the zone.

    Most of the twelve brightest are as well, whose pairs were all that was searched once.
    """
    mission = load_missions()["SOHO"]
    catalog = sky.run_catalog(mission, EPOCH)
    run = the_paper().runs_of([3])[0]
    world = replace(the_paper().worlds["band_forest"], views=3)
    named = []
    for view in draw_zone(world, 0, mission, catalog, rng, 12):
        near = np.argsort(-(catalog.direction @ unit(view.direction.mean(axis=0))))[:250]
        many = replace(
            view,
            star=near,
            direction=catalog.direction[near],
            magnitude_mag=catalog.magnitude_mag[near],
            radius=rng.normal(size=250),
            bearing_rad=rng.uniform(0.0, math.tau, 250),
            share=rng.uniform(size=250),
        )
        found = acquire(batch_of(many, run, mission, "verified"), mission, sky)
        identification = found.trackers[0].identification
        assert not identification.bounded
        right = identification.star == near
        assert not (identification.unique & ~right).any()
        # The identifier leaves stars near the catalog's limit unmatched: one that the catalog
        # lacks may be as faint.
        expected = np.isin(near, zone_searched(found, sky).star) & (many.magnitude_mag < 7.5)
        named.append(right[expected].mean())
    assert min(named) > 0.9


def test_the_seeds_are_the_brightest_stars_that_the_zone_may_hold(rng):
    """Against sorting them; stars without a magnitude come last, all are seeds of a small field."""
    stars = scene_of(unit(rng.normal(size=(50, 3))))._replace(least=0.2, most=0.6)
    for n in (5, 12, 13, 40, 250):
        direction = unit(rng.normal([0.0, 0.0, 1.5], 1.0, (n, 3)))
        magnitude = np.where(rng.uniform(size=n) < 0.2, np.nan, rng.uniform(2.0, 8.0, n))
        ones, zeros = np.ones(n), np.zeros(3)
        observed = ObservedStars(direction, magnitude, ones, ones, 1.0, zeros, 0, zeros)
        seeds = scratch_for(n).seeds
        _choose_seeds(observed, stars, seeds)
        polar = np.arccos(direction[:, 2])
        outside = (polar < 0.2) | (polar > 0.6)
        unknown = np.isnan(magnitude)
        wanted = np.lexsort((np.arange(n), np.where(unknown, 0.0, magnitude), unknown, outside))
        assert seeds.tolist() == sorted(wanted[:12].tolist())


def test_what_is_not_unique_has_a_ranked_list(sky, rng):
    """Probabilities fall and add up to no more than one; the first is right more often than not."""
    first = listed = 0
    for identification, truth in identified(sky, rng, 3, "0.1,0.1,0.1", spoil=spurious(3)):
        for k in np.flatnonzero(~identification.unique):
            likely = identification.rival_probability[k]
            assert len(likely) == len(identification.rivals[k])
            assert list(likely) == sorted(likely, reverse=True)
            assert sum(likely) < 1.0 + 1e-9
            if truth[k] >= 0:
                listed += 1
                first += identification.rivals[k][:1] == (truth[k],)
    assert first / listed > 0.6


def spurious(count):
    """Put `count` of the stars anywhere in the field of view."""

    def spoil(batch, truth, mission, rng):
        tracker = mission.trackers[0]
        stars = batch.observations[0]
        vector = stars.vector.copy()
        centre = unit(vector.mean(axis=0))
        radius = math.radians(tracker.field_of_view_radius_deg)
        for k in rng.choice(len(truth), count, replace=False):
            away = np.sqrt(rng.uniform()) * radius
            side = unit(np.cross(centre, rng.normal(size=3)))
            vector[k] = math.cos(away) * centre + math.sin(away) * side
            truth[k] = -1
        return structs.replace(batch, observations=(structs.replace(stars, vector=vector),))

    return spoil


@pytest.mark.parametrize("table", [2, 8])
def test_a_spurious_star_is_named_by_hardly_any_and_spoils_no_other(sky, rng, table):
    run = the_paper().runs_of([table])[0].run
    assert_named(identified(sky, rng, table, run, spoil=spurious(1)), most_spurious=0.05)


def test_two_real_stars_of_five_are_named_where_the_a_priori_attitude_is_close(sky, rng):
    """No mirror image of the field, whose boresight would lie elsewhere, keeps their names back."""
    views = draws(80, 200)
    drawn = identified(sky, rng, 2, the_paper().runs_of([2])[0].run, views, spurious(3))
    assert_named(drawn, least=0.985, most_spurious=0.01)


def test_the_weight_of_magnitudes_is_that_of_normal_distributions(rng):
    """The closed form against scipy's multivariate normal, scale by scale."""
    difference = rng.normal(0.3, 0.4, 5)
    total = 0.0
    for t in evidence.MAGNITUDE_SCALES_MAG:
        for variance in (0.0, evidence.OFFSET_SIGMA_MAG**2):
            covariance = t * t * np.eye(5) + variance
            total += multivariate_normal.pdf(difference, np.zeros(5), covariance)
    total /= 2 * len(evidence.MAGNITUDE_SCALES_MAG)
    ours = evidence.log_magnitudes(5, difference.sum(), (difference**2).sum())
    assert ours == pytest.approx(math.log(total), abs=1e-9)


def test_the_prior_of_the_attitude_is_a_density():
    """Over all rotations, and over all directions and rolls, it integrates to one."""
    angle = np.concatenate([[0.0], np.geomspace(1e-7, math.pi, 200_001)])
    rotation = [evidence.log_prior(a, evidence.PRIOR_ROTATION) for a in angle[::10]]
    measure = 8.0 * math.pi * (1.0 - np.cos(angle[::10]))
    assert np.trapezoid(np.exp(rotation) * measure, angle[::10]) == pytest.approx(1.0, abs=0.05)
    tilt = [evidence.log_prior(a, evidence.PRIOR_DIRECTION) for a in angle[::10]]
    measure = 2.0 * math.pi * np.sin(angle[::10]) * 2.0 * math.pi
    assert np.trapezoid(np.exp(tilt) * measure, angle[::10]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("radius_deg", [0.0, 90.0])
def test_the_prior_of_an_axis_on_a_circle_is_a_density(radius_deg):
    """About a point, and about a great circle, it integrates to one over places and rolls."""
    radius = math.radians(radius_deg)
    off = np.concatenate([[0.0], np.geomspace(1e-7, math.pi - radius, 20_001)])
    density = np.exp([evidence.log_prior_on_circle(each, radius) for each in off])
    measure = 2.0 * math.pi * np.sin(radius + off) * 2.0 * math.pi
    sides = 1.0 if radius == 0.0 else 2.0
    total = sides * np.trapezoid(density * measure, off)
    assert total == pytest.approx(1.0, abs=0.05)


def scene_of(direction):
    """Zone stars all over the sky as the kernels take them."""
    direction = read_only(direction)
    grid = build_star_buckets(direction)
    return ZoneStars(
        direction, np.zeros(len(direction)), grid.start, grid.rows, grid.direction,
        build_star_voxels(direction), np.array([0.0, 0.0, 1.0]), 0.0, math.pi,
        np.full(len(direction), -1.0), 0.0,
    )  # fmt: skip


def look(grid, place):
    """The two stars of a grid nearest to a direction, within 0.009 rad."""
    none = np.empty(0, np.int32)
    return nearest(*place, 0.009, grid.start, grid.rows, grid.direction, none, 0)


def test_the_star_buckets_find_what_looking_at_every_star_finds(rng):
    """On the whole sphere, edges and corners of the cube's faces included."""
    direction = unit(rng.normal(size=(20_000, 3)))
    grid = build_star_buckets(direction)
    corners = unit(np.array([[1, 1, 1], [1, 1, 0], [-1, 1, 1e-3], [0, -1, 1], [1, 0, 0]]))
    places = np.concatenate([corners, unit(rng.normal(size=(500, 3)))])
    for place in places:
        found = look(grid, place)
        chord = np.linalg.norm(direction - place, axis=1)
        order = np.argsort(chord)[:2]
        expected = [int(k) if chord[k] < 2 * math.sin(0.0045) else -1 for k in order]
        assert list(found) == expected


def test_the_fit_is_wahba_s_optimum(rng):
    """The attitude of a hypothesis against the singular value decomposition."""
    direction = from_ra_dec(rng.uniform(10, 18, 6), rng.uniform(-4, 4, 6))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    sigma = rng.uniform(1.0, 4.0, 6) / ARCSEC_PER_RADIAN
    observed = unit(direction @ turn.T + sigma[:, None] * rng.normal(size=(6, 3)))
    seen = ObservedStars(
        observed, np.zeros(6), sigma, (sigma.min() / sigma) ** 2, sigma.min(), np.zeros(3), 0,
        np.array([1.0, 0.0, 0.0]),
    )  # fmt: skip
    scratch = scratch_for(6)
    match = np.arange(6, dtype=np.int32)
    assert fit_match(seen, scene_of(direction), match, scratch, 2)[0] == 6
    u, _, vt = np.linalg.svd((seen.weight[:, None] * observed).T @ direction)
    best = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    assert np.abs(scratch.t - best).max() * ARCSEC_PER_RADIAN < 1e-4


def test_the_compiled_aberration_is_erfa_s(rng):
    """For any direction and a velocity of Earth's size, to the last digits."""
    velocity = rng.normal(size=3) * 7e-5
    directions = unit(rng.normal(size=(200, 3)))
    expected = erfa.ab(directions, velocity, 0.99, math.sqrt(1.0 - velocity @ velocity))
    ours = np.empty_like(directions)
    for direction, apparent in zip(directions, ours, strict=True):
        aberrate(direction, velocity, 0.99, apparent)
    assert np.abs(ours - expected).max() < 1e-15


def test_a_look_beside_all_stars_of_a_face_finds_nothing(rng):
    """A cap's stars span a corner of a face; looks all over the sky stay within the arrays."""
    direction = from_ra_dec(rng.uniform(20, 25, 40), rng.uniform(30, 35, 40))
    grid = build_star_buckets(direction)
    for place in unit(rng.normal(size=(3000, 3))):
        found = look(grid, place)
        chord = np.linalg.norm(direction - place, axis=1)
        expected = int(np.argmin(chord)) if chord.min() < 2 * math.sin(0.0045) else -1
        assert found[0] == expected

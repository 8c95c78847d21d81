"""Sample telemetry: the physics is real, the truth is true, and the seed decides everything."""

import json
from collections import Counter
from functools import cache
from itertools import pairwise

import erfa
import numpy as np
import pytest

from service.errors import BadInput
from service.missions.mission import Calibration
from service.observations.calibrate import correct
from service.observations.focal_plane import measured_angles_deg, tracker_vectors
from service.observations.schema import submission_from_json
from service.simulate.motion import HaloOrbit, orbit_of
from service.simulate.sightings import BatchScene, Seen, anywhere, real_sky, shaken
from service.simulate.stretches import NO_TROUBLES, Pass, Stretch, Trouble, Troubles
from service.simulate.telemetry import draw_pass, read_objects, truth_path, write_pass
from service.sky.ephemeris import apparent, observer_velocity, sun_direction
from service.times import parse_utc, shifted
from service.vectors import ARCSEC_PER_RADIAN, angle_between_deg, matrix_from_quaternion, unit
from tests.scale import draws

SERIOUS = Troubles(Trouble(0.2), Trouble(0.2, 2), Trouble(0.2, 0.5), Trouble(0.2, 12.0))
ALL = ("XTE", "SWAS", "SOHO")


def drawn(missions, sky, name, seed, batches=60, **wanted):
    return list(draw_pass(missions[name], sky, Pass(batches, seed, **wanted)))


def batch_of(each):
    return submission_from_json(json.dumps(each.batch)).batch


def true_stars(each):
    return [star for tracker in each.truth["observations"] for star in tracker["stars"]]


def place_by_erfa(catalog, row, time, position_km):
    """Where one star stands from the spacecraft, by ERFA's own routine: motion and parallax."""
    dec = np.radians(catalog.dec_deg[row])
    mas = np.radians(1.0 / 3.6e6)
    _, barycentric = erfa.epv00(*time.tt)
    return erfa.pmpx(
        np.radians(catalog.ra_deg[row]),
        dec,
        catalog.pm_ra_mas_per_year[row] * mas / np.cos(dec),
        catalog.pm_dec_mas_per_year[row] * mas,
        max(np.nan_to_num(catalog.parallax_mas[row]), 0.0) / 1000.0,
        0.0,
        time.julian_year - 2000.0,
        barycentric["p"] + np.asarray(position_km) / (erfa.DAU / 1000.0),
    )


@cache
def blend_of(catalog, leader, within_arcsec):
    """The rows that a tracker sees as one star: the leader with what is close to it and fainter."""
    apart = angle_between_deg(catalog.direction, catalog.direction[leader]) * 3600.0
    fainter = np.arange(len(catalog)) > leader
    taken = np.flatnonzero((apart <= within_arcsec) & fainter & ~catalog.light_elsewhere)
    return [leader, *taken.tolist()]


def motion_mas(catalog, row):
    return np.hypot(catalog.pm_ra_mas_per_year[row], catalog.pm_dec_mas_per_year[row])


def place(catalog, leader, within_arcsec, time, position_km):
    rows = blend_of(catalog, leader, within_arcsec)
    light = 10.0 ** (-0.4 * catalog.magnitude_v_mag[rows])
    seen = [place_by_erfa(catalog, row, time, position_km) for row in rows]
    return unit(light @ np.array(seen))


def misses_arcsec(each, missions, sky):
    """How far each real star was measured from where it really stands, on two axes."""
    batch, mission = batch_of(each), missions[each.batch["spacecraft"]]
    attitude = matrix_from_quaternion(each.truth["quaternion"])
    (corrected,) = correct(batch, mission)
    real = [k for k, star in enumerate(true_stars(each)) if star is not None]
    direction = np.array(
        [
            place(
                sky.catalog,
                sky.catalog.row_of(true_stars(each)[k]),
                mission.catalog.merge_within_arcsec,
                batch.time,
                each.batch["position_km"],
            )
            for k in real
        ]
    ).reshape(-1, 3)
    if batch.aberration != "applied_upstream":
        velocity = observer_velocity(batch.time, batch.velocity_km_per_s)
        direction = apparent(direction, velocity, batch.time)
    difference = corrected.direction_body[real] - direction @ attitude.T
    tracker = mission.trackers[0].body_from_tracker
    return (difference @ tracker)[:, :2] * ARCSEC_PER_RADIAN


@pytest.mark.parametrize("name", ALL)
def test_the_same_arguments_give_the_same_pass_and_another_seed_another(missions, sky, name, seed):
    first = drawn(missions, sky, name, seed, 12)
    assert first == drawn(missions, sky, name, seed, 12)
    other = drawn(missions, sky, name, seed + 1, 12)
    assert all(
        a.batch["observations"] != b.batch["observations"]
        for a, b in zip(first, other, strict=True)
    )


def test_sisters_with_the_same_seed_see_different_skies(missions, sky, seed):
    xte, swas = (drawn(missions, sky, name, seed, 12) for name in ("XTE", "SWAS"))
    assert not {s for e in xte for s in true_stars(e)} <= {s for e in swas for s in true_stars(e)}


@pytest.mark.parametrize("name", ALL)
def test_every_batch_is_one_that_the_service_takes(missions, sky, name, seed):
    for each in drawn(missions, sky, name, seed, prior="mixed", angles_share=0.5):
        batch = batch_of(each)
        assert batch.spacecraft == each.truth["spacecraft"] == name
        assert batch.batch == each.truth["batch"]
        (corrected,) = correct(batch, missions[name])
        assert 1 <= len(corrected.magnitude_mag) <= 5
        # Noise alone may carry a star over the edge.
        beyond = corrected.outside_field_of_view
        assert beyond.sum() <= 1


def test_batches_follow_each_other_by_the_cadence(missions, sky):
    each = drawn(missions, sky, "XTE", 1, 4, start="1998-12-31T23:59:59.25Z", cadence_s=1.5)
    assert [one.batch["time"] for one in each] == [
        "1998-12-31T23:59:59.250Z",
        "1998-12-31T23:59:60.750Z",
        "1999-01-01T00:00:01.250Z",
        "1999-01-01T00:00:02.750Z",
    ]
    assert [one.batch["batch"] for one in each][::3] == ["1998-365-0001", "1999-001-0004"]


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("aberration", ["to_correct", "applied_upstream", "ignore"])
def test_stars_miss_their_place_by_the_trackers_noise_alone(missions, sky, name, aberration, seed):
    """Aberration, turning and the stars' own times are all in the measured directions."""
    passes = drawn(missions, sky, name, seed, draws(60, 150), aberration={aberration: 1.0})
    quiet = [one for one in passes if one.truth["stretch"] != "position_error"]
    misses = np.concatenate([misses_arcsec(one, missions, sky) for one in quiet])
    sigma = missions[name].trackers[0].sigma_arcsec
    # One sigma of the spread of n draws is sigma / sqrt(2 n).
    assert misses.std(axis=0) == pytest.approx([sigma, sigma], rel=5 / np.sqrt(2 * len(misses)))
    assert misses.mean(axis=0) == pytest.approx([0, 0], abs=5 * sigma / np.sqrt(len(misses)))


@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_stars_stand_where_erfa_has_them_at_that_very_time(missions, sky, name, rng):
    mission, time = missions[name], parse_utc("1999-07-15T08:00:00Z")
    real = real_sky(sky.catalog, mission.catalog, sky.run_catalog(mission, time))
    position_km = np.array([7000.0, -1.2e6, 3e5])
    fastest = np.argsort(-motion_mas(sky.catalog, real.run.catalog_row))[:40]
    blends = np.flatnonzero(np.diff(real.first) > 1)
    stars = np.concatenate([fastest, rng.choice(blends, 20), rng.integers(0, len(real.run), 40)])
    seen = real.directions(stars, time, position_km)
    within = mission.catalog.merge_within_arcsec
    for star, direction in zip(stars, seen, strict=True):
        leader = int(real.run.catalog_row[star])
        expected = place(sky.catalog, leader, within, time, position_km)
        # ERFA counts the light's way across Earth's orbit, too: 8 minutes of proper motion.
        assert angle_between_deg(direction, expected) * 3600.0 < 1e-3
    assert real.magnitude_mag == pytest.approx(real.run.magnitude_mag, abs=1e-12)
    # The service's own directions are off by half a year of motion and by the parallax.
    left = angle_between_deg(seen, real.run.direction[stars]) * 3600.0
    assert 1.5 < left.max() < 6.0


def test_a_star_shifts_with_the_year_and_two_that_are_close_are_one(missions, sky):
    """Alpha Centauri: A and B are one star of V -0.3, with the nearest parallax, 0.742 arcsec."""
    mission, start = missions["XTE"], parse_utc("1999-02-20T00:00:00Z")
    real = real_sky(sky.catalog, mission.catalog, sky.run_catalog(mission, start))
    star = np.array([real.run.star_id.index("HIP 71683")])
    assert real.magnitude_mag[star] == pytest.approx([-0.28], abs=0.03)
    halves = [shifted(start, half * 182.625 * 86400.0) for half in range(3)]
    before, between, after = (real.directions(star, time, np.zeros(3))[0] for time in halves)
    # Even motion cancels; the Sun stands at right angles to the star at all three times.
    swing_arcsec = np.linalg.norm(before - 2.0 * between + after) * ARCSEC_PER_RADIAN
    assert swing_arcsec == pytest.approx(4 * 0.742, rel=0.05)


class TailFirst(np.random.Generator):
    """Draws as numpy does, but the first normal deviates lie so far out as is never seen."""

    extremes = ((9.0, 0.5, -7.0, -0.5), (-6.1, 6.1))

    def __init__(self):
        super().__init__(np.random.PCG64(1))
        self.left = [np.array(each) for each in self.extremes]

    def normal(self, loc=0.0, scale=1.0, size=None):
        fits = self.left and size == len(self.left[0]) and np.isscalar(scale) and scale == 1.0
        return self.left.pop(0) if fits else super().normal(loc, scale, size)


@pytest.mark.parametrize("kind", ["nominal", "magnitude_error"])
def test_magnitude_errors_end_at_six_sigmas(missions, sky, kind):
    """RCMAG, 0.6 mag for a tracker with 0.1: an error beyond it is drawn again."""
    mission, time = missions["XTE"], parse_utc("1999-07-15T08:00:00Z")
    (tracker,), rng = mission.trackers, TailFirst()
    real = real_sky(sky.catalog, mission.catalog, sky.run_catalog(mission, time))
    still, stretch = np.zeros(3), Stretch(kind, 0.5)
    scene = BatchScene(mission, real, time, still, still, "ignore", still, stretch, rng)
    direction = np.tile([0.0, 0.0, 1.0], (4, 1))
    seen = Seen(tracker, direction, np.zeros(4), np.full(4, 5.0), np.arange(4))
    sigma_mag = 0.5 if kind == "magnitude_error" else tracker.magnitude_sigma_mag
    errors = [star["magnitude"] - 5.0 for star in scene.measured(seen, as_angles=False)]
    assert not rng.left
    assert errors[1::2] == pytest.approx([0.5 * sigma_mag, -0.5 * sigma_mag], abs=1e-3)
    assert max(map(abs, errors)) <= 6.0 * sigma_mag


def test_the_turning_of_the_body_is_in_the_measurements(missions, sky, seed):
    """Without their times, the stars of a slew would miss by arcminutes."""
    passes = drawn(missions, sky, "XTE", seed, 60, troubles=NO_TROUBLES)
    slewing = max(passes, key=lambda one: np.linalg.norm(one.batch["body_rates_deg_per_s"]))
    assert np.linalg.norm(slewing.batch["body_rates_deg_per_s"]) > 0.02
    assert np.abs(misses_arcsec(slewing, missions, sky)).max() < 15
    for star in slewing.batch["observations"][0]["stars"]:
        star["time_offset_s"] = 0.0
    assert np.abs(misses_arcsec(slewing, missions, sky)).max() > 15


def test_the_rolls_of_a_pass_lead_all_along_the_band(missions, sky, seed):
    passes = drawn(missions, sky, "SOHO", seed, 300)
    assert passes[0].batch["time"].startswith("1996-04-16")
    boresight = missions["SOHO"].trackers[0].body_from_tracker[:, 2]
    seen = np.array(
        [matrix_from_quaternion(one.truth["quaternion"]).T @ boresight for one in passes]
    )
    # The band is a great circle: the plane of the sightings.
    _, _, plane = np.linalg.svd(seen)
    angle = np.degrees(np.arctan2(seen @ plane[1], seen @ plane[0]))
    assert len(set(np.floor(angle / 30.0))) >= 11


@pytest.mark.parametrize("name", ["XTE", "SWAS"])
def test_attitudes_follow_from_the_rates(missions, sky, name, seed):
    passes = drawn(missions, sky, name, seed, 40, cadence_s=30.0)
    attitudes = [matrix_from_quaternion(one.truth["quaternion"]) for one in passes]
    for one, before, after in zip(passes[:-1], attitudes[:-1], attitudes[1:], strict=True):
        turned = np.degrees(np.arccos(np.clip((np.trace(after @ before.T) - 1) / 2, -1, 1)))
        expected = 30.0 * np.linalg.norm(one.batch["body_rates_deg_per_s"])
        assert turned == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("name", ["XTE", "SWAS"])
def test_the_a_priori_error_of_a_cap_is_three_degrees_about_each_axis(missions, sky, name, seed):
    passes = drawn(missions, sky, name, seed, 300, troubles=NO_TROUBLES)
    errors = np.array([one.truth["a_priori_error_deg"] for one in passes])
    assert np.abs(errors).max() < 3.2
    # Uniform from -3 to 3 has a sigma of 1.73.
    assert errors.std(axis=0) == pytest.approx([np.sqrt(3)] * 3, rel=0.15)


def test_the_pole_of_a_band_is_tilted_by_a_tenth_of_a_degree_with_any_roll(missions, sky, seed):
    passes = drawn(missions, sky, "SOHO", seed, 300, troubles=NO_TROUBLES)
    tilts = np.array([one.truth["a_priori_axis_error_deg"] for one in passes])
    assert tilts.max() <= 0.1 + 1e-6
    assert tilts.mean() == pytest.approx(0.05, abs=0.01)
    rolls = np.abs([one.truth["a_priori_error_deg"][0] for one in passes])
    assert rolls.max() > 170
    assert np.mean(rolls < 90) == pytest.approx(0.5, abs=0.12)
    axis = missions["SOHO"].axis_body
    for one in passes[::20]:
        prior = matrix_from_quaternion(one.batch["a_priori"]["quaternion"])
        sun = sun_direction(parse_utc(one.batch["time"]), one.batch["position_km"])
        assert angle_between_deg(prior.T @ axis, sun) < 1e-6


@pytest.mark.parametrize("name", ALL)
def test_magnitudes_are_off_by_the_trackers_sigma_and_never_beyond_the_cut(
    missions, sky, name, seed
):
    passes = drawn(missions, sky, name, seed, 200, troubles=NO_TROUBLES)
    catalog = sky.run_catalog(missions[name], parse_utc(passes[0].batch["time"]))
    magnitude = dict(zip(catalog.star_id, catalog.magnitude_mag, strict=True))
    errors = np.array(
        [
            star["magnitude"] - magnitude[true]
            for one in passes
            for star, true in zip(
                one.batch["observations"][0]["stars"], true_stars(one), strict=True
            )
        ]
    )
    assert errors.std() == pytest.approx(0.1, rel=0.1)
    assert np.abs(errors).max() <= 0.6


def test_stretches_are_as_long_as_asked_and_apart(missions):
    for name in ALL:
        plan = Pass(50, troubles=SERIOUS).stretches(missions[name])
        kinds = [each.kind for each in plan]
        assert Counter(kinds) == dict.fromkeys(
            ("nominal", "attitude_error", "spurious", "magnitude_error", "position_error"), 10
        )
        assert kinds[0] == kinds[-1] == "nominal"
        changes = sum(a != b for a, b in pairwise(kinds))
        assert changes == 8
    whole = Pass(7, troubles=Troubles(Trouble(1.0), *(Trouble(),) * 3)).stretches(missions["XTE"])
    assert [each.kind for each in whole] == ["attitude_error"] * 7


@pytest.mark.parametrize(("name", "largest"), [("XTE", 10.0), ("SOHO", 5.0)])
def test_the_attitude_error_grows_through_its_stretch(missions, sky, name, largest, seed):
    passes = drawn(missions, sky, name, seed, 100, troubles=Troubles(Trouble(0.5)))
    grown = [
        one.truth["a_priori_axis_error_deg"]
        if name == "SOHO"
        else max(np.abs(one.truth["a_priori_error_deg"]))
        for one in passes
        if one.truth["stretch"] == "attitude_error"
    ]
    assert len(grown) == 50
    assert np.all(np.diff(grown) > 0)
    assert grown[-1] == pytest.approx(largest, rel=0.12)


def test_spurious_stars_have_no_true_star_and_lie_in_the_field(missions, sky, seed):
    passes = drawn(missions, sky, "XTE", seed, 50, troubles=SERIOUS)
    for one in passes:
        false = true_stars(one).count(None)
        expected = min(2, len(true_stars(one))) if one.truth["stretch"] == "spurious" else 0
        assert false == expected


def test_asked_for_directions_alone_the_prior_holds_no_roll(missions, sky, seed):
    (xte,) = drawn(missions, sky, "XTE", seed, 1, prior="direction", troubles=NO_TROUBLES)
    assert set(xte.batch["a_priori"]) == {"boresight"}
    assert xte.truth["a_priori_error_deg"] is None
    assert xte.truth["a_priori_axis_error_deg"] < 5
    (soho,) = drawn(missions, sky, "SOHO", seed, 1, prior="direction", troubles=NO_TROUBLES)
    assert soho.batch["a_priori"] == {"sun_pointed": True}
    kinds = {
        next(iter(one.batch["a_priori"])) for one in drawn(missions, sky, "XTE", 1, prior="mixed")
    }
    assert kinds == {"boresight", "quaternion"}


def test_shares_of_aberration_and_of_angles_are_kept(missions, sky, seed):
    shares = {"to_correct": 0.5, "applied_upstream": 0.3, "ignore": 0.2}
    passes = drawn(missions, sky, "XTE", seed, 300, aberration=shares, angles_share=0.4)
    words = Counter(one.batch["aberration"] for one in passes)
    for word, share in shares.items():
        assert words[word] / 300 == pytest.approx(share, abs=0.1)
    angles = sum("h_deg" in one.batch["observations"][0]["stars"][0] for one in passes)
    assert angles / 300 == pytest.approx(0.4, abs=0.1)


def test_low_orbits_and_the_halo_are_where_they_should_be(missions):
    start = parse_utc("1999-03-01T00:00:00Z")
    for name, speed in (("XTE", 7.57), ("SWAS", 7.54)):
        position, velocity = orbit_of(missions[name]).state(start)
        assert np.linalg.norm(velocity) == pytest.approx(speed, abs=0.02)
        assert position @ velocity == pytest.approx(0, abs=1e-6)
        after, _ = orbit_of(missions[name]).state(shifted(start, 1.0))
        # Over a second the path bends by half of 8 m/s2.
        assert after - position == pytest.approx(velocity, abs=0.005)
    times = [shifted(start, 86400.0 * day) for day in range(0, 178, 5)]
    off = [
        angle_between_deg(
            sun_direction(time, HaloOrbit().state(time)[0]), sun_direction(time, None)
        )
        for time in times
    ]
    assert 0.24 < max(off) < 0.27
    speeds = [np.linalg.norm(HaloOrbit().state(time)[1]) for time in times]
    assert 0.3 < max(speeds) < 0.7


def test_angles_are_what_the_calibration_turns_back_into_the_direction(rng):
    calibration = Calibration(
        scale=1.003, h_terms=((2, 0, 1e-3), (1, 2, -2e-4)), v_terms=((0, 0, 0.01), (0, 3, 1e-4))
    )
    direction = anywhere(np.radians(4.0), 50, rng)
    angles = measured_angles_deg(direction, calibration)
    assert tracker_vectors(angles, calibration) == pytest.approx(direction, abs=1e-13)
    assert not np.allclose(angles, measured_angles_deg(direction, Calibration()), atol=1e-3)


def test_noise_is_the_same_on_both_tangent_axes(rng):
    around = np.tile(rng.normal(size=3), (20_000, 1))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    moved = shaken(around, 1e-4, rng)
    covariance = np.cov((moved - around).T)
    expected = 1e-8 * (np.eye(3) - np.outer(around[0], around[0]))
    assert covariance == pytest.approx(expected, abs=6e-10)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"batches": 0}, "batches: must be at least 1 (got 0)"),
        ({"seed": -1}, "seed: must not be negative (got -1)"),
        ({"stars": 251}, "stars: must be from 1 to 250 (got 251)"),
        ({"cadence_s": float("nan")}, "cadence: must be above 0"),
        ({"aberration": {"to_correct": 0.4}}, "aberration: the shares must add up to 1 (got 0.4)"),
        ({"aberration": {"some": 1.0}}, "aberration: must be of to_correct, applied_upstream"),
        ({"troubles": Troubles(Trouble(0.8), Trouble(0.8))}, "must not be more than the pass"),
        ({"troubles": Troubles(Trouble(0.1, -3.0))}, "attitude_error: must be above 0, to 180"),
        ({"troubles": Troubles(magnitude_error=Trouble(0.1, float("nan")))}, "must be above 0"),
    ],
)
def test_a_pass_that_cannot_be_is_refused_by_name_and_value(wanted, message):
    with pytest.raises(BadInput) as refusal:
        Pass(**{"batches": 10, **wanted})
    assert message in str(refusal.value)


def test_a_start_that_is_no_time_is_refused(missions, sky):
    with pytest.raises(BadInput, match="start: must be UTC as"):
        drawn(missions, sky, "XTE", 1, 1, start="soon")


@pytest.mark.parametrize("name", ["pass.ndjson", "pass.csv"])
def test_a_file_and_its_truth_stand_side_by_side(missions, sky, tmp_path, name):
    passes = drawn(missions, sky, "SOHO", 1, 5)
    assert write_pass(passes, tmp_path / name) == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, "pass.truth.ndjson"]
    truths = list(read_objects(truth_path(tmp_path / name)))
    assert truths == [one.truth for one in passes]


def test_a_pass_cut_short_leaves_the_old_files(missions, sky, tmp_path):
    path = tmp_path / "pass.ndjson"
    write_pass(drawn(missions, sky, "XTE", 1, 2), path)
    before = path.read_bytes()

    def cut_short():
        yield from drawn(missions, sky, "XTE", 2, 1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_pass(cut_short(), path)
    assert path.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["pass.ndjson", "pass.truth.ndjson"]

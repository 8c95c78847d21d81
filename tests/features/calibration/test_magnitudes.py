"""Zero point, scale and colour of magnitudes are estimated with sigmas that hold."""

import json
import tomllib

import numpy as np
import pytest

from service.acquire import acquire
from service.features.calibration.estimate import calibrate
from service.features.calibration.evidence import identified_magnitudes, identified_stars
from service.features.calibration.linearise import Model
from service.features.calibration.magnitudes import (
    COLOR,
    SCALE,
    UNITS,
    ZERO,
    MagnitudeStars,
    calibrate_magnitudes,
    calibrated_settings,
    joined,
)
from service.features.calibration.mission_file import calibrated_mission_text
from service.features.calibration.stars import joined as joined_stars
from service.missions.mission import Magnitudes, parse_mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from tests.features.calibration.wrong_file import mission_texts

SEED = 11
"""Any other must do as well."""
TRUE = {ZERO: 0.25, SCALE: -0.04, COLOR: 0.12}
NOISE_MAG, OF_STAR_MAG = 0.15, 0.05


def drawn(rng, *, stars=150, seen=8, wrong=0.0, one_color=False, one_magnitude=False):
    """Observations of two trackers: the second has `TRUE`, and what the catalog has wrong.

    `wrong` is the share of observations that are of another star.
    """
    catalog_mag = np.full(stars, 5.0) if one_magnitude else rng.uniform(2.0, 6.5, stars)
    color = np.full(stars, 0.6) if one_color else rng.normal(0.6, 0.5, stars)
    of_star = rng.normal(0.0, OF_STAR_MAG, stars)
    star = np.tile(np.arange(stars), 2 * seen)
    tracker = np.repeat([0, 1], stars * seen)
    p, q = (np.median(each) for each in (catalog_mag, color))
    off = TRUE[ZERO] + TRUE[SCALE] * (catalog_mag - p) + TRUE[COLOR] * (color - q)
    observed = (catalog_mag + of_star)[star] + np.where(tracker == 1, off[star], 0.0)
    observed += rng.normal(0.0, NOISE_MAG, len(star))
    other = rng.random(len(star)) < wrong
    observed[other] = rng.uniform(2.0, 6.5, int(other.sum()))
    return MagnitudeStars(tracker, star, observed, catalog_mag[star], color[star])


def test_values_are_within_three_sigmas_in_97_of_100_and_sigmas_are_right():
    """Normalised errors pooled over the unknowns; the catalog's own errors are in the sigmas."""
    rng = np.random.default_rng(SEED)
    errors = []
    for _ in range(100):
        _, found = calibrate_magnitudes(drawn(rng), ("A", "B"), {})
        assert found.names == (ZERO, SCALE, COLOR)
        true = np.array([TRUE[name] for name in found.names])
        errors.append((found.value - true) / found.sigma)
    within = np.sum(np.abs(errors) < 3.0, axis=0)
    assert (within >= 97).all(), within
    assert 0.85 < np.sqrt(np.mean(np.square(errors))) < 1.15


def test_five_percent_wrong_stars_move_values_by_less_than_three_sigmas():
    rng = np.random.default_rng(SEED)
    _, found = calibrate_magnitudes(drawn(rng, wrong=0.05), ("A", "B"), {})
    true = np.array([TRUE[name] for name in found.names])
    assert (np.abs(found.value - true) < 3.0 * found.sigma).all()
    assert found.scatter_mag == pytest.approx(np.hypot(NOISE_MAG, OF_STAR_MAG), rel=0.15)


def test_a_tracker_without_error_is_found_to_have_none():
    found, _ = calibrate_magnitudes(drawn(np.random.default_rng(SEED)), ("A", "B"), {})
    assert (np.abs(found.value) < 4.0 * found.sigma).all()


@pytest.mark.parametrize(
    ("drawing", "left_out", "reason"),
    [
        ({"one_color": True}, COLOR, "too few different colours"),
        ({"one_magnitude": True}, SCALE, "as bright as each other"),
    ],
)
def test_what_the_stars_do_not_show_is_named_and_left_out(drawing, left_out, reason):
    stars = drawn(np.random.default_rng(SEED), **drawing)
    _, found = calibrate_magnitudes(stars, ("A", "B"), {})
    assert left_out not in found.names
    assert ZERO in found.names
    (missing,) = found.not_observable
    assert missing.name == f"B {left_out}"
    assert reason in missing.reason
    assert abs(found.value_of(ZERO) - TRUE[ZERO]) < 4.0 * found.sigma[0]


def test_stars_without_a_known_colour_still_give_zero_and_scale():
    stars = drawn(np.random.default_rng(SEED))
    unknown = np.full(len(stars.star), np.nan)
    bare = MagnitudeStars(stars.tracker, stars.star, stars.observed_mag, stars.catalog_mag, unknown)
    _, found = calibrate_magnitudes(bare, ("A", "B"), {})
    assert found.names == (ZERO, SCALE)
    assert [each.name for each in found.not_observable] == [f"B {COLOR}"]


@pytest.mark.parametrize(
    ("observed", "left_out"),
    [
        (lambda mag: np.full_like(mag, 5.0), {SCALE}),
        (lambda mag: 10.0 - mag, {SCALE}),
        (lambda mag: 2.5 * mag, {SCALE}),
        (lambda mag: mag - 40.0, {ZERO}),
    ],
    ids=["constant", "inverted", "stretched", "far off"],
)
def test_numbers_that_are_no_magnitudes_leave_settings_that_a_mission_file_takes(
    missions, observed, left_out
):
    stars = drawn(np.random.default_rng(SEED))
    sent = MagnitudeStars(
        *(stars.tracker, stars.star, observed(stars.observed_mag)),
        *(stars.catalog_mag, stars.color_bv_mag),
    )
    (found, _) = calibrate_magnitudes(sent, ("A", "B"), {})
    assert not left_out & set(found.names)
    assert (ZERO in found.names) == (ZERO not in left_out)
    reasons = {each.name: each.reason for each in found.not_observable}
    for name in left_out:
        assert "that of no tracker" in reasons[f"A {name}"]
    tracker = missions["XTE"].trackers[0].model_copy(update={"name": "A"})
    settings = calibrated_settings([tracker], [found], ("A", "B"))["A"]
    assert settings.scale == 1.0


def test_a_scale_that_no_mission_file_may_have_refuses_the_magnitudes_of_its_tracker_alone():
    """Each of two calibrations in a row changes it by a factor of 1.5."""
    stars = drawn(np.random.default_rng(SEED))
    shrunk = np.where(stars.tracker == 0, stars.observed_mag / 1.5, stars.observed_mag)
    sent = MagnitudeStars(
        *(stars.tracker, stars.star, shrunk, stars.catalog_mag, stars.color_bv_mag)
    )
    once, other = calibrate_magnitudes(sent, ("A", "B"), {})
    assert once.value_of(SCALE) == pytest.approx(1.0 / 1.5 - 1.0, abs=0.01)
    again, same = calibrate_magnitudes(sent, ("A", "B"), {"A": Magnitudes(scale=1.5)})
    assert again.names == ()
    assert {each.name for each in again.not_observable} == {f"A {name}" for name in UNITS}
    assert all("scale 2.2" in each.reason for each in again.not_observable)
    assert same.names == other.names == (ZERO, SCALE, COLOR)


def test_one_star_that_is_seen_far_more_often_does_not_stand_for_all():
    """Its noise, ten times less than what the catalog has wrong, would leave no other star."""
    rng = np.random.default_rng(SEED)
    star = np.concatenate([np.zeros(2_000, np.int64), np.arange(1, 60)])
    catalog_mag, color = rng.uniform(2.0, 6.5, 60)[star], rng.normal(0.6, 0.5, 60)[star]
    of_star = np.concatenate([[0.0], 1.0 + rng.normal(0.0, 0.2, 59)])
    observed = catalog_mag + of_star[star] + rng.normal(0.0, 0.005, len(star))
    stars = MagnitudeStars(np.zeros(len(star), np.int64), star, observed, catalog_mag, color)
    (found,) = calibrate_magnitudes(stars, ("A",), {})
    assert found.names == ()
    assert len(found.not_observable) == 3


def test_a_tracker_with_few_stars_or_none_gives_nothing():
    few = drawn(np.random.default_rng(SEED), stars=5)
    for stars in (few, None):
        for each in calibrate_magnitudes(stars, ("A", "B"), {}):
            assert each.names == ()
            assert len(each.not_observable) == 3


def two_trackers(magnitudes=("", "")):
    """The file of the true trackers, with tables `magnitudes`."""
    text = mission_texts()["true"]
    head, middle, tail = text.partition('\n[[trackers]]\nname = "SECOND"')
    assert middle
    first, second = (f"\n[trackers.magnitudes]\n{each}\n" if each else "" for each in magnitudes)
    return head + first + middle + tail + second


def acquired(text, batches, sky):
    mission = parse_mission(text, "two.toml")
    return [acquire(submission_from_json(json.dumps(each)).batch, mission, sky) for each in batches]


def offsets_of(found, color_bv_mag):
    """Observed minus catalog magnitude by tracker, with the colours of the stars."""
    parts = [identified_magnitudes(each, TRACKERS, color_bv_mag) for each in found]
    stars = joined([each for each in parts if each is not None])
    off = stars.observed_mag - stars.catalog_mag
    known = np.isfinite(stars.color_bv_mag)
    return [
        (off[(stars.tracker == k) & known], stars.color_bv_mag[(stars.tracker == k) & known])
        for k in range(2)
    ]


TRACKERS = ("STARTRACKER_1", "SECOND")
MAGNITUDES = "zero_mag = -0.45\nscale = 1.03\ncolor_mag = 0.2"


@pytest.fixture(scope="module")
def sky():
    return SkyModel(load_embedded(), LruCache(256 << 20))


@pytest.fixture(scope="module")
def pass_of_true_trackers(sky):
    """Telemetry of trackers with the true magnitudes, which the file that is assumed lacks."""
    mission = parse_mission(two_trackers((MAGNITUDES, MAGNITUDES)), "true")
    wanted = Pass(batches=150, seed=SEED, angles_share=1.0, stars=12, troubles=NO_TROUBLES)
    return [each.batch for each in draw_pass(mission, sky, wanted)]


def test_settings_written_to_the_mission_file_take_zero_scale_and_colour_away(
    pass_of_true_trackers, sky
):
    color = sky.catalog.color_bv_mag
    assumed = two_trackers()
    found = acquired(assumed, pass_of_true_trackers, sky)
    before = offsets_of(found, color)
    assert all(np.mean(off) > 0.2 for off, _ in before)
    assert all(np.polyfit(bv, off, 1)[0] > 0.1 for off, bv in before)

    parts = [identified_magnitudes(each, TRACKERS, color) for each in found]
    seen = joined([each for each in parts if each is not None])
    mission = parse_mission(assumed, "two.toml")
    magnitudes = {each.name: each.magnitudes for each in mission.trackers}
    calibrated = calibrate_magnitudes(seen, TRACKERS, magnitudes)
    assert all(each.names == (ZERO, SCALE, COLOR) for each in calibrated)
    settings = calibrated_settings(mission.trackers, calibrated, TRACKERS)
    positions = [identified_stars(each, TRACKERS) for each in found]
    geometry = calibrate(joined_stars([each for each in positions if each]), Model(degree=0))
    text = calibrated_mission_text(assumed, "two.toml", geometry, mission, settings)
    written = parse_mission(text, "two.toml")
    for each, truth in zip(written.trackers, (MAGNITUDES, MAGNITUDES), strict=True):
        true = Magnitudes.model_validate(tomllib.loads(truth))
        assert each.magnitudes == settings[each.name]
        assert each.magnitudes.scale == pytest.approx(true.scale, abs=0.015)
        assert each.magnitudes.color_mag == pytest.approx(true.color_mag, abs=0.05)

    settings_now = {each.name: each.magnitudes for each in written.trackers}
    again = acquired(text, pass_of_true_trackers, sky)
    for off, bv in offsets_of(again, color):
        assert abs(np.mean(off)) < 0.03
        assert abs(np.polyfit(bv, off, 1)[0]) < 0.05
    # What is calibrated once more is what is there.
    parts = [identified_magnitudes(each, TRACKERS, color) for each in again]
    seen = joined([each for each in parts if each])
    once_more = calibrate_magnitudes(seen, TRACKERS, settings_now)
    twice = calibrated_settings(written.trackers, once_more, TRACKERS)
    for name, each in settings.items():
        assert twice[name].scale == pytest.approx(each.scale, abs=0.01)
        assert twice[name].color_mag == pytest.approx(each.color_mag, abs=0.03)


def test_a_file_without_magnitudes_keeps_its_digest_and_its_run_catalog():
    mission = parse_mission(two_trackers(), "two.toml")
    assert mission.run_catalog_settings is mission.catalog
    assert "magnitudes" not in mission.model_dump_json()
    with_color = parse_mission(two_trackers(("color_mag = 0.2", "")), "two.toml")
    assert with_color.run_catalog_settings.color_polynomial_mag == pytest.approx((0.0, 0.1))

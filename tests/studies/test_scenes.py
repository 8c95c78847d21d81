"""Scenes: the sky as a camera sees it at a random attitude, with the truth beside it."""

import numpy as np
import pytest

from service.vectors import angle_between_deg
from studies.scenes import (
    Conditions,
    PinholeCamera,
    SceneSky,
    draw_random_points,
    draw_scene,
    draw_scenes,
)


@pytest.fixture(scope="module")
def sky():
    return SceneSky.for_conditions(Conditions())


def test_the_camera_sees_ten_degrees_and_its_pixels_read_back():
    camera = PinholeCamera()
    assert camera.field_deg == pytest.approx(10.0, abs=1e-3)
    pixels = np.array([[0.0, 0.0], [512.0, -512.0], [-13.5, 200.25]])
    assert camera.pixels(camera.directions(pixels)) == pytest.approx(pixels, abs=1e-9)


def test_without_noise_every_star_stands_where_the_attitude_puts_it(sky):
    conditions = Conditions(position_px=0.0, magnitude_sigma_mag=0.0)
    for scene in draw_scenes(sky, conditions, 20, seed=3):
        catalog = sky.run_catalog
        there = catalog.direction[scene.star] @ scene.attitude.T
        assert angle_between_deg(scene.direction, there) == pytest.approx(0.0, abs=1e-9)
        assert scene.magnitude_mag == pytest.approx(catalog.magnitude_mag[scene.star])
        pixels = PinholeCamera().pixels(catalog.direction @ scene.attitude.T)
        inside = (np.abs(pixels) <= 512).all(axis=1) & (catalog.direction @ scene.attitude[2] > 0)
        expected = np.flatnonzero(inside & (catalog.magnitude_mag <= 6.0))
        assert sorted(scene.star) == expected.tolist()


def test_noise_has_the_size_asked_for_and_both_loses_and_adds_stars(sky):
    conditions = Conditions(position_px=2.0)
    off_px, noise_mag, lost, added = [], [], 0, 0
    for scene in draw_scenes(sky, conditions, 150, seed=5):
        true = sky.run_catalog.direction[scene.star] @ scene.attitude.T
        camera = conditions.camera
        off_px.append(camera.pixels(scene.direction) - camera.pixels(true))
        faint = sky.run_catalog.magnitude_mag[scene.star]
        added += int((faint > 6.0).sum())
        noise_mag.append((scene.magnitude_mag - faint)[faint < 4.0])
        about = sky.about(scene.attitude[2], np.radians(4.9))
        bright = about[sky.run_catalog.magnitude_mag[about] <= 6.0]
        lost += len(set(bright) - set(scene.star))
    assert np.std(np.concatenate(off_px)) == pytest.approx(2.0, rel=0.06)
    assert np.std(np.concatenate(noise_mag)) == pytest.approx(0.5, rel=0.15)
    assert lost > 50
    assert added > 50


def test_a_scene_does_not_depend_on_how_many_are_drawn(sky):
    few = list(draw_scenes(sky, Conditions(), 3, seed=11))
    later = next(draw_scenes(sky, Conditions(), 1, seed=11, first=2))
    assert np.array_equal(few[2].direction, later.direction)
    assert np.array_equal(few[2].star, later.star)


def test_attitudes_are_even_over_the_sky(sky):
    boresights = np.array([s.attitude[2] for s in draw_scenes(sky, Conditions(), 2000, seed=1)])
    # Each component of a direction that is even over the sphere is even from -1 to 1.
    assert np.abs(boresights.mean(axis=0)).max() < 4.5 / np.sqrt(3 * 2000)
    assert np.abs((boresights**2).mean(axis=0) - 1 / 3).max() < 4.5 * 0.3 / np.sqrt(2000)


def test_the_brightest_of_a_circle_and_spurious_points_are_told_apart(sky):
    rng = np.random.default_rng(2)
    conditions = Conditions(radius_deg=4.0, brightest=5, fewest=5, spurious=3)
    for _ in range(20):
        scene = draw_scene(sky, conditions, rng)
        assert (scene.star >= 0).sum() == 5
        assert (scene.star < 0).sum() == 3
        assert (np.diff(scene.magnitude_mag) >= 0).all()
        assert angle_between_deg(scene.direction, [0, 0, 1]).max() < 4.1


def test_a_mirror_turns_handedness_and_keeps_every_angle(sky):
    scene = draw_scene(sky, Conditions(fewest=5), np.random.default_rng(4))
    mirrored = scene.mirrored()
    a, b = scene.direction[:3], mirrored.direction[:3]
    assert a @ a.T == pytest.approx(b @ b.T)
    assert np.linalg.det(a) == pytest.approx(-np.linalg.det(b))


def test_how_far_an_attitude_is_off_is_told_for_boresight_and_in_total(sky):
    scene = draw_scene(sky, Conditions(), np.random.default_rng(6))
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    roll = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    pitch = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    assert scene.off_from(roll @ scene.attitude) == pytest.approx((0.0, 2.0))
    assert scene.off_from(pitch @ scene.attitude) == pytest.approx((2.0, 2.0))


def test_random_points_lie_in_the_field_and_name_no_star(sky):
    scene = draw_random_points(sky, Conditions(), 12, np.random.default_rng(7))
    assert (np.abs(PinholeCamera().pixels(scene.direction)) <= 512).all()
    assert (scene.star == -1).all()


def test_a_field_that_no_sky_holds_is_refused():
    with pytest.raises(ValueError, match="no field"):
        draw_scene(SceneSky.to_magnitude(2.0), Conditions(fewest=200), np.random.default_rng(8))

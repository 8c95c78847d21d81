"""What is found on a frame: every star to the limit, nothing else; placed as well as it says."""

import dataclasses

import numpy as np
import pytest

from service.features.pictures.centroids.centroid import centroid
from service.features.pictures.centroids.psf import GaussianPsf
from service.features.pictures.centroids.window import Detector
from service.features.pictures.detection.cosmic_rays import hits_under, is_sharp
from service.features.pictures.detection.detect import detect
from service.features.pictures.detection.measure import measure
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames
from tests.chance import assert_chi_square
from tests.reference.star_windows import draw_window


@pytest.fixture(scope="module")
def frames(sky, missions):
    """Frames with ten times the usual cosmic rays."""
    settings = FrameSettings(frames=4, seed=8, cosmic_rays=50)
    return list(draw_frames(missions["IMAGER"], sky, settings))


@pytest.fixture
def camera(missions):
    return missions["IMAGER"].trackers[0].camera


def found_on(drawn, camera):
    frame = Frame(drawn.counts.astype(np.float32), "FITS", "sha256:0", 65535.0)
    return frame, detect(frame, camera)


def truth_of(drawn):
    return (
        np.array([star[name] for star in drawn.truth["stars"]])
        for name in ("u_px", "v_px", "magnitude")
    )


def away(found, u, v):
    return np.hypot(found.u_px - u[:, None], found.v_px - v[:, None])


def test_every_star_to_the_limit_is_found(frames, camera):
    for drawn in frames:
        _, found = found_on(drawn, camera)
        u, v, magnitude = truth_of(drawn)
        inside = (u > 0) & (u < 1023) & (v > 0) & (v < 1023) & (magnitude <= 6.5)
        # A star within three pixels of a brighter one is part of its image.
        near = np.hypot(u - u[:, None], v - v[:, None]) < 3.0
        alone = ~(near & (magnitude[None, :] < magnitude[:, None])).any(axis=1)
        assert (away(found, u, v).min(axis=1)[inside & alone] < 2.0).all()


def test_nothing_bright_is_found_that_is_no_star(frames, camera):
    for drawn in frames:
        _, found = found_on(drawn, camera)
        u, v, _ = truth_of(drawn)
        bright = found.flux_counts > 0.5 * camera.flux_counts(np.array(6.5), 0.1)
        nearest = away(found, u, v).min(axis=0)
        assert (nearest[bright] < 2.0).all()
        assert len(found.sharp_u_px) > 100


def test_places_scatter_as_they_say(frames, camera, missions):
    """Stars that stand alone, errors over predicted sigmas: a variance of one."""
    normalised = []
    for drawn in frames:
        frame, found = found_on(drawn, camera)
        rates = np.array(drawn.known["body_rates_deg_per_s"])
        tracker = missions["IMAGER"].trackers[0]
        u, v, _ = truth_of(drawn)
        for star in measure(frame, found, tracker, camera, rates, "matched", 6.5):
            if star.left_out is None and not star.record.flags:
                apart = np.hypot(u - star.record.u_px, v - star.record.v_px)
                if np.count_nonzero(apart < 6.0) == 1:
                    k = int(apart.argmin())
                    normalised.append((star.record.u_px - u[k]) / star.record.sigma_u_px)
                    normalised.append((star.record.v_px - v[k]) / star.record.sigma_v_px)
    assert len(normalised) > 60
    assert_chi_square(np.square(normalised), 1)


@pytest.mark.parametrize("sigma_px", [0.7, 0.9, 1.5])
def test_points_of_light_are_stars_wherever_they_fall_on_a_pixel(rng, sigma_px):
    from service.features.pictures.centroids.psf import GaussianPsf

    light = np.zeros((41, 41))
    steps = np.arange(41)
    for _ in range(50):
        u, v = rng.uniform(15, 25, 2)
        image = GaussianPsf(sigma_px).pixel(steps[None, :] - u, steps[:, None] - v)
        light = 1000.0 * image + rng.normal(0.0, 3.0, image.shape)
        assert not is_sharp(light, np.array([u]), np.array([v]), sigma_px)[0]


def test_single_pixels_and_tracks_are_none(rng):
    for _ in range(50):
        light = rng.normal(0.0, 3.0, (41, 41))
        light[20, 20] += 500.0
        assert is_sharp(light, np.array([20.2]), np.array([19.9]), 0.9)[0]
        for step in range(8):
            light[20 + step, 20 + step // 2] += rng.uniform(300, 600)
        assert is_sharp(light, np.array([21.5]), np.array([23.5]), 0.9)[0]


def test_a_star_on_a_trail_is_found_and_placed_at_mid_exposure(sky, missions, camera):
    settings = FrameSettings(frames=1, seed=3, rates_deg_per_s=0.4)
    (drawn,) = draw_frames(missions["IMAGER"], sky, settings)
    frame, found = found_on(drawn, camera)
    tracker, rates = missions["IMAGER"].trackers[0], np.array(drawn.known["body_rates_deg_per_s"])
    u, v, magnitude = truth_of(drawn)
    offsets = []
    for star in measure(frame, found, tracker, camera, rates, "matched", 6.0):
        if star.left_out is None and not star.record.flags:
            apart = np.hypot(u - star.record.u_px, v - star.record.v_px)
            k = int(apart.argmin())
            offsets.append((star.record.u_px - u[k], star.record.v_px - v[k]))
            assert star.magnitude_mag == pytest.approx(magnitude[k], abs=0.2)
    assert len(offsets) >= 4
    assert np.abs(offsets).max() < 0.3


@pytest.mark.parametrize("method", ["matched", "recursive"])
def test_a_hot_pixel_under_a_star_is_not_believed(method, camera, rng):
    """Found in a star's own light by what no image of a point can do; the rest places it."""
    psf, detector, background = GaussianPsf(camera.psf_sigma_px), Detector(2.0, 12.0), 40.0
    for _ in range(40):
        u, v = rng.uniform(7.5, 8.5, 2)
        window = draw_window(rng, psf, (u, v), 5000.0, detector, background, 17)
        struck = tuple(rng.integers(7, 10, 2))
        counts = window.counts.copy()
        counts[struck] += 0.5 * 5000.0 * psf.pixel(np.zeros(1), np.zeros(1))[0]
        dirty = dataclasses.replace(window, counts=counts)
        pulled = centroid(dirty, method, psf, start=(8.0, 8.0), half_width_px=4)
        hits = hits_under(dirty, psf, pulled)
        assert hits[struck]
        clean = dataclasses.replace(dirty, good=~hits)
        found = centroid(clean, method, psf, start=(8.0, 8.0), half_width_px=4)
        assert abs(found.u_px - u) < 5 * found.sigma_u_px
        assert abs(found.v_px - v) < 5 * found.sigma_v_px
        assert not hits_under(window, psf, centroid(window, method, psf, start=(8.0, 8.0))).any()

"""Stars behind crossed wires: found behind one another's tails, and placed as well as they say."""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter

from service.features.pictures.centroids.centroid import METHODS
from service.features.pictures.centroids.psf import airy_psf, wired_psf
from service.features.pictures.detection.detect import detect
from service.features.pictures.detection.measure import measure
from service.features.pictures.detection.star_images import MOST_IMAGES, psf_of, still_psf
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames
from service.missions.camera import Camera
from tests.chance import assert_chi_square

FOUND_PX = 2.0


def with_image(mission, psf):
    """The mission with another image of a star."""
    (tracker,) = mission.trackers
    camera = tracker.camera.model_copy(update={"psf": psf})
    other = tracker.model_copy(update={"camera": camera})
    return mission.model_copy(update={"trackers": (other,)})


@pytest.fixture(scope="module")
def crossed(missions):
    """The shipped mission behind two wires each way."""
    return with_image(missions["IMAGER"], "cross")


@pytest.fixture(scope="module")
def frames(sky, crossed):
    """Drawn frames with their candidates."""
    tracker, camera = crossed.camera_tracker(None, "tracker")
    found = []
    for drawn in draw_frames(crossed, sky, FrameSettings(frames=2, seed=8), [0, 3]):
        frame = Frame(drawn.counts.astype(np.float32), "FITS", "sha256:0", 65535.0)
        rates = np.array(drawn.known["body_rates_deg_per_s"])
        moving = psf_of(camera, tracker, rates, drawn.exposure_s)
        found.append((drawn, frame, rates, detect(frame, camera, moving)))
    return found


def truth_of(drawn):
    return (
        np.array([star[name] for star in drawn.truth["stars"]])
        for name in ("u_px", "v_px", "magnitude")
    )


def test_every_bright_star_is_found_and_no_piece_of_a_tail(frames, crossed):
    camera = crossed.trackers[0].camera
    for drawn, _, _, found in frames:
        u, v, magnitude = truth_of(drawn)
        assert magnitude.min() < 4.0
        inside = (u > 0) & (u < 1023) & (v > 0) & (v < 1023)
        near = np.hypot(u - u[:, None], v - v[:, None]) < 3.0
        alone = inside & ~(near & (magnitude[None, :] < magnitude[:, None])).any(axis=1)
        away = np.hypot(found.u_px - u[:, None], found.v_px - v[:, None])
        assert (away.min(axis=1)[alone & (magnitude <= 6.5)] < FOUND_PX).all()
        bright = found.flux_counts > 0.5 * camera.flux_counts(np.array(6.5), 0.1)
        assert (away.min(axis=0)[bright] < FOUND_PX).all()


@pytest.mark.parametrize("method", METHODS)
def test_places_scatter_as_they_say(method, frames, crossed):
    tracker, camera = crossed.camera_tracker(None, "tracker")
    errors = []
    for drawn, frame, rates, found in frames:
        u, v, _ = truth_of(drawn)
        for star in measure(frame, found, tracker, camera, rates, method, 6.5):
            record = star.record
            if star.left_out is None and not record.flags:
                apart = np.hypot(u - record.u_px, v - record.v_px)
                k = int(apart.argmin())
                if np.count_nonzero(apart < 6.0) == 1:
                    errors.append((record.u_px - u[k]) / record.sigma_u_px)
                    errors.append((record.v_px - v[k]) / record.sigma_v_px)
    assert len(errors) > 40
    assert_chi_square(np.square(errors), 1)


def test_rings_of_an_aperture_are_no_stars(sky, missions):
    """A frame with a star of V 1.4, whose rings stand out of the noise for 50 pixels."""
    mission = with_image(missions["IMAGER"], "airy")
    camera = mission.trackers[0].camera
    (drawn,) = draw_frames(mission, sky, FrameSettings(frames=1, seed=8))
    u, v, magnitude = truth_of(drawn)
    assert magnitude.min() < 2.0
    found = detect(Frame(drawn.counts.astype(np.float32), "FITS", "sha256:0", 65535.0), camera)
    away = np.hypot(found.u_px - u[:, None], found.v_px - v[:, None])
    bright = found.flux_counts > 0.5 * camera.flux_counts(np.array(6.5), 0.1)
    assert (away.min(axis=0)[bright] < FOUND_PX).all()
    inside = (u > 0) & (u < 1023) & (v > 0) & (v < 1023) & (magnitude <= 6.5)
    assert (away.min(axis=1)[inside] < FOUND_PX).mean() > 0.9


def test_a_frame_full_of_points_is_bounded_work(crossed, rng):
    """More points than stars are taken off: the rest are candidates as they are."""
    camera = crossed.trackers[0].camera
    light = np.zeros((360, 360))
    v, u = (axis.ravel() for axis in np.mgrid[8:352:13, 8:352:13])
    light[v, u] = rng.uniform(3e4, 9e4, len(u))
    counts = rng.poisson(gaussian_filter(light, 0.9) + 200.0).astype(np.float32)
    found = detect(Frame(counts, "FITS", "sha256:0", 65535.0), camera)
    assert len(u) > MOST_IMAGES
    assert len(found.images.stars) == MOST_IMAGES
    assert found.count >= MOST_IMAGES


def test_without_wires_there_is_the_airy_disc():
    clear, disc = wired_psf(2.0, [], reach_px=24), airy_psf(2.0, reach_px=24)
    grid = np.arange(-20.0, 21.0)
    expected = disc.pixel(grid[None, :], grid[:, None])
    assert clear.pixel(grid[None, :], grid[:, None]) == pytest.approx(expected, abs=3e-4)


@pytest.mark.parametrize("turn_deg", [30.0, -75.0])
def test_a_wire_spreads_light_across_itself(turn_deg):
    """The tail against the integral over the chords of the aperture, those of the wire dark."""
    width, disc_px = 0.1, 8.0
    psf = wired_psf(disc_px, [(turn_deg, 0.0, width)], reach_px=60)
    across = math.radians(turn_deg + 90.0)
    angle = np.linspace(1.5, 6.5, 60)
    s = np.linspace(-0.5, 0.5, 20_001)
    chord = 2.0 * np.sqrt(np.maximum(0.25 - s**2, 0.0)) * (np.abs(s) >= width / 2.0)
    waves = np.cos(2.0 * np.pi * np.append(angle, 0.0)[:, None] * s)
    light = np.trapezoid(chord * waves, s) ** 2
    expected, middle = light[:-1] / light[-1], psf.pixel(0.0, 0.0)
    distance = disc_px * angle
    tail = psf.pixel(distance * math.cos(across), distance * math.sin(across)) / middle
    assert tail == pytest.approx(expected, abs=0.05 * expected.max())
    beside = psf.pixel(distance * math.sin(across), -distance * math.cos(across)) / middle
    assert tail.sum() > 5.0 * beside.sum()


def test_a_raster_is_evaluated_as_its_points_are(crossed, rng):
    psf = still_psf(crossed.trackers[0].camera)
    u, v = np.sort(rng.uniform(-9, 9, (2, 12)))
    points = np.meshgrid(u, v)
    for raster, single in (
        (psf.pixel(u[None, :], v[:, None]), psf.pixel(*points)),
        *zip(psf.slopes(u[None, :], v[:, None]), psf.slopes(*points), strict=True),
    ):
        assert raster == pytest.approx(single, abs=1e-12)


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"psf": "round"}, "psf"),
        ({"psf": "airy", "psf_sigma_px": 9.0}, "psf_sigma_px"),
        ({"psf": "airy", "wires": [[0, 0, 0.1]]}, "wires"),
        ({"psf": "cross", "wires": []}, "wires"),
        ({"psf": "cross", "wires": [[0, 0.6, 0.1]]}, "wires"),
        ({"psf": "cross", "wires": [[0, 0, 0.4], [90, 0, 0.4]]}, "cover"),
    ],
)
def test_images_that_cannot_be_are_refused_by_name(changed, word, missions):
    told = missions["IMAGER"].trackers[0].camera.model_dump()
    with pytest.raises(ValidationError, match=word):
        Camera.model_validate(told | changed)


def test_the_digest_of_a_mission_is_that_of_its_settings_without_the_default(missions, crossed):
    told = missions["IMAGER"].trackers[0].model_dump(mode="json")["camera"]
    assert "psf" not in told
    assert "wires" not in told
    assert crossed.digest != missions["IMAGER"].digest

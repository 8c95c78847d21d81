"""Stray light hides no star that as much even light shows, and the sigmas know of its photons."""

import numpy as np
import pytest

from service.features.pictures.detection.detect import detect
from service.features.pictures.detection.measure import measure
from service.features.pictures.detection.star_images import psf_of
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames
from tests.scale import draws

LIMIT_MAG = 6.5
V, U = np.mgrid[0:1024, 0:1024].astype(float)
OFF_AXIS = ((U - 512) ** 2 + (V - 512) ** 2) / 724**2
LIGHTS = {
    "slope 2": 2.0 * U,
    "slope 20": 20.0 * V,
    "sharp limb": 8000.0 / (1.0 + np.exp((V - 850.0) / 4.0)),
    "bright corner": 15000.0 * np.exp(-np.hypot(U, V) / 150.0),
    "slope 0.5": 0.5 * U,
    "slope 5 both ways": 5.0 * (U + V),
    "vignetting": 3000.0 * (1.0 - 0.5 * OFF_AXIS),
    "limb": 8000.0 / (1.0 + np.exp((V - 850.0) / 25.0)),
}


@pytest.fixture(scope="module")
def frames(sky, missions):
    settings = FrameSettings(frames=draws(1, 12), seed=7)
    return list(draw_frames(missions["IMAGER"], sky, settings))


def lit(drawn, light, gain, noise):
    """The counts of a frame with more light, and its photon noise."""
    more = np.round(light + np.sqrt(light / gain) * noise)
    return np.minimum(drawn.counts + more, 65535.0).astype(np.float32)


def pulls_of(counts, drawn, mission):
    """How many stars are found, and errors over sigmas of those that stand alone."""
    tracker = mission.trackers[0]
    camera = tracker.camera
    frame = Frame(counts, "FITS", "sha256:0", 65535.0, drawn.time.text, drawn.exposure_s)
    rates = np.array(drawn.known["body_rates_deg_per_s"])
    found = detect(frame, camera, psf_of(camera, tracker, rates, drawn.exposure_s))
    stars = measure(frame, found, tracker, camera, rates, "matched", LIMIT_MAG + 0.5)
    records = [star.record for star in stars if star.left_out is None]
    u, v, magnitude = (
        np.array([star[name] for star in drawn.truth["stars"]])
        for name in ("u_px", "v_px", "magnitude")
    )
    inside = (np.minimum(u, v) > 5) & (np.maximum(u, v) < 1018) & (magnitude < LIMIT_MAG)
    count, pulls = 0, []
    for k in np.flatnonzero(inside):
        near = [r for r in records if np.hypot(r.u_px - u[k], r.v_px - v[k]) < 2.0]
        count += bool(near)
        alone = np.count_nonzero(np.hypot(u - u[k], v - v[k]) < 12.0) == 1
        if near and alone and not near[0].flags:
            star, floor = near[0], camera.sigma_floor_px
            pulls.append((star.u_px - u[k]) / np.hypot(star.sigma_u_px, floor))
            pulls.append((star.v_px - v[k]) / np.hypot(star.sigma_v_px, floor))
    return count, pulls


def test_stray_light_hides_no_star_that_even_light_shows(frames, missions, figures):
    mission = missions["IMAGER"]
    gain = mission.trackers[0].camera.gain_e_per_count
    stray, even, pulls = 0, 0, []
    for number, drawn in enumerate(frames):
        noise = np.random.default_rng(number).normal(size=drawn.counts.shape)
        for light in list(LIGHTS.values())[: draws(4, len(LIGHTS))]:
            count, errors = pulls_of(lit(drawn, light, gain, noise), drawn, mission)
            stray, pulls = stray + count, pulls + errors
            flat = np.full_like(light, light.mean())
            even += pulls_of(lit(drawn, flat, gain, noise), drawn, mission)[0]
    rms = float(np.sqrt(np.mean(np.square(pulls))))
    figures(stray=stray, even=even, rms=rms, pulls=len(pulls))
    assert stray >= 0.95 * even
    # Four times the error of the figure itself.
    assert abs(rms - 1.0) < 0.05 + 4.0 / np.sqrt(2.0 * len(pulls))


def test_the_noise_is_that_of_the_place_without_the_slope(frames, missions):
    camera = missions["IMAGER"].trackers[0].camera
    counts = lit(
        frames[0],
        LIGHTS["slope 20"],
        camera.gain_e_per_count,
        np.random.default_rng(1).normal(size=U.shape),
    )
    found = detect(Frame(counts, "FITS", "sha256:0", 65535.0), camera)
    middle_counts = 20.0 * 511.5
    expected = np.sqrt(6.2**2 + middle_counts / camera.gain_e_per_count)
    assert found.noise_counts == pytest.approx(expected, rel=0.05)
    assert np.median(np.abs(found.light[100:900, 100:900])) < expected

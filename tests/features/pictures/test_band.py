"""Frames in broad light: each star in its own colour, found and placed as well as it says.

pytest --full -s tests/features/pictures/test_band.py --seed 7  200 frames, other draws
"""

import io
from collections import Counter
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError

from service.acquire import acquire
from service.features.pictures.centroids.psf import ColouredPsf, airy_psf
from service.features.pictures.centroids.shape_fit import fit_in_its_colour
from service.features.pictures.centroids.window import Detector, Window
from service.features.pictures.detection.star_images import (
    AIRY_OVER_SIGMA,
    psfs_of_colours,
    still_psf,
)
from service.features.pictures.frames.files import frame_digest
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.features.pictures.tracker.submit import read_known, submission_of_frame
from service.mission_checks.mission_check import findings
from service.missions.camera import Camera
from service.vectors import attitude_error_arcsec, matrix_from_quaternion

BAND_NM = (450.0, 750.0)
FRAMES, AT_ONCE = 100, 5
"""Of each image; a test of all of them at once would count as one that hangs."""
FOUND_PX, ALONE_PX = 2.0, 6.0
RIGHT_ARCSEC = (30.0, 30.0, 300.0)
SPREAD = (0.9, 1.1)


def in_band(mission, psf, band_nm=BAND_NM):
    """The mission with the image of an aperture, in light from blue to red."""
    (tracker,) = mission.trackers
    told = tracker.camera.model_dump() | {"psf": psf, "band_nm": band_nm}
    other = tracker.model_copy(update={"camera": Camera.model_validate(told)})
    return mission.model_copy(update={"trackers": (other,)})


@pytest.fixture(scope="module")
def measured(sky, missions, request):
    """A frame of a psf by its number: errors over sigmas, that of the attitude, and counts."""
    settings = FrameSettings(frames=FRAMES, seed=request.config.getoption("--seed"))

    @cache
    def of(psf, number):
        mission = in_band(missions["IMAGER"], psf)
        (drawn,) = draw_frames(mission, sky, settings, [number])
        return measured_frame(drawn, mission, sky)

    return of


def measured_frame(drawn, mission, sky):
    camera = mission.trackers[0].camera
    file = io.BytesIO(frame_bytes(drawn))
    pixels = camera.width_px * camera.height_px
    known = read_known(drawn.known)
    submission = submission_of_frame(file, frame_digest(file), known, mission, pixels)
    stars = [star for star in submission.frame.stars if star["used"]]
    truth = drawn.truth["stars"]
    u, v = (np.array([star[name] for star in truth]) for name in ("u_px", "v_px"))
    acquisition = acquire(submission.batch, mission, sky)
    named = acquisition.trackers[0].identification
    errors, counts = [], Counter(frames=1, stars=len(stars))
    for k, star in enumerate(stars):
        away = np.hypot(u - star["u_px"], v - star["v_px"])
        near = int(away.argmin())
        counts["no star"] += bool(away[near] > FOUND_PX)
        if away[near] <= FOUND_PX and (away < ALONE_PX).sum() == 1 and not star["flags"]:
            errors.append((star["u_px"] - u[near]) / star["sigma_u_px"])
            errors.append((star["v_px"] - v[near]) / star["sigma_v_px"])
        if named.unique[k]:
            name = acquisition.run_catalog.star_id[int(named.star[k])]
            nearby = [truth[j]["id"] for j in np.flatnonzero(away < FOUND_PX + 1.0)]
            counts["named"] += 1
            counts["misnamed"] += name not in nearby
    square = np.nan
    if acquisition.solution is not None:
        found, true = (
            matrix_from_quaternion(each)
            for each in (acquisition.solution.quaternion, drawn.truth["quaternion"])
        )
        error = attitude_error_arcsec(found, true)
        counts["suspect"] += acquisition.solution.suspect
        counts["right"] += bool((np.abs(error) <= RIGHT_ARCSEC).all())
        if not acquisition.solution.suspect:
            square = error @ np.linalg.solve(acquisition.solution.covariance_arcsec2, error)
    return errors, square, counts


def assert_as_claimed(psf, frames):
    """Print the figures of frames, and hold them against their bounds."""
    errors = np.concatenate([errors for errors, _, _ in frames])
    chi2 = np.nanmean([square for _, square, _ in frames]) / 3.0
    counts = sum((counts for _, _, counts in frames), Counter())
    spread = float(np.sqrt((errors**2).mean()))
    print(
        f"\n{psf}: {counts['frames']} frames, {counts['right']} attitudes right, "
        f"{counts['suspect']} suspect; "
        f"mean normalised error squared over 3, good attitudes: {chi2:.2f}; "
        f"detections sent, of these no star: {counts['stars']}, {counts['no star']}; "
        f"stars named; wrongly named: {counts['named']}, {counts['misnamed']}; "
        f"{len(errors)} errors of places, "
        f"over their sigmas: rms {spread:.3f}, central 68.3 % "
        f"{np.quantile(np.abs(errors), 0.6827):.3f}, largest {np.abs(errors).max():.1f}"
    )
    assert counts["right"] == counts["frames"]
    assert counts["misnamed"] == 0
    # The bounds hold for all frames together; the spread of fewer frames varies more.
    slack = 4.0 / np.sqrt(2.0 * len(errors)) if counts["frames"] < FRAMES else 0.0
    assert SPREAD[0] - slack < spread < SPREAD[1] + slack


@pytest.mark.parametrize("psf", ["airy", "cross"])
def test_a_frame_in_a_band_is_as_good_as_it_says(psf, measured):
    assert_as_claimed(psf, [measured(psf, 0)])


@pytest.mark.slow
@pytest.mark.parametrize("psf", ["airy", "cross"])
@pytest.mark.parametrize("frames", range(AT_ONCE, FRAMES + 1, AT_ONCE))
def test_frames_in_a_band_are_as_good_as_they_say(psf, frames, measured):
    assert_as_claimed(psf, [measured(psf, number) for number in range(frames)])


def test_the_image_in_a_band_is_the_sum_of_those_of_its_colours(missions):
    """Against images of single colours, each computed by itself, weighed as Planck's law says."""
    camera = in_band(missions["IMAGER"], "airy").trackers[0].camera
    bv_mag, grid = 0.65, np.arange(-20.0, 21.0)
    heat_k = 4600.0 * (1.0 / (0.92 * bv_mag + 1.7) + 1.0 / (0.92 * bv_mag + 0.62))
    nm = np.linspace(*BAND_NM, 42)
    nm = 0.5 * (nm[1:] + nm[:-1])
    photons = nm**-4.0 / np.expm1(1.438777e7 / (nm * heat_k))
    expected = sum(
        share
        * airy_psf(AIRY_OVER_SIGMA * 0.9 * wave / 600.0, reach_px=40).pixel(grid, grid[:, None])
        for wave, share in zip(nm, photons / photons.sum(), strict=True)
    )
    (found,) = psfs_of_colours(camera, (bv_mag,))
    assert found.pixel(grid, grid[:, None]) == pytest.approx(expected, abs=1e-3 * expected.max())


def test_a_bright_star_shows_its_colour_and_a_faint_one_is_taken_for_a_common_one(missions):
    camera = in_band(missions["IMAGER"], "airy").trackers[0].camera
    between = still_psf(camera)
    grid = np.arange(-6.0, 7.0)
    for psf in (between.blue, between.red):
        image = psf.pixel(grid - 0.3, grid[:, None] + 0.2)
        for flux, least in ((1e5, 0.9), (30.0, 0.0)):
            window = Window(flux * image, Detector(1.0, 5.0))
            _, found = fit_in_its_colour(window, between, (6.0, 6.0), 4)
            towards = (found.red_share - 0.5) / (0.5 if psf is between.red else -0.5)
            assert least <= towards <= least + 0.2
    gaussian = still_psf(missions["IMAGER"].trackers[0].camera)
    assert not isinstance(gaussian, ColouredPsf)
    assert fit_in_its_colour(window, gaussian, (6.0, 6.0), 4)[1] is gaussian


@pytest.mark.parametrize(
    "changed",
    [{"psf": "gaussian"}, {"band_nm": (750, 450)}, {"band_nm": (400, 900)}, {"band_nm": (1, 2)}],
)
def test_bands_that_cannot_be_are_refused_by_name(changed, missions):
    told = in_band(missions["IMAGER"], "airy").trackers[0].camera.model_dump()
    with pytest.raises(ValidationError, match="band_nm"):
        Camera.model_validate(told | changed)


def test_a_mission_check_asks_for_the_band(missions):
    for band_nm in (None, BAND_NM):
        mission = in_band(missions["IMAGER"], "airy", band_nm)
        asked = any("band_nm" in each.text for each in findings(mission, 9.0, [], []))
        assert asked is (band_nm is None)


def test_a_camera_without_a_band_has_the_digest_it_had(missions):
    told = missions["IMAGER"].trackers[0].model_dump(mode="json")["camera"]
    assert "band_nm" not in told

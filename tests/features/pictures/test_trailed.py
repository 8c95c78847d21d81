"""Pictures whose stars move while the shutter is open: placed in their middle, or refused."""

import io

import numpy as np
import pytest
from astropy.io import fits
from scipy.spatial import cKDTree

from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.blind.solver import focal_px_of
from service.features.pictures.detection.points import find_points
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec
from tests.features.pictures.drawn import middle_attitude
from tests.features.pictures.trailed import draw_trailed
from tests.scale import draws

LENS = Lens(1200, 800, focal_px_of(1200, 40.0))
NARROW = Lens(1200, 800, focal_px_of(1200, 20.0))
HALF_CIRCLE = np.linspace(-1.0, 1.0, 100)


YEAR = 2026


def frame_of(picture):
    file = io.BytesIO()
    fits.PrimaryHDU(picture.counts.astype(np.float32)).writeto(file)
    return read_frame(io.BytesIO(file.getvalue()), FrameLimits(10_000_000))


def is_right(result, picture):
    error = attitude_error_arcsec(result.attitude.attitude, middle_attitude(picture))
    turn = error / ARCSEC_PER_RADIAN
    return turn @ np.linalg.solve(result.attitude.covariance_rad2, turn) < 16.3


def turned(lens, along_u_px=0.0, along_v_px=0.0, roll_rad=0.0):
    """The rotation that moves a star in the middle so far on the sensor."""
    return -along_v_px / lens.focal_px, along_u_px / lens.focal_px, roll_rad


MOVED = {
    "no pixel": turned(LENS),
    "2 px": turned(LENS, 2.0),
    "5 px": turned(LENS, 3.0, 4.0),
    "30 x 12 px": turned(LENS, 30.0, 12.0),
    "40 px upwards": turned(LENS, 0.0, -40.0),
    "a field rotation of 6 deg beside the middle": turned(LENS, 8.0, -4.0, 0.1),
}


@pytest.mark.parametrize("motion", MOVED)
def test_stars_that_move_evenly_give_the_attitude_of_mid_exposure(blind, motion):
    rng = np.random.default_rng(16)
    picture = draw_trailed(rng, blind[0], LENS, MOVED[motion], faintest_ratio=20.0)
    result = solve_picture(frame_of(picture), *blind)
    assert is_right(result, picture)
    assert result.attitude.sigma_arcsec[:2].max() < 60.0
    said = [each for each in result.remarks if each.startswith("trailed: ")]
    assert len(said) == (np.hypot(*MOVED[motion][:2]) * LENS.focal_px > 4.0 or "field" in motion)


def test_a_path_that_bends_alike_for_all_stars_is_measured_in_its_middle(blind):
    bow = np.column_stack([18.0 * HALF_CIRCLE, 3.0 * HALF_CIRCLE**2])
    rng = np.random.default_rng(4)
    picture = draw_trailed(rng, blind[0], LENS, None, path_px=bow, faintest_ratio=20.0)
    result = solve_picture(frame_of(picture), *blind)
    # The mean of all light lies a pixel, 67 arcsec, beside the middle of the path.
    error = attitude_error_arcsec(result.attitude.attitude, middle_attitude(picture))
    assert np.abs(error[:2]).max() < 20.0
    assert is_right(result, picture)


PATHS = {
    "two images of each star": ([(-6.0, 0.0), (6.0, 0.0)], None),
    "two images that touch": ([(-2.5, 1.0), (2.5, -1.0)], None),
    "two images, one of them fainter": ([(-9.0, 8.0), (9.0, -8.0)], [0.65, 0.35]),
    "a mount that stopped halfway": (
        np.column_stack([15.0 * np.maximum(HALF_CIRCLE, -0.5), 0.0 * HALF_CIRCLE]),
        None,
    ),
    "a cloud that came": (
        np.column_stack([15.0 * HALF_CIRCLE, 5.0 * HALF_CIRCLE]),
        np.linspace(1.6, 0.4, 100) / 100.0,
    ),
    "a path bent like a hook": (np.column_stack([12.0 * HALF_CIRCLE, 7.0 * HALF_CIRCLE**2]), None),
}


@pytest.mark.parametrize("path", PATHS)
def test_stars_that_move_otherwise_have_no_attitude_and_the_word_trailed(blind, path):
    offsets, weights = PATHS[path]
    rng = np.random.default_rng(8)
    picture = draw_trailed(
        rng, blind[0], LENS, None, path_px=offsets, weights=weights, faintest_ratio=20.0
    )
    result = solve_picture(frame_of(picture), *blind)
    assert result.attitude is None
    assert result.remarks[0].startswith("trailed: stars moved by about ")
    assert "cannot be told" in result.remarks[0]


@pytest.mark.parametrize("length_px", [0.0, 2.0, 5.0, 8.0, 16.0, 40.0])
def test_places_of_trails_are_as_wrong_as_their_covariances_say(blind, length_px):
    """Along the trail and across it."""
    pulls = []
    for seed in range(draws(3, 12)):
        rng = np.random.default_rng((seed, int(length_px)))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        motion = turned(NARROW, length_px * np.cos(angle), length_px * np.sin(angle))
        picture = draw_trailed(
            rng, blind[0], NARROW, motion, faintest_mag=8.0, psf_px=rng.uniform(0.9, 1.8)
        )
        points = find_points(picture.counts.astype(np.float32))
        assert length_px < 8.0 or points.trail_px == pytest.approx(length_px, rel=0.1)
        drawn = np.column_stack([picture.u_px, picture.v_px])
        alone = cKDTree(drawn).query(drawn, k=2)[0][:, 1] > length_px + 10.0
        away, star = cKDTree(drawn).query(np.column_stack([points.u_px, points.v_px]))
        u, v = points.u_px, points.v_px
        whole = (np.minimum(u, 1199 - u) > 30) & (np.minimum(v, 799 - v) > 30)
        used = alone[star] & (away < max(3.0, 0.3 * length_px)) & whole
        error = np.column_stack([u, v])[used] - drawn[star[used]]
        along = np.array([np.cos(angle), np.sin(angle)])
        for axis in (along, np.array([-along[1], along[0]])):
            sigma = np.sqrt(axis @ points.covariance_px2[used] @ axis)
            pulls.append(np.abs(error @ axis) / sigma)
    assert len(np.concatenate(pulls)) > 15 * len(pulls)
    # Crossing trails are not alone for all that: the central 68.3 % count.
    for each in (np.concatenate(pulls[0::2]), np.concatenate(pulls[1::2])):
        assert 0.75 < np.quantile(each, 0.683) < 1.2
    assert 0.82 < np.quantile(np.concatenate(pulls), 0.683) < 1.1

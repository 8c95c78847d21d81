"""Stretched pictures, whose stars are cut off at the largest count, and what a hint asks for."""

import io

import numpy as np
import pytest
from PIL import Image
from scipy.stats import chi2

from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.blind.solver import focal_px_of
from service.features.pictures.detection.clipped import clipped_stars
from service.features.pictures.detection.points import find_points, without_dark
from service.features.pictures.frames.frame import Frame
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec
from tests.features.pictures.drawn import draw_picture, jpeg_of, middle_attitude
from tests.scale import draws

WIDTH, HEIGHT = 1200, 800


YEAR = 2026


def frame_of(counts):
    return Frame(counts.astype(np.float32), "PNG", "sha256:0", 255.0)


def drawn_discs(rng, sky, attitude, lens, base_px, growth, quality=None):
    """A chart of the sky: discs with soft edges, all of one grey, larger for brighter stars."""
    u, v = lens.places(sky.direction @ attitude.T)
    with np.errstate(invalid="ignore"):
        inside = (u > 0) & (v > 0) & (u < lens.width_px - 1) & (v < lens.height_px - 1)
    rows = np.flatnonzero(inside & (sky.magnitude_mag < 5.6))
    counts = rng.normal(16.0, 1.5, (lens.height_px, lens.width_px))
    for row in rows:
        radius = base_px + growth * max(5.6 - sky.magnitude_mag[row], 0.0)
        half = int(radius) + 4
        left, top = round(u[row]) - half, round(v[row]) - half
        columns = np.arange(max(left, 0), min(left + 2 * half + 1, lens.width_px))
        lines = np.arange(max(top, 0), min(top + 2 * half + 1, lens.height_px))
        away = np.hypot(columns[None, :] - u[row], lines[:, None] - v[row])
        counts[np.ix_(lines, columns)] += 300.0 / (1.0 + np.exp(3.0 * (away - radius)))
    counts = np.clip(np.round(counts), 0, 255).astype(np.uint8)
    return (
        counts if quality is None else np.asarray(Image.open(io.BytesIO(jpeg_of(counts, quality))))
    )


@pytest.mark.parametrize(
    ("base_px", "growth", "quality"),
    [(1.6, 0.4, None), (2.5, 0.8, None), (2.5, 0.8, 80), (4.0, 1.2, None), (3.0, 1.0, 60)],
)
def test_a_chart_of_discs_is_solved(blind, rng, base_px, growth, quality):
    sky, solver = blind
    lens = Lens(WIDTH, HEIGHT, focal_px_of(WIDTH, 40.0))
    for _ in range(draws(1, 10)):
        truth = draw_picture(rng, sky, lens=lens, off_center=0.0).attitude
        counts = drawn_discs(rng, sky, truth, lens, base_px, growth, quality)
        points = find_points(counts.astype(np.float32))
        assert points.clipped_stars >= 20
        result = solve_picture(frame_of(counts), sky, solver)
        assert result.attitude is not None, result.remarks
        turn = attitude_error_arcsec(result.attitude.attitude, truth) / ARCSEC_PER_RADIAN
        assert np.degrees(np.linalg.norm(turn)) < 0.02
        assert turn @ np.linalg.solve(result.attitude.covariance_rad2, turn) < chi2(3).ppf(0.999)
        assert any(remark.startswith("clipped_stars: ") for remark in result.remarks)


@pytest.mark.parametrize("stretch", [8.0, 30.0, 120.0])
def test_a_picture_that_was_stretched_is_as_right_as_before(blind, rng, stretch):
    sky, solver = blind
    for _ in range(draws(1, 10)):
        lens = Lens(WIDTH, HEIGHT, focal_px_of(WIDTH, 25.0))
        picture = draw_picture(rng, sky, stars=150, quality=None, lens=lens)
        light = picture.counts.astype(np.float64) - np.median(picture.counts)
        counts = np.clip(16.0 + stretch / 8.0 * light, 0, 255).round()
        result = solve_picture(frame_of(counts), sky, solver)
        assert result.attitude is not None, result.remarks
        error = attitude_error_arcsec(result.attitude.attitude, middle_attitude(picture))
        assert np.linalg.norm(error[:2]) < 120.0


def test_a_place_is_as_sure_as_its_disc_says(rng):
    """Errors of single discs over their sigmas, with noise on the flanks alone."""
    pulls = []
    for _ in range(3):
        counts = rng.normal(16.0, 2.0, (400, 600))
        places = np.stack(np.meshgrid(np.arange(30, 590, 55), np.arange(30, 390, 55)), -1)
        places = places.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(places.reshape(-1, 2)), 2))
        lines, columns = np.indices(counts.shape)
        for u, v in places:
            away = np.hypot(columns - u, lines - v)
            counts += 400.0 * np.exp(-0.5 * (away / rng.uniform(2.0, 4.0)) ** 2)
        discs = clipped_stars(np.clip(counts, 0.0, 255.0).astype(np.float32) - 16.0)
        assert len(discs.u_px) == len(places)
        for u, v, sigma in zip(discs.u_px, discs.v_px, discs.sigma_px, strict=True):
            off = places - (u, v)
            nearest = off[np.argmin(np.hypot(*off.T))]
            pulls.append(nearest / sigma)
    # Round discs are placed far better than real ones, which these sigmas are for.
    assert np.sqrt(np.mean(np.square(pulls))) < 1.0


def test_a_few_bright_stars_that_are_cut_off_change_nothing(rng):
    counts = rng.normal(16.0, 2.0, (300, 300)).astype(np.float32)
    counts[100:104, 100:104] = 255.0
    assert clipped_stars(counts - 16.0) is None
    assert clipped_stars(np.zeros((50, 50), np.float32)) is None
    counts[:, :100] = 255.0
    assert clipped_stars(counts - 16.0) is None


def test_no_hint_asks_for_what_was_given(blind, rng):
    noise = rng.normal(100.0, 3.0, (200, 300))
    dark = frame_of(np.full((200, 300), 90.0))
    for guess_px in (None, 500.0):
        for has_dark in (False, True):
            hot = noise.copy()
            hot[rng.integers(5, 195, 60), rng.integers(5, 295, 60)] += 90.0
            frame = frame_of(hot)
            frame = without_dark(frame, dark) if has_dark else frame
            text = " ".join(solve_picture(frame, *blind, guess_px).remarks)
            assert ("--fov" in text) == (guess_px is None)
            assert ("--dark" in text) == (not has_dark)


def test_a_negative_is_named_and_nothing_else_is_asked_for(blind, rng):
    sky, solver = blind
    lens = Lens(WIDTH, HEIGHT, focal_px_of(WIDTH, 40.0))
    truth = draw_picture(rng, sky, lens=lens, off_center=0.0).attitude
    counts = 255 - drawn_discs(rng, sky, truth, lens, 1.6, 0.4)
    result = solve_picture(frame_of(counts), sky, solver)
    assert result.attitude is None
    assert [remark.partition(":")[0] for remark in result.remarks] == ["negative"]

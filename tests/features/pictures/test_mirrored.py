"""Pictures that a file, or a lens, turned over, and pictures full of hot pixels."""

import io

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.detection.points import find_points
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import Frame, FrameLimits
from service.features.pictures.overlay import overlay_of
from service.vectors import attitude_error_arcsec
from tests.features.pictures.drawn import middle_attitude

LIMITS = FrameLimits(10_000_000)


def png(counts, **more):
    file = io.BytesIO()
    Image.fromarray(counts).save(file, "PNG", **more)
    return file.getvalue()


def fits_file(counts, **cards):
    file = io.BytesIO()
    unit = fits.PrimaryHDU(counts)
    unit.header.update(cards)
    unit.writeto(file)
    return file.getvalue()


def turned(tag):
    exif = Image.Exif()
    exif[274] = tag
    return exif


def is_right(result, picture):
    error = attitude_error_arcsec(result.attitude.attitude, middle_attitude(picture))
    return np.abs(error).max() < 0.05 * 3600


CASES = {
    "bottom up, as the header says": (
        lambda v: fits_file(v[::-1], ROWORDER="BOTTOM-UP"),
        "ROWORDER",
        False,
    ),
    "bottom up without a word": (lambda v: fits_file(v[::-1]), "top and bottom", True),
    "mirrored by the orientation tag": (
        lambda v: png(v[:, ::-1].copy(), exif=turned(2)),
        "orientation tag 2",
        False,
    ),
    "mirrored without a word": (lambda v: png(v[:, ::-1].copy()), "left and right", True),
}


@pytest.mark.parametrize("case", CASES)
def test_a_picture_turned_over_has_the_attitude_of_the_right_way(blind, picture, case):
    write, word, is_mirrored = CASES[case]
    frame = read_frame(io.BytesIO(write(picture.counts)), LIMITS)
    result = solve_picture(frame, *blind, picture.lens.focal_px)
    assert is_right(result, picture)
    assert word in result.frame.orientation
    assert result.frame.is_mirrored == is_mirrored
    assert np.array_equal(result.frame.counts, picture.counts)
    # The overlay draws the stars of that picture where they are seen on it.
    points = find_points(result.frame.counts)
    u, v = (
        np.array([getattr(s, name) for s in result.attitude.stars]) for name in ("u_px", "v_px")
    )
    away = np.hypot(points.u_px[:, None] - u, points.v_px[:, None] - v).min(axis=0)
    assert np.median(away) < 0.2
    assert overlay_of(result, case).startswith(b"\x89PNG")


@pytest.mark.parametrize("hot", [100, 200, 400])
def test_hot_pixels_are_not_taken_for_stars(blind, picture, hot):
    rng = np.random.default_rng(hot)
    counts = picture.counts.copy()
    rows, columns = rng.integers(5, 475, (2, hot))
    counts[rows, columns] = rng.integers(80, 256, hot)
    result = solve_picture(Frame(counts.astype(np.float32), "NPY", "x", 255.0), *blind)
    assert is_right(result, picture)
    assert any(each.startswith("hot_pixels: ") for each in result.remarks)
    assert result.points.hot_pixels > 0.8 * hot


def test_stars_sharper_than_a_pixel_are_found_after_all(blind, picture):
    result = solve_picture(
        Frame(picture.counts.astype(np.float32), "NPY", "x", 255.0), *blind, picture.lens.focal_px
    )
    counts = np.full(picture.counts.shape, 10.0, np.float32)
    counts += np.random.default_rng(1).normal(0.0, 1.0, counts.shape).astype(np.float32)
    for star in result.attitude.stars:
        counts[round(star.v_px), round(star.u_px)] += (
            200.0 * 10 ** (-0.4 * star.magnitude_v_mag) * 50
        )
    found = solve_picture(Frame(counts, "NPY", "x", 65535.0), *blind, picture.lens.focal_px)
    assert is_right(found, picture)


def test_clutter_names_the_dark_frame(blind):
    counts = np.random.default_rng(3).normal(100.0, 5.0, (600, 600))
    blobs = np.random.default_rng(4).integers(5, 595, (2, 900))
    for down in (0, 1):
        for across in (0, 1):
            counts[blobs[0] + down, blobs[1] + across] += 200.0
    frame = Frame(counts.astype(np.float32), "NPY", "x", 65535.0)
    result = solve_picture(frame, *blind, 3000.0)
    assert result.attitude is None
    assert any("--dark FILE" in each for each in result.remarks)

"""What is found on a picture depends neither on the unit of its counts nor on their zero."""

import io
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.detection.detect import detect
from service.features.pictures.detection.measure import measure
from service.features.pictures.detection.points import find_points, hot_pixels
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import Frame, FrameLimits
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames
from tests.scale import draws

LIMITS = FrameLimits(2_000_000)
SIDE = 640, 480


@pytest.fixture(scope="module")
def truth(blind, picture):
    return solve_picture(Frame(picture.counts.astype(np.float32), "NPY", ""), *blind)


def fits_of(values, scale=1.0, zero=0.0):
    file = io.BytesIO()
    unit = fits.PrimaryHDU(values)
    if (scale, zero) != (1.0, 0.0):
        unit.header["BSCALE"], unit.header["BZERO"] = scale, zero
    unit.writeto(file)
    return file.getvalue()


def tiff_of(values):
    file = io.BytesIO()
    tifffile.imwrite(file, values, metadata=None)
    return file.getvalue()


def npy_of(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def png_of(values):
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


REAL = {
    "FITS of -32": lambda v: fits_of(v.astype(">f4")),
    "FITS of -64": lambda v: fits_of(v.astype(">f8")),
    "TIFF of 32 bits": lambda v: tiff_of(v.astype("f4")),
    "TIFF of 64 bits": lambda v: tiff_of(v.astype("f8")),
    "NPY of 32 bits": lambda v: npy_of(v.astype("f4")),
    "NPY of 64 bits": lambda v: npy_of(v.astype("f8")),
    "NPY by columns": lambda v: npy_of(np.asfortranarray(v.astype(">f8"))),
}
"""Formats of floating numbers."""
WHOLE = {
    "FITS of 16 bits with BSCALE": lambda v, a, b: fits_of(v.astype(">i2"), a, b),
    "FITS of 32 bits with BSCALE": lambda v, a, b: fits_of(v.astype(">i4"), a, b),
    "FITS of -32 with BSCALE": lambda v, a, b: fits_of(v.astype(">f4"), a, b),
}
STEPS = {
    "PNG of 16 bits": lambda v: png_of(v.astype(np.uint16)),
    "TIFF of 16 bits": lambda v: tiff_of(v.astype(np.uint16)),
    "TIFF of 32 bits": lambda v: tiff_of(v.astype(np.int32)),
    "FITS of 64 bits": lambda v: fits_of(v.astype(">i8")),
    "NPY of 64 bits": lambda v: npy_of(v.astype(np.int64)),
}
"""Formats of whole numbers, in steps of more than one."""


def require_same(result, truth, factor):
    found, true = result.attitude, truth.attitude
    assert found is not None, result.remarks
    assert [star.id for star in found.stars] == [star.id for star in true.stars]
    turn = np.abs(found.attitude @ true.attitude.T - np.eye(3)).max()
    # Numbers of 32 bits round what was multiplied.
    assert turn < 1e-3 * np.sqrt(np.diag(true.covariance_rad2)).max()
    assert found.sigma_arcsec == pytest.approx(true.sigma_arcsec, rel=0.01)
    assert result.points.count == pytest.approx(truth.points.count, abs=2)
    assert result.points.psf_sigma_px == pytest.approx(truth.points.psf_sigma_px, rel=1e-3)
    assert result.points.noise_counts == pytest.approx(factor * truth.points.noise_counts, rel=0.01)
    moved_mag = 2.5 * np.log10(factor)
    assert found.zero_point_mag - true.zero_point_mag == pytest.approx(moved_mag, abs=1e-3)


def drawn_scale(rng, counts, most_zero):
    """A factor of any size, and an offset that single precision still tells apart."""
    factor = 10.0 ** rng.uniform(-15.0, 15.0)
    return factor, factor * rng.uniform(-most_zero, most_zero) * float(np.ptp(counts))


@pytest.mark.parametrize("name", REAL)
def test_real_numbers_of_any_scale_and_zero_give_the_same_answer(blind, picture, truth, name, rng):
    zero = 1e6 if "64" in name or "columns" in name else 10.0
    for _ in range(draws(2, 40)):
        factor, offset = drawn_scale(rng, picture.counts, zero)
        data = REAL[name](picture.counts * factor + offset)
        require_same(solve_picture(read_frame(io.BytesIO(data), LIMITS), *blind), truth, factor)


@pytest.mark.parametrize("name", WHOLE)
def test_whole_numbers_under_any_bscale_and_bzero_give_the_same(blind, picture, truth, name, rng):
    for _ in range(draws(2, 40)):
        factor, offset = drawn_scale(rng, picture.counts, 1e4)
        data = WHOLE[name](picture.counts.astype(np.int32), factor, offset)
        require_same(solve_picture(read_frame(io.BytesIO(data), LIMITS), *blind), truth, factor)


@pytest.mark.parametrize("name", STEPS)
def test_counts_in_steps_of_more_than_one_give_the_same(blind, picture, truth, name, rng):
    for _ in range(draws(1, 10)):
        factor, offset = int(rng.integers(2, 128)), int(rng.integers(0, 2000))
        data = STEPS[name](picture.counts.astype(np.int64) * factor + offset)
        require_same(solve_picture(read_frame(io.BytesIO(data), LIMITS), *blind), truth, factor)


@pytest.mark.parametrize("factor", [2.0**-40, 1.0 / 65535.0, 3e-4, 700.0, 1e9])
def test_a_black_background_without_noise_gives_the_same_in_any_unit(blind, picture, factor):
    """Where most counts are equal, only the step between counts tells stars from rounding."""
    black = np.maximum(picture.counts.astype(np.float64) - np.median(picture.counts) - 12.0, 0.0)
    truth = find_points(black)
    for zero in (0.0, 0.25, -3e4):
        found = find_points(factor * (black + zero))
        assert found.count == truth.count
        assert found.u_px == pytest.approx(truth.u_px, abs=1e-3)
        assert found.signal_ratio == pytest.approx(truth.signal_ratio, rel=1e-3)


def test_a_picture_of_two_levels_gives_the_same_in_any_unit(rng):
    stars = np.zeros((200, 200))
    stars[rng.integers(10, 190, 30), rng.integers(10, 190, 30)] = 1.0
    counts = [find_points(stars * factor, keep_hot=True).count for factor in (1e-9, 1.0, 255.0)]
    assert counts[0] == counts[1] == counts[2] >= 25


def test_hot_pixels_of_a_dark_frame_are_the_same_in_any_unit(rng):
    dark = np.round(rng.normal(100.0, 0.2, (200, 200)))
    dark[rng.integers(0, 200, 20), rng.integers(0, 200, 20)] += 30.0
    hot = hot_pixels(dark)
    assert 15 <= np.count_nonzero(hot) <= 20
    for factor in (1e-6, 1 / 65535, 1e6):
        assert np.array_equal(hot_pixels(factor * (dark - 90.0)), hot)


@pytest.mark.parametrize("factor", [1.0 / 65535.0, 1e-6, 37.0])
def test_a_spacecraft_s_camera_may_count_in_any_unit(missions, sky, factor):
    mission = missions["IMAGER"]
    tracker, camera = mission.camera_tracker(None, "tracker")
    (drawn,) = draw_frames(mission, sky, FrameSettings(frames=1, seed=5))
    frame = Frame(drawn.counts.astype(np.float64), "NPY", "", full_scale=65535.0)
    in_unit = camera.model_copy(
        update={
            "gain_e_per_count": camera.gain_e_per_count / factor,
            "bias_counts": camera.bias_counts * factor,
            "saturation_counts": camera.saturation_counts * factor,
            "zero_point_mag": camera.zero_point_mag + 2.5 * np.log10(factor),
        }
    )
    same = replace(frame, counts=frame.counts * factor, full_scale=65535.0 * factor)
    stars = [
        measure(each, detect(each, lens), tracker, lens, np.zeros(3), "window", 6.0)
        for each, lens in ((frame, camera), (same, in_unit))
    ]
    assert len(stars[0]) == len(stars[1]) > 10
    for one, other in zip(*stars, strict=True):
        assert other.left_out == one.left_out
        assert other.record.u_px == pytest.approx(one.record.u_px, abs=1e-3, nan_ok=True)
        assert other.record.sigma_u_px == pytest.approx(
            one.record.sigma_u_px, rel=1e-2, nan_ok=True
        )
        assert other.magnitude_mag == pytest.approx(one.magnitude_mag, abs=1e-3, nan_ok=True)


@pytest.mark.parametrize("fill", [-32768.0, -9999.0, 1e20])
@pytest.mark.parametrize("write", [REAL["FITS of -32"], npy_of], ids=["FITS", "npy"])
def test_a_border_of_fill_values_hides_no_star_and_is_named(picture, fill, write):
    values = picture.counts.astype("f4") / 65535.0
    whole = find_points(read_frame(io.BytesIO(write(values)), LIMITS).counts).count
    values[:12] = fill
    frame = read_frame(io.BytesIO(write(values)), LIMITS)
    assert np.isnan(frame.counts[:12]).all()
    assert f"fill: {values[:12].size} pixels hold {fill:g}" in frame.remarks[-1]
    assert find_points(frame.counts).count > 0.8 * whole


@pytest.mark.parametrize("border", [0.0, 1.0])
def test_pixels_cut_off_at_zero_or_at_one_are_no_fill_values(picture, border):
    values = picture.counts.astype("f4") / picture.counts.max()
    values[:12] = border
    frame = read_frame(io.BytesIO(npy_of(values)), LIMITS)
    assert np.array_equal(frame.counts, values)
    assert not any("fill" in remark for remark in frame.remarks)

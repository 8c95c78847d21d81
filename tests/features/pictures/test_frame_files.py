"""Frames are read as other readers read them, whatever the file's kind; truth is kept exactly."""

import importlib.util
import io
import math

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from service.errors import BadFile
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.fits import write_fits
from service.features.pictures.frames.frame import FrameLimits
from tests.features.pictures.colour_files import colours, dng, png_of_16_bits, tiff_of_16_bits

LIMITS = FrameLimits(max_pixels=1_000_000)


@pytest.fixture
def counts(rng):
    return rng.integers(0, 65536, (31, 47)).astype(np.uint16)


def read(data, limits=LIMITS):
    return read_frame(io.BytesIO(data), limits)


def astropy_file(values, **cards):
    file = io.BytesIO()
    unit = fits.PrimaryHDU(values)
    unit.header.update(cards)
    unit.writeto(file)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["u1", "i2", "u2", "i4", "i8", "f4", "f8"])
def test_a_fits_file_of_astropy_is_read_as_astropy_reads_it(rng, kind):
    values = rng.uniform(0, 200, (12, 20)).astype(kind)
    frame = read(astropy_file(values))
    assert frame.file_format == "FITS"
    assert np.array_equal(frame.counts, values.astype(np.float64))
    full = math.inf if kind[0] == "f" else float(np.iinfo(kind).max)
    assert frame.full_scale == full


def test_what_is_written_astropy_reads(counts):
    file = io.BytesIO()
    write_fits(file, counts, {"EXPTIME": 0.1, "OBSERVER": "D'Arcy", "GUIDED": True})
    with fits.open(io.BytesIO(file.getvalue())) as opened:
        opened.verify("exception")
        assert np.array_equal(opened[0].data, counts)
        assert opened[0].header["OBSERVER"] == "D'Arcy"
        assert opened[0].header["EXPTIME"] == 0.1
    assert np.array_equal(read(file.getvalue()).counts, counts)


def test_scales_blanks_and_images_behind_an_empty_unit_are_understood():
    values = np.array([[1, 2], [-32768, 4]], dtype=np.int16)
    header = {"BSCALE": 2.0, "BZERO": 10.0, "BLANK": -32768}
    file = io.BytesIO()
    image = fits.ImageHDU(values)
    image.header.update(header)
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(file)
    assert np.array_equal(
        read(file.getvalue()).counts, [[12.0, 14.0], [np.nan, 18.0]], equal_nan=True
    )


@pytest.mark.parametrize(
    ("cards", "time"),
    [
        ({"DATE-AVG": "2026-03-01T00:00:00.5"}, "2026-03-01T00:00:00.500Z"),
        ({"DATE-OBS": "2026-03-01T00:00:00", "EXPTIME": 0.5}, "2026-03-01T00:00:00.250Z"),
        ({"DATE-OBS": "2026-03-01T00:00:00"}, None),
        ({"DATE-AVG": "2026-03-01T00:00:00", "TIMESYS": "TT"}, "2026-02-28T23:58:50.816Z"),
        ({"DATE-AVG": "noon"}, None),
    ],
)
def test_the_time_of_mid_exposure_is_taken_from_a_header_that_tells_it(cards, time):
    frame = read(astropy_file(np.zeros((3, 3), np.uint8), **cards))
    assert frame.time == time


def test_pictures_and_arrays_hold_the_same_counts(counts):
    for file_format in ("PNG", "TIFF"):
        file = io.BytesIO()
        Image.fromarray(counts).save(file, file_format)
        frame = read(file.getvalue())
        assert (frame.file_format, frame.full_scale) == (file_format, 65535.0)
        assert np.array_equal(frame.counts, counts)
    squeezed = io.BytesIO()
    Image.fromarray(counts).save(squeezed, "TIFF", compression="tiff_adobe_deflate")
    assert np.array_equal(read(squeezed.getvalue()).counts, counts)
    small = io.BytesIO()
    Image.fromarray((counts >> 8).astype(np.uint8)).save(small, "PNG")
    assert read(small.getvalue()).full_scale == 255.0
    for array in (counts, np.asfortranarray(counts), counts.astype(">f8")):
        file = io.BytesIO()
        np.save(file, array)
        assert np.array_equal(read(file.getvalue()).counts, counts)


@pytest.mark.parametrize("kind", [np.int32, np.float32])
def test_a_picture_of_32_bits_has_no_known_full_scale(counts, kind):
    """A camera of 16 bits may fill it to 65,535, one of 32 bits beyond: nothing tells which."""
    values = counts.astype(kind)
    values[0, :2] = 65535, 2**31 - 128
    file = io.BytesIO()
    Image.fromarray(values).save(file, "TIFF")
    frame = read(file.getvalue())
    assert np.array_equal(frame.counts, values.astype(np.float64))
    assert frame.full_scale == math.inf


def test_the_digest_is_that_of_the_file(counts):
    import hashlib

    file = io.BytesIO()
    np.save(file, counts)
    assert read(file.getvalue()).digest == ("sha256:" + hashlib.sha256(file.getvalue()).hexdigest())


@pytest.mark.parametrize("file_format", ["PNG", "TIFF", "BMP"])
def test_of_a_picture_in_colour_the_channels_are_summed(rng, file_format):
    values = rng.integers(0, 256, (31, 47, 3)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(values).save(file, file_format)
    frame = read(file.getvalue())
    assert np.array_equal(frame.counts, values.astype(np.float64).sum(axis=2))
    assert frame.full_scale == 765.0
    assert frame.file_format == file_format


def test_how_opaque_a_pixel_is_makes_no_light(rng):
    values = rng.integers(0, 256, (31, 47, 4)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    assert np.array_equal(read(file.getvalue()).counts, values[..., :3].sum(axis=2))


@pytest.mark.parametrize(
    ("offset", "time"), [("+02:00", "2024-08-11T21:30:01.000Z"), (None, None), ("later", None)]
)
def test_a_jpeg_tells_its_exposure_and_its_time_where_the_clock_s_offset_is_known(offset, time):
    exif = Image.Exif()
    told = exif.get_ifd(0x8769)
    told[33434], told[36867] = 2.0, "2024:08:11 23:30:00"
    if offset is not None:
        told[36881] = offset
    file = io.BytesIO()
    Image.fromarray(np.zeros((32, 32), np.uint8)).save(file, "JPEG", exif=exif)
    frame = read(file.getvalue())
    assert frame.exposure_s == 2.0
    assert frame.time == time


@pytest.mark.parametrize(
    "write",
    [
        png_of_16_bits,
        tiff_of_16_bits,
        lambda values: tiff_of_16_bits(values, ">"),
        lambda values: tiff_of_16_bits(values, packed=True),
        lambda values: tiff_of_16_bits(values, ">", packed=True),
    ],
    ids=["png", "tiff", "tiff of great ends", "tiff deflated", "tiff deflated of great ends"],
)
def test_colours_of_16_bits_keep_all_of_them(rng, write):
    values = colours(rng)
    frame = read(write(values))
    assert np.array_equal(frame.counts, values.sum(axis=2, dtype=np.int64))
    assert frame.full_scale == 3 * 65535


def test_how_opaque_a_pixel_of_16_bits_is_is_not_looked_at(rng):
    values = colours(rng)
    opaque = np.concatenate([values, values[:, :, :1]], axis=2)
    frame = read(png_of_16_bits(opaque))
    assert np.array_equal(frame.counts, values.sum(axis=2, dtype=np.int64))


def test_a_raw_file_without_the_package_is_refused_with_what_to_install(counts, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for data in (dng(counts), b"II*\0\x10\0\0\0CR\2\0", b"FUJIFILMCCD-RAW 0201"):
        with pytest.raises(BadFile, match=r"rawpy: install the extra `raw`"):
            read(data)


def test_of_a_raw_file_the_pattern_is_summed(rng):
    pytest.importorskip("rawpy")
    values = rng.integers(100, 4000, (96, 128)).astype(np.uint16)
    frame = read(dng(values))
    assert frame.file_format == "RAW"
    assert np.array_equal(frame.counts, values.reshape(48, 2, 64, 2).sum(axis=(1, 3)))
    with pytest.raises(BadFile, match="at most 3,000 pixels"):
        read(dng(values), FrameLimits(max_pixels=3000))
    with pytest.raises(BadFile):
        read(dng(values)[:5000])


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (b"BZh91AY&SY", "is packed .*gzip"),
        (b"PK\x03\x04\x14\0", "is packed .*gzip"),
        (b"\0\0\0\x1cftypheic", "is a HEIC or AVIF picture"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "is a WebP picture"),
        (b"\x89HDF\r\n\x1a\n", "is an HDF5 file"),
    ],
)
def test_a_file_in_other_packing_or_of_another_format_is_refused_by_its_name(start, words):
    with pytest.raises(BadFile, match=words):
        read_frame(io.BytesIO(start + bytes(200)), FrameLimits(1_000_000))

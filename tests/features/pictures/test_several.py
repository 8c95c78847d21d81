"""Of several images in one file one is chosen by its number: never the first in silence."""

import gzip
import io
import struct

import numpy as np
import pytest
import tifffile
from PIL import Image

from service.errors import BadFile
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from tests.features.pictures.colour_files import LONG, SHORT, tiff

ROWS, COLUMNS, NUMBER = 24, 40, 3


def read(data, image=None):
    return read_frame(io.BytesIO(data), FrameLimits(100_000, image=image))


def tiff_of(values, **options):
    file = io.BytesIO()
    tifffile.imwrite(file, values, photometric="minisblack", **options)
    return file.getvalue()


def saved(values, file_format, **options):
    first, *others = (Image.fromarray(each) for each in values)
    file = io.BytesIO()
    first.save(file, file_format, save_all=True, append_images=others, **options)
    return file.getvalue()


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def stack_of_meta_morph(values):
    """One directory, whose tag UIC2 has a number of planes as its length."""
    entries = {
        256: (LONG, [COLUMNS]),
        257: (LONG, [ROWS]),
        258: (SHORT, [16]),
        259: (SHORT, [1]),
        262: (SHORT, [1]),
        277: (SHORT, [1]),
        278: (LONG, [ROWS]),
        33629: (LONG, [0] * len(values)),
    }
    return tiff(entries, values.astype("<u2").tobytes(), "<")


FILES = {
    "ImageJ": lambda v: tiff_of(v, imagej=True, metadata={"axes": "TYX"}),
    "ImageJ of the other order": lambda v: tiff_of(v, imagej=True, byteorder=">"),
    "ImageJ of real numbers": lambda v: tiff_of(v.astype("f4"), imagej=True),
    "ImageJ in gzip": lambda v: gzip.compress(tiff_of(v, imagej=True)),
    "OME": lambda v: tiff_of(v, ome=True),
    "pages": lambda v: tiff_of(v, metadata=None),
    "one directory of all": lambda v: tiff_of(v, truncate=True, metadata={"axes": "ZYX"}),
    "MetaMorph": stack_of_meta_morph,
    "moving PNG": lambda v: saved(v.astype("u1"), "PNG"),
    "GIF": lambda v: saved(v.astype("u1"), "GIF"),
    "NPY by rows": lambda v: npy(np.concatenate([v, v[:1]])),
    "NPY by columns": lambda v: npy(np.asfortranarray(np.concatenate([v, v[:1]]))),
}


@pytest.fixture
def values(rng):
    return rng.integers(0, 255, (NUMBER, ROWS, COLUMNS)).astype(np.uint16)


@pytest.mark.parametrize("name", FILES)
def test_one_of_several_images_is_chosen_by_its_number(values, name):
    data = FILES[name](values)
    for number, truth in enumerate(values, 1):
        frame = read(data, str(number))
        # A GIF is in colour, which is summed.
        scale = 3.0 if name == "GIF" else 1.0
        assert np.array_equal(frame.counts, scale * truth)
        assert any(each.startswith(f"image: {number} of ") for each in frame.remarks)


@pytest.mark.parametrize("name", FILES)
def test_of_several_images_none_is_taken_in_silence(values, name):
    data = FILES[name](values)
    with pytest.raises(BadFile, match=f"several images; choose one .*1: {COLUMNS} x {ROWS}, 2: "):
        read(data)
    for wrong in ("0", "9", "SCI", "-1", "1" * 50):
        with pytest.raises(BadFile, match="holds the images 1 to"):
            read(data, wrong)


ONE = {
    "TIFF": lambda v: tiff_of(v[0], metadata=None),
    "ImageJ": lambda v: tiff_of(v[0], imagej=True),
    "OME": lambda v: tiff_of(v[0], ome=True),
    "PNG": lambda v: saved(v[:1], "PNG"),
    "GIF": lambda v: saved(v[:1].astype("u1"), "GIF"),
    "NPY": lambda v: npy(v[0]),
}


@pytest.mark.parametrize("name", ONE)
def test_one_image_is_taken_and_no_other_can_be_chosen(values, name):
    data = ONE[name](values)
    for choice in (None, "1"):
        counts = read(data, choice).counts
        assert np.array_equal(counts, values[0] * (3.0 if name == "GIF" else 1.0))
    with pytest.raises(BadFile, match="holds one image"):
        read(data, "2")


def jpegs_in_one(sizes, rng):
    pictures = [rng.integers(0, 255, (*size, 3)).astype("u1") for size in sizes]
    return saved(pictures, "MPO", quality=95), pictures


def test_images_of_one_size_in_a_jpeg_are_named_and_one_is_chosen(rng):
    data, pictures = jpegs_in_one([(ROWS, COLUMNS)] * 2, rng)
    with pytest.raises(BadFile, match="several images"):
        read(data)
    for number, picture in enumerate(pictures, 1):
        single = io.BytesIO()
        Image.fromarray(picture).save(single, "JPEG", quality=95)
        truth = read(single.getvalue()).counts
        assert np.array_equal(read(data, str(number)).counts, truth)


def test_a_smaller_preview_in_a_jpeg_is_named_in_a_remark(rng):
    data, _ = jpegs_in_one([(ROWS, COLUMNS), (8, 16)], rng)
    frame = read(data)
    assert frame.counts.shape == (ROWS, COLUMNS)
    assert frame.remarks == ("image: 1 was taken; 1 smaller or auxiliary ones are beside it",)
    assert read(data, "2").counts.shape == (8, 16)


def test_three_planes_of_an_array_are_summed_as_colours_with_a_remark(values):
    frame = read(npy(values))
    assert np.array_equal(frame.counts, values.sum(axis=0))
    assert frame.remarks == ("image: its three planes were summed as colours",)
    assert np.array_equal(read(npy(values), ":2").counts, values[1])


def test_portable_maps_one_behind_the_other_are_refused(values):
    one = b"P5 40 24 255\n" + values[0].astype("u1").tobytes()
    assert np.array_equal(read(one).counts, values[0])
    with pytest.raises(BadFile, match="several images"):
        read(one + one)


def test_a_second_sample_that_is_no_opacity_is_named(values):
    file = io.BytesIO()
    planes = {"photometric": "minisblack", "planarconfig": "separate", "metadata": None}
    tifffile.imwrite(file, values[:2], **planes)
    assert any("the first of two samples" in each for each in read(file.getvalue()).remarks)


def test_an_array_with_a_last_axis_of_one_is_one_image(values):
    file = io.BytesIO()
    np.save(file, values[0][..., None])
    assert np.array_equal(read(file.getvalue()).counts, values[0])


def test_a_stack_that_is_cut_off_is_refused(values):
    data = tiff_of(values, imagej=True)
    with pytest.raises(BadFile, match=r"cut off|without data"):
        read(data[: len(data) - ROWS * COLUMNS * 2 - 600], "3")


@pytest.mark.parametrize("images", [257, 10**9, 10**30])
def test_a_number_of_images_without_bounds_is_refused(values, images):
    data = tiff_of(values, imagej=True).replace(b"images=3", b"images=%d" % images)
    with pytest.raises(BadFile):
        read(data, "2")


def test_a_gif_of_endless_images_is_refused_without_decoding_them(values):
    data = saved(values[:1].astype("u1"), "GIF")
    at = data.rindex(b";")
    image = struct.pack("<BHHHHB", 0x2C, 0, 0, 1, 1, 0) + b"\x02\x02\x4c\x01\0"
    with pytest.raises(BadFile, match="more than 256 images"):
        read(data[:at] + image * 100_000 + b";")

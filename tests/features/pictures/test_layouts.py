"""Every layout of a picture gives the counts that were written, or is refused by its name."""

import io
import math
import struct
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image

from service.errors import BadFile
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from tests.features.pictures.colour_files import LONG, SHORT, png_of_16_bits
from tests.features.pictures.colour_files import tiff as tiff_of
from tests.scale import draws

ROWS, COLUMNS = 31, 47


def read(data, **limits):
    return read_frame(io.BytesIO(data), FrameLimits(max_pixels=1_000_000, **limits))


def drawn(rng, kind, *shape):
    shape = shape or (ROWS, COLUMNS)
    if kind[0] == "f":
        return rng.uniform(0.0, 200.0, shape).astype(kind)
    return rng.integers(0, min(np.iinfo(kind).max, 1 << 40), shape).astype(kind)


def tiff(values, **layout):
    file = io.BytesIO()
    tifffile.imwrite(file, values, metadata=None, **({"photometric": "minisblack"} | layout))
    return file.getvalue()


def by_libtiff(values, **layout):
    file = io.BytesIO()
    Image.fromarray(values).save(file, "TIFF", **layout)
    return file.getvalue()


LAYOUTS = [
    {"byteorder": order, "bigtiff": big, **compressed, **parts}
    for order in "<>"
    for big in (False, True)
    for compressed in (
        {},
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True},
    )
    for parts in ({}, {"rowsperstrip": 7}, {"tile": (16, 32)})
]


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "u8", "i2", "i4", "f2", "f4", "f8"])
def test_a_grey_tiff_of_any_layout_is_read_exactly(rng, kind):
    values = drawn(rng, kind)
    for layout in LAYOUTS:
        if (kind[0] == "f" or kind == "u8") and layout.get("predictor"):
            continue
        assert np.array_equal(read(tiff(values, **layout)).counts, values), layout


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "i2", "f2", "f4", "f8"])
@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_a_colour_tiff_is_summed_whether_its_planes_lie_apart_or_not(rng, kind, planes):
    values = drawn(rng, kind, 3, ROWS, COLUMNS)
    written = values if planes == "separate" else np.moveaxis(values, 0, 2).copy()
    total = values.astype(np.float64).sum(axis=0)
    for layout in LAYOUTS:
        if kind[0] == "f" and layout.get("predictor"):
            continue
        for photometric in ("rgb", "minisblack"):
            data = tiff(written, **layout | {"planarconfig": planes, "photometric": photometric})
            assert np.array_equal(read(data).counts, total), (layout, photometric)


@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_how_opaque_a_pixel_of_a_tiff_is_makes_no_light(rng, planes):
    values = drawn(rng, "u2", 4, ROWS, COLUMNS)
    written = values if planes == "separate" else np.moveaxis(values, 0, 2).copy()
    layout = {"planarconfig": planes, "photometric": "rgb", "extrasamples": ["unassalpha"]}
    frame = read(tiff(written, **layout))
    assert np.array_equal(frame.counts, values[:3].sum(axis=0, dtype=np.int64))
    assert frame.full_scale == 3 * 65535
    grey = values[:2] if planes == "separate" else np.moveaxis(values[:2], 0, 2).copy()
    layout = {"planarconfig": planes, "extrasamples": ["unassalpha"]}
    assert np.array_equal(read(tiff(grey, **layout)).counts, values[0])


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_deflate", "zstd", "lzma"])
@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_what_libtiff_packed_is_read_exactly(rng, kind, compression):
    values = drawn(rng, kind)
    for tags in ({}, {317: 2}, {317: 3}):
        if tags and (compression == "packbits" or (tags == {317: 3}) != (kind == "f4")):
            continue
        data = by_libtiff(values, compression=compression, tiffinfo=tags)
        assert np.array_equal(read(data).counts, values)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8"])
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("samples", [1, 3])
def test_floating_numbers_stored_as_differences_are_read_exactly(rng, kind, order, samples):
    values = drawn(rng, kind, ROWS, COLUMNS, samples)
    item = values.dtype.itemsize
    stored = values.astype(values.dtype.newbyteorder(">")).view(np.uint8)
    stored = stored.reshape(ROWS, COLUMNS * samples, item).transpose(0, 2, 1)
    stored = np.ascontiguousarray(stored).reshape(ROWS, COLUMNS * item, samples)
    stored[:, 1:] -= stored[:, :-1].copy()
    entries = {
        256: (LONG, [COLUMNS]),
        257: (LONG, [ROWS]),
        258: (SHORT, [8 * item] * samples),
        259: (SHORT, [8]),
        262: (SHORT, [2 if samples == 3 else 1]),
        277: (SHORT, [samples]),
        278: (LONG, [ROWS]),
        284: (SHORT, [1]),
        317: (SHORT, [3]),
        339: (SHORT, [3] * samples),
    }
    frame = read(tiff_of(entries, zlib.compress(stored.tobytes()), order))
    assert np.array_equal(frame.counts, values.sum(axis=2, dtype=np.float64))


@pytest.mark.parametrize("kind", ["u1", "u2", "u4"])
def test_where_white_is_zero_the_counts_are_turned_over(rng, kind):
    values = drawn(rng, kind)
    written = np.iinfo(kind).max - values
    for layout in ({}, {"compression": "zlib", "predictor": True}, {"byteorder": ">"}):
        frame = read(tiff(written, **layout | {"photometric": "miniswhite"}))
        assert np.array_equal(frame.counts, values)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda v: tiff(v.astype("c8")), "kind that is not read"),
        (lambda v: tiff(v > 30, photometric="minisblack"), "bit a pixel"),
        (lambda v: tiff(v.astype("f4"), photometric="miniswhite"), "white as zero"),
        (lambda v: tiff(np.stack([v] * 5), planarconfig="separate"), "not named as colours"),
        (lambda v: with_tag(tiff(v), 262, 8), "CIELAB"),
        (lambda v: with_tag(tiff(v), 259, 34712), "JPEG2000"),
        (lambda v: with_tag(tiff(v), 258, 12), "12 bits"),
        (lambda v: with_tag(tiff(v), 277, 7), "not named as colours"),
        (lambda v: with_tag(tiff(v), 256, COLUMNS - 1), "another size"),
        (lambda v: with_tag(tiff(v), 278, 3), "number of strips"),
        # Its pixels would be out of place, and an attitude from them wrong.
        (lambda v: with_tag(tiff(v), 273, 16), "over its tags"),
        (lambda v: with_first_strip_moved(tiff(v, rowsperstrip=7), 2), "over each other"),
        (lambda v: with_first_strip_moved(tiff(v, rowsperstrip=7), 14 * COLUMNS), "not blank"),
    ],
)
def test_what_is_not_read_of_a_tiff_is_refused_by_its_name(rng, make, word):
    with pytest.raises(BadFile, match=word) as refusal:
        read(make(drawn(rng, "u2")))
    assert "Buffered" not in str(refusal.value)


def test_blank_strips_of_a_tiff_may_share_their_bytes():
    values = np.full((ROWS, COLUMNS), 7, "u2")
    data = with_first_strip_moved(tiff(values, rowsperstrip=7), 14 * COLUMNS)
    assert np.array_equal(read(data).counts, values)


def with_tag(data, tag, value):
    """A little-endian TIFF with the value of a tag of one number replaced."""
    data = bytearray(data)
    (at,) = struct.unpack_from("<L", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        if struct.unpack_from("<H", data, entry)[0] == tag:
            struct.pack_into("<HLL", data, entry + 2, 4, 1, value)
    return bytes(data)


def with_first_strip_moved(data, by):
    """A little-endian TIFF of several strips whose first one is said to begin elsewhere."""
    with tifffile.TiffFile(io.BytesIO(data)) as opened:
        offsets = opened.pages[0].tags["StripOffsets"]
        place, first = offsets.valueoffset, offsets.value[0]
    form = "<H" if offsets.dtype == tifffile.DATATYPE.SHORT else "<L"
    data = bytearray(data)
    struct.pack_into(form, data, place, first + by)
    return bytes(data)


def test_of_a_tiff_with_several_pages_one_is_chosen(rng):
    file = io.BytesIO()
    pages = drawn(rng, "u2", 3, ROWS, COLUMNS)
    with tifffile.TiffWriter(file) as writer:
        for page in pages:
            writer.write(page, photometric="minisblack", metadata=None)
        writer.write(pages[0, ::4, ::4].copy(), subfiletype=1, metadata=None)
    for number in (1, 2, 3):
        frame = read(file.getvalue(), image=str(number))
        assert np.array_equal(frame.counts, pages[number - 1])
        assert frame.remarks == (f"image: {number} of 4 was chosen",)
    for choice, word in ((None, "several images"), ("5", "images 1 to 4"), ("SCI", "images 1 to")):
        with pytest.raises(BadFile, match=word):
            read(file.getvalue(), image=choice)


def test_a_small_copy_in_a_tiff_is_not_taken_for_the_picture(rng):
    file = io.BytesIO()
    values = drawn(rng, "u2")
    with tifffile.TiffWriter(file) as writer:
        writer.write(values[::4, ::4].copy(), subfiletype=1, metadata=None)
        writer.write(values, photometric="minisblack", metadata=None)
    assert np.array_equal(read(file.getvalue()).counts, values)


@pytest.mark.parametrize("largest", [255, 1023, 65535])
def test_grey_of_16_bits_with_opacity_keeps_all_of_them(rng, largest):
    grey = rng.integers(0, largest + 1, (ROWS, COLUMNS))
    for opaque in (np.full_like(grey, 65535), rng.integers(0, 65536, grey.shape)):
        frame = read(png_of_16_bits(np.stack([grey, opaque], axis=2)))
        assert np.array_equal(frame.counts, grey)
        assert frame.full_scale == 65535.0


SHOWN = {
    1: lambda v: v,
    2: lambda v: v[:, ::-1],
    3: lambda v: v[::-1, ::-1],
    4: lambda v: v[::-1],
    5: lambda v: v.T,
    6: lambda v: np.rot90(v, -1),
    7: lambda v: np.rot90(v, 2).T,
    8: lambda v: np.rot90(v),
}
"""By the orientation tag: the picture that is shown, as EXIF 2.32 names its rows and columns."""


def with_orientation(values, file_format, tag):
    if file_format == "BigTIFF":
        return tiff(values, bigtiff=True, extratags=[(274, 3, 1, tag)])
    exif = Image.Exif()
    exif[274] = tag
    file = io.BytesIO()
    Image.fromarray(values).save(file, file_format, exif=exif)
    return file.getvalue()


@pytest.mark.parametrize("tag", SHOWN)
@pytest.mark.parametrize("file_format", ["TIFF", "BigTIFF", "PNG", "JPEG", "palette"])
def test_a_picture_is_read_as_it_is_shown_in_every_format(rng, file_format, tag):
    # Blocks of one grey: a JPEG keeps them.
    values = np.kron(rng.integers(0, 25, (4, 6)) * 10, np.ones((8, 8))).astype(np.uint8)
    if file_format == "palette":
        file = io.BytesIO()
        Image.fromarray(values).convert("P").save(file, "TIFF", tiffinfo={274: tag})
        frame, scale = read(file.getvalue()), 3
    else:
        frame, scale = read(with_orientation(values, file_format, tag)), 1
    shown = SHOWN[tag](values).astype(float) * scale
    assert frame.counts.shape == shown.shape
    assert np.abs(frame.counts - shown).max() <= 2
    assert frame.is_turned == (tag != 1)
    assert (f"orientation tag {tag}" in frame.orientation) == (tag != 1)


def test_the_size_that_a_tracker_needs_is_that_of_the_picture_shown(rng):
    values = drawn(rng, "u1")
    for file_format in ("TIFF", "PNG", "JPEG"):
        data = with_orientation(values, file_format, 6)
        assert read(data, shape=(COLUMNS, ROWS)).counts.shape == (COLUMNS, ROWS)
        with pytest.raises(BadFile, match="must have the 47 x 31 px"):
            read(data, shape=(ROWS, COLUMNS))


JPEGS = {
    "plain": {},
    "codes of its own": {"optimize": True},
    "progressive": {"progressive": True},
    "restarts": {"optimize": True, "restart_marker_blocks": 5},
}


def jpeg(values, **options):
    file = io.BytesIO()
    Image.fromarray(values).save(file, "JPEG", **{"quality": 60, **options})
    return file.getvalue()


@pytest.mark.parametrize("name", JPEGS)
def test_a_jpeg_with_a_changed_bit_is_refused_or_ends_in_its_place(rng, name):
    # Neither black nor full anywhere, so that a block out of its place shows in the last rows.
    values = np.kron(rng.integers(90, 160, (9, 12)), np.ones((8, 8))) + rng.normal(0, 6, (72, 96))
    data = jpeg(values.astype(np.uint8), **JPEGS[name])
    truth, scan, refused, moved = read(data).counts, data.find(b"\xff\xda") + 10, 0, 0
    tries = draws(100, 1_000)
    for at in rng.integers(scan, len(data) - 8, tries):
        damaged = bytearray(data)
        damaged[at] ^= 1 << rng.integers(8)
        try:
            frame = read(bytes(damaged))
        except BadFile as error:
            refused += "damaged" in str(error)
            continue
        # A changed mean of a block changes all that follow alike; the last may be changed itself.
        change = (frame.counts - truth)[-8:, 48:]
        moved += np.ptp(change) > 60
    assert refused > 5
    # Three in a hundred, within three standard deviations of the count.
    assert moved <= 0.03 * tries + 3.0 * math.sqrt(0.03 * tries)


def test_a_jpeg_with_a_byte_more_or_less_is_refused_where_pillow_reads_it(rng):
    data = jpeg(rng.integers(60, 190, (64, 64)).astype(np.uint8))
    for changed in (data[:-2] + b"\0" + data[-2:], data[:-3] + data[-2:]):
        assert Image.open(io.BytesIO(changed)).tobytes()
        with pytest.raises(BadFile, match="a damaged JPEG"):
            read(changed)
        with pytest.raises(BadFile, match="a damaged JPEG"):
            read(in_a_tiff(changed))
    assert np.array_equal(read(in_a_tiff(data)).counts, read(data).counts)


def in_a_tiff(data):
    """A TIFF of 64 by 64 pixels whose only strip is a JPEG file."""
    tags = {256: 64, 257: 64, 258: 8, 259: 7, 262: 1, 273: 512, 277: 1, 278: 64, 279: len(data)}
    entries = b"".join(struct.pack("<HHLL", tag, 4, 1, value) for tag, value in tags.items())
    head = b"II*\0" + struct.pack("<LH", 8, len(tags)) + entries + bytes(4)
    return head.ljust(512, b"\0") + data


@pytest.mark.parametrize(("tag", "value"), [(278, 40), (278, 15), (278, 17), (278, 8), (257, 70)])
def test_strips_of_jpeg_data_out_of_their_places_are_refused(rng, tag, value):
    """With other rows a strip, or more rows of all, libtiff leaves rows out without an error."""
    greys = np.kron(rng.integers(60, 190, (15, 16)), np.ones((4, 4))).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(greys).save(file, "TIFF", compression="jpeg", strip_size=64 * 16)
    data = file.getvalue()
    assert read(data).counts.shape == (60, 64)
    with pytest.raises(BadFile, match="strips"):
        read(with_tag(data, tag, value))


def test_a_jpeg_may_end_in_zeros_where_ones_are_usual(rng):
    read_ones = 0
    for _ in range(8):
        greys = np.kron(rng.integers(60, 190, (4, 4)), np.ones((4, 4)))
        data = bytearray(jpeg(greys.astype(np.uint8)))
        # The end of a block, 1010, ends with a zero: what is behind it is no code.
        ones = len(f"{data[-3]:08b}") - len(f"{data[-3]:08b}".rstrip("1"))
        before = read(bytes(data)).counts
        data[-3] &= 0xFF << ones & 0xFF
        assert np.array_equal(read(bytes(data)).counts, before)
        read_ones += ones > 0
    assert read_ones > 0


def pgm(values, largest, magic=b"P5"):
    kind = ">u2" if largest > 255 else "u1"
    head = b"%s\n# a comment\n%d %d\n%d\n" % (magic, values.shape[1], values.shape[0], largest)
    return head + values.astype(kind).tobytes()


@pytest.mark.parametrize("largest", [255, 100, 1023, 4095, 65535])
def test_a_portable_map_has_the_counts_that_were_written(rng, largest):
    grey = rng.integers(0, largest + 1, (ROWS, COLUMNS))
    frame = read(pgm(grey, largest))
    assert np.array_equal(frame.counts, grey)
    assert frame.full_scale == largest
    colours = rng.integers(0, largest + 1, (ROWS, COLUMNS, 3))
    frame = read(pgm(colours, largest, b"P6"))
    assert np.array_equal(frame.counts, colours.sum(axis=2))
    assert frame.full_scale == 3 * largest


def test_portable_maps_that_are_cut_off_or_of_bits_are_refused(rng):
    grey = rng.integers(0, 4096, (ROWS, COLUMNS))
    with pytest.raises(BadFile, match="cut off"):
        read(pgm(grey, 4095)[:-1])
    with pytest.raises(BadFile, match="text of more than 8 bits"):
        read(b"P3\n1 1\n1000\n1 2 3\n")
    assert read(b"P2\n3 2\n255\n1 2 3 4 5 6\n").counts.tolist() == [[1, 2, 3], [4, 5, 6]]

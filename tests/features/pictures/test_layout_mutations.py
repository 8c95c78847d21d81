"""A file with a damaged layout gives its own pixels, a refusal, or no wrong attitude."""

import io
import struct
from hashlib import sha256
from random import Random

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from service.errors import BadFile
from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from tests.mutations import with_right_sums
from tests.scale import size

MUTATIONS = 1_000_000
SITTING = 60
"""Of each file in `make test`."""
SOLVED = 2_500
"""Of the pictures that came out different, so many are solved, each once: it takes a second."""
LIMITS = FrameLimits(1_000_000)
RIGHT_RAD = 2e-3
PIXELS = np.array([100.0, 500.0, 300.0]), np.array([100.0, 90.0, 200.0])
FITS_WORDS = (
    *(b"BITPIX", b"NAXIS1", b"NAXIS2", b"NAXIS3"),
    *(b"BZERO", b"BSCALE", b"BLANK", b"ROWORDER"),
)
END = b"END".ljust(80)


def saved(counts, file_format, **more):
    file = io.BytesIO()
    Image.fromarray(counts).save(file, file_format, **more)
    return file.getvalue()


def tiff(counts, **layout):
    file = io.BytesIO()
    tifffile.imwrite(file, counts, metadata=None, **layout)
    return file.getvalue()


def fits_file(counts):
    file = io.BytesIO()
    fits.PrimaryHDU(counts.astype(np.uint16)).writeto(file)
    return file.getvalue()


FILES = {
    "planar TIFF of 16 bits": lambda v: tiff(
        np.stack([v.astype("u2")] * 3), photometric="rgb", planarconfig="separate"
    ),
    "big-endian TIFF in tiles": lambda v: tiff(
        v.astype("u2"), byteorder=">", tile=(128, 128), compression="zlib", predictor=True
    ),
    "TIFF in strips": lambda v: tiff(v, photometric="minisblack", rowsperstrip=64),
    "PNG": lambda v: saved(v, "PNG"),
    "JPEG": lambda v: saved(v, "JPEG", quality=95),
    "JPEG with codes of its own": lambda v: saved(v, "JPEG", quality=50, optimize=True),
    "progressive JPEG": lambda v: saved(v, "JPEG", quality=80, progressive=True),
    "JPEG in colour with restarts": lambda v: saved(
        np.stack([v] * 3, axis=2), "JPEG", optimize=True, restart_marker_rows=8
    ),
    "TIFF of JPEG strips": lambda v: saved(v, "TIFF", compression="jpeg", quality=80),
    "FITS": fits_file,
}


def mutated(data, name, draw):
    """The file with one field of its layout replaced; of a JPEG, any byte."""
    data = bytearray(data)
    if "JPEG" in name and draw.random() < 0.5:
        scan = data.find(b"\xff\xda")
        data[draw.randrange(scan, len(data))] = draw.randrange(256)
    elif "TIFF" in name:
        order = "<" if data[:2] == b"II" else ">"
        (at,) = struct.unpack_from(order + "L", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        entry = at + 2 + 12 * draw.randrange(count)
        place, form = draw.choice(((0, "H"), (2, "H"), (4, "L"), (8, "H"), (8, "L")))
        struct.pack_into(order + form, data, entry + place, _number(draw, form))
    elif name == "FITS":
        word = draw.choice(FITS_WORDS)
        at = data.find(word.ljust(8) + b"=")
        if at < 0:
            at = data.index(END)
            data[at + 80 : at + 160] = END
        values = (
            "1",
            "2",
            "3",
            "8",
            "16",
            "-32",
            "639",
            "T",
            "'BOTTOM-UP'",
            str(_number(draw, "L")),
        )
        data[at : at + 80] = f"{word.decode():<8}= {draw.choice(values):>20}".ljust(80).encode()
    else:
        places = range(2, data.find(b"\xff\xda") + 10 if "JPEG" in name else 33)
        data[draw.choice(places)] = draw.randrange(256)
        data = bytearray(with_right_sums(bytes(data))) if name == "PNG" else data
    return bytes(data)


def _number(draw, form):
    largest = 1 << (16 if form == "H" else 32)
    small = draw.choice((0, 1, 2, 3, 4, 5, 6, 8, 16, 32, 64, 255, 256, 257, 262, 284, 317, 640))
    return draw.choice((small, small, draw.randrange(largest)))


@pytest.mark.torture
@pytest.mark.parametrize("name", FILES)
def test_a_damaged_layout_gives_no_wrong_attitude(blind, picture, name, seed, figures):
    data = FILES[name](picture.counts)
    truth = read_frame(io.BytesIO(data), LIMITS).counts
    draw = Random(seed)
    count, most = size(MUTATIONS, SITTING), size(SOLVED, 2)
    same, refused, solved = 0, 0, set()
    for _ in range(count):
        try:
            frame = read_frame(io.BytesIO(mutated(data, name, draw)), LIMITS)
        except BadFile:
            refused += 1
            continue
        if np.array_equal(frame.counts, truth):
            same += 1
        elif len(solved) < most and (key := _key(frame)) not in solved:
            solved.add(key)
            _require_right_or_none(frame, blind, picture)
    figures(mutations=count, same=same, refused=refused, solved=len(solved))
    assert refused > 0
    # Few of strips of JPEG change nothing: of those in a sitting perhaps none.
    assert same > 0 or count == SITTING


def _key(frame):
    counts = np.ascontiguousarray(frame.counts)
    return frame.orientation, counts.shape, counts.dtype.str, sha256(counts).digest()


def _require_right_or_none(frame, blind, picture):
    try:
        result = solve_picture(frame, *blind, picture.lens.focal_px)
    except BadFile:
        return
    if result.attitude is None or result.frame.is_turned:
        # Where the damage is the orientation itself, the answer says so.
        return
    # Fewer rows than were written are a picture too: its pixels see the same sky.
    found = result.attitude
    seen = found.directions(*PIXELS) @ found.attitude
    true = picture.lens.directions(*PIXELS) @ picture.attitude
    assert np.linalg.norm(seen - true, axis=1).max() < RIGHT_RAD, seen

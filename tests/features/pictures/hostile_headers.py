"""Picture files with one place, size or kind of their headers replaced by an absurd one."""

import gzip
import io
import re
import struct
import zlib

import numpy as np
import tifffile
from astropy.io import fits
from PIL import Image

ROWS, COLUMNS = 48, 64
WHOLE = (
    *(0, 1, 2, 3, 4, 7, 8, 16, 32, 47, 64, 100, 255, 256, 2880, 32767, 32768, 65535, 65536),
    *(10**6, 10**9, 2**31 - 1, 2**31, 2**32 - 1, 2**40 - 1, 2**40, 10**18),
    *(2**62, 2**63 - 1, 2**63, 2**64 - 8, 2**64 - 1),
)
WORDS = ("T", "F", "'many'", "NaN", "-1", "-32", "-64", "1E999", "-1E300", "", "1E20", "'1PB(9)'")
SHAPES = ("True, 10", "10, True", "-1, 10", "10**9, 10**9", "0, 0", "1e3, 5", "None", "3, 3, 3", "")
KINDS = ("|O", "<f2", "<f8", ">i8", "|b1", "<c16", "<f16", "<M8[s]", "|S9", "|V8", "<u9")


def sky(rng, dtype=np.uint16):
    """Counts (rows, columns) with noise and some light."""
    counts = rng.normal(100.0, 5.0, (ROWS, COLUMNS))
    counts[rng.integers(0, ROWS, 9), rng.integers(0, COLUMNS, 9)] += 90.0
    return counts.astype(dtype)


def _fits(*units):
    file = io.BytesIO()
    fits.HDUList(list(units)).writeto(file)
    return file.getvalue()


def _packed(values, method, **more):
    return _fits(fits.PrimaryHDU(), fits.CompImageHDU(values, compression_type=method, **more))


def _tiff(values, **layout):
    file = io.BytesIO()
    tifffile.imwrite(file, values, **({"metadata": None} | layout))
    return file.getvalue()


def _saved(values, file_format, **more):
    file = io.BytesIO()
    Image.fromarray(values).save(file, file_format, **more)
    return file.getvalue()


def _npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def good_files(rng):
    """The bytes of a good file of every format and layout, by name."""
    deep, plain, real = sky(rng), sky(rng, np.uint8), sky(rng, np.float32)
    colours = np.stack([plain] * 3, axis=2)
    stack = [Image.fromarray(np.roll(plain, k)) for k in range(1, 3)]
    return {
        "FITS": _fits(fits.PrimaryHDU(deep)),
        "FITS of 64 bits": _fits(fits.PrimaryHDU(real.astype("f8"))),
        "FITS with an empty unit": _fits(fits.PrimaryHDU(), fits.ImageHDU(deep)),
        "FITS cube": _fits(fits.PrimaryHDU(np.stack([plain] * 3))),
        "FITS in tiles of Rice": _packed(deep, "RICE_1"),
        "FITS in tiles of gzip": _packed(deep, "GZIP_2", tile_shape=(16, 16)),
        "FITS of numbers in tiles": _packed(real, "RICE_1"),
        "FITS in gzip": gzip.compress(_fits(fits.PrimaryHDU(deep))),
        "TIFF": _tiff(deep),
        "TIFF of the other order": _tiff(deep, byteorder=">"),
        "TIFF in tiles": _tiff(deep, tile=(16, 16), compression="zlib", predictor=True),
        "TIFF of JPEG": _saved(plain, "TIFF", compression="jpeg", quality=80),
        "BigTIFF": _tiff(deep, bigtiff=True),
        "BigTIFF of the other order": _tiff(real, bigtiff=True, byteorder=">"),
        "TIFF of ImageJ": _tiff(np.stack([deep] * 3), imagej=True, metadata={}),
        "PNG": _saved(deep, "PNG"),
        "PNG in colour": _saved(colours, "PNG"),
        "PNG of several": _saved(plain, "PNG", save_all=True, append_images=stack),
        "JPEG": _saved(plain, "JPEG", quality=90),
        "progressive JPEG": _saved(colours, "JPEG", progressive=True),
        "MPO": _saved(colours, "MPO", save_all=True, append_images=[Image.fromarray(colours)]),
        "GIF": _saved(plain, "GIF"),
        "GIF of several": _saved(plain, "GIF", save_all=True, append_images=stack),
        "BMP": _saved(plain, "BMP"),
        "BMP in colour": _saved(colours, "BMP"),
        "PGM": _saved(deep, "PPM"),
        "PPM": _saved(colours, "PPM"),
        "PGM in text": b"P2\n64 48\n255\n" + b" ".join(b"%d" % n for n in plain.ravel().tolist()),
        "NPY": _npy(deep),
        "NPY of real numbers": _npy(real),
    }


def with_absurd_header(name, data, draw):
    """The file with one or two of its header's numbers replaced, or cut off, by a `Random`."""
    if name == "FITS in gzip":
        return gzip.compress(with_absurd_header("FITS", gzip.decompress(data), draw), 1)
    change = next(each for word, each in _CHANGES.items() if word in name)
    for _ in range(draw.choice((1, 1, 1, 2))):
        data = change(data, draw)
    return data[: draw.randrange(len(data))] if draw.random() < 0.05 else data


def _in_fits(data, draw):
    cards = [
        at
        for at in range(0, len(data) - 80, 80)
        if data[at + 8 : at + 10] == b"= " and data[at : at + 3].isalpha()
    ]
    at = draw.choice(cards)
    key = data[at : at + 8]
    if draw.random() < 0.1:
        key = draw.choice((b"NAXIS3  ", b"PCOUNT  ", b"GCOUNT  ", b"BLANK   ", b"THEAP   "))
    value = draw.choice((*WORDS, *map(str, WHOLE), *map(str, WHOLE)))
    return data[:at] + (key + f"= {value:>20}".encode()).ljust(80) + data[at + 80 :]


def _in_tiff(data, draw):
    data = bytearray(data)
    order, big = "<" if data[:2] == b"II" else ">", data[2:4] in (b"+\0", b"\0+")
    word = "Q" if big else "L"
    size = struct.calcsize(order + word)
    if draw.random() < 0.15:
        _put(data, order + word, 8 if big else 4, draw)
        return bytes(data)
    (at,) = struct.unpack_from(order + word, data, 8 if big else 4)
    if at + 8 > len(data):
        return bytes(data)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    entry_bytes, count_bytes = (20, 8) if big else (12, 2)
    entry = at + count_bytes + entry_bytes * draw.randrange(min(count, 20) + 1)
    places = ((0, "H"), (2, "H"), (4, word), (4 + size, word), (4 + size, "H"), (4 + size, "L"))
    place, form = draw.choice(places)
    _put(data, order + form, entry + place, draw)
    return bytes(data)


def _put(data, form, at, draw):
    size = struct.calcsize(form)
    if at + size <= len(data):
        struct.pack_into(form, data, at, draw.choice(WHOLE) % (1 << (8 * size)))


def _in_png(data, draw):
    data, places, at = bytearray(data), [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">L", data, at)
        places.append((at, length))
        at += 12 + length
    at, length = draw.choice((places[0], draw.choice(places)))
    place = draw.choice((0, *range(8, min(8 + length, 40))))
    form = draw.choice(("B", ">L"))
    _put(data, form, at + place, draw)
    if place and at + 12 + length <= len(data):
        right = zlib.crc32(data[at + 4 : at + 8 + length])
        struct.pack_into(">L", data, at + 8 + length, right)
    return bytes(data)


def _in_bytes(data, draw, start=2, end=64):
    data = bytearray(data)
    form = draw.choice(("B", "B", "<H", ">H", "<L", ">L"))
    _put(data, form, draw.randrange(start, min(end, len(data))), draw)
    return bytes(data)


def _in_jpeg(data, draw):
    marks = [found.start() for found in re.finditer(rb"\xff[\xc0-\xfe]", data)]
    at = draw.choice(marks)
    return _in_bytes(data, draw, at + 1, at + 24)


def _in_text(data, draw):
    tokens = re.split(rb"(\s+)", data[:40], maxsplit=4)
    tokens[draw.choice((0, 2, 4, 6))] = draw.choice(
        (*(b"%d" % n for n in WHOLE), b"-1", b"x", b"P1", b"P4", b"P6", b"Pf", b"#")
    )
    return b"".join(tokens) + data[40:]


def _in_npy(data, draw):
    (length,) = struct.unpack_from("<H", data, 8)
    text = data[10 : 10 + length].decode("latin-1")
    kind = draw.randrange(5)
    if kind == 0:
        text = re.sub(r"\(.*?\)", f"({draw.choice(SHAPES)})", text)
    elif kind == 1:
        text = re.sub(r"\d+(?=, )", str(draw.choice(WHOLE)), text, count=1)
    elif kind == 2:
        text = re.sub(r"'[<>|][a-z]\d+'", f"'{draw.choice(KINDS)}'", text)
    elif kind == 3:
        text = text.replace("False", draw.choice(("True", "2", "None", "'no'")))
    else:
        return _in_bytes(data, draw, 6, 12)
    return data[:8] + struct.pack("<H", len(text)) + text.encode("latin-1") + data[10 + length :]


_CHANGES = {
    "FITS": _in_fits,
    "TIFF": _in_tiff,
    "PNG": _in_png,
    "JPEG": _in_jpeg,
    "MPO": _in_jpeg,
    "GIF": _in_bytes,
    "BMP": _in_bytes,
    "PGM": _in_text,
    "PPM": _in_text,
    "NPY": _in_npy,
}


def _cards(**values):
    text = "".join(f"{key:<8}= {value:>20}".ljust(80) for key, value in values.items())
    return (text + "END".ljust(80)).encode().ljust(2880)


def _with_card(data, key, value):
    at = data.index(key.ljust(8).encode() + b"=")
    return data[:at] + f"{key:<8}= {value:>20}".ljust(80).encode() + data[at + 80 :]


def _bomb(rng):
    """A FITS image in tiles of gzip, one of which unfolds into 64 MB."""
    good = _packed(sky(rng), "GZIP_1", tile_shape=(ROWS, COLUMNS))
    zeros = gzip.compress(bytes(64 << 20), 9)
    table = good.index(b"XTENSION") + 2880
    while b"END     " not in good[table - 2880 : table]:
        table += 2880
    row_bytes = int(re.search(rb"NAXIS1  = +(\d+)", good[2880:])[1])
    row = struct.pack(">ll", len(zeros), 0).ljust(row_bytes, b"\0")
    head = _with_card(good[2880:table], "PCOUNT", len(zeros))
    return good[:2880] + head + (row + zeros).ljust(-(-(row_bytes + len(zeros)) // 2880) * 2880)


def absurd_files(rng):
    """(bytes, word of the refusal) by name: headers whose places and sizes lie in no file."""
    deep = sky(rng)
    huge = {"BITPIX": -64, "NAXIS": 2, "NAXIS1": 10**9, "NAXIS2": 10**9}
    first = {"SIMPLE": "T", "BITPIX": 8, "NAXIS": 0}
    image = _fits(fits.PrimaryHDU(deep))
    rice, big = _packed(deep, "RICE_1"), "1000000000 x 1000000000 px"
    found = {
        "FITS of 8 EB": (_cards(SIMPLE="T", **huge), big),
        "FITS of 8 EB in gzip": (gzip.compress(_cards(SIMPLE="T", **huge)), big),
        "FITS of 8 EB behind an empty header": (
            _cards(**first) + _cards(XTENSION="'IMAGE   '", **huge),
            big,
        ),
        "FITS of 8 EB in front of an image": (
            _cards(**first, EXTEND="T")
            + _cards(XTENSION="'BINTABLE'", **huge, PCOUNT=0, GCOUNT=1)
            + image,
            "no image",
        ),
        "the 2**59th plane of a FITS cube": (
            _cards(SIMPLE="T", BITPIX=8, NAXIS=3, NAXIS1=64, NAXIS2=48, NAXIS3=2**39),
            "cube",
        ),
        "FITS in tiles of no bytes a pixel": (_with_card(rice, "ZVAL2", -32), "ZVAL2"),
        "FITS in tiles of blocks of nothing": (_with_card(rice, "ZVAL1", 0), "ZVAL1"),
        "FITS in tiles beyond the data": (_with_card(rice, "PCOUNT", 10), "beyond its data"),
        "a tile of gzip of 64 MB": (_bomb(rng), "unfolds into more"),
        "npy of a truth value": (_shaped("True, 10"), "whole numbers"),
        "npy of nothing": (_shaped("0, 10"), "no pixels"),
        "npy of a negative size": (_shaped("-1, 10"), "no pixels"),
    }
    for order in "<>":
        mark = b"II" if order == "<" else b"MM"
        for power in (33, 62, 63, 64):
            head = mark + struct.pack(order + "HHHQ", 43, 8, 0, 2**power - 1)
            found[f"BigTIFF at 2**{power} {order}"] = (head, "BigTIFF directory lies beyond")
        tall = bytearray(_tiff(deep, bigtiff=True, byteorder=order))
        (at,) = struct.unpack_from(order + "Q", tall, 8)
        for entry in range(at + 8, at + 8 + 20 * 6, 20):
            if struct.unpack_from(order + "H", tall, entry)[0] in (256, 257):
                struct.pack_into(order + "HQQ", tall, entry + 2, 16, 1, 2**62)
        found[f"BigTIFF of 2**62 pixels a side {order}"] = (bytes(tall), "px")
    return found


def _shaped(shape):
    text = f"{{'descr': '<u2', 'fortran_order': False, 'shape': ({shape})}}".ljust(117) + "\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text.encode() + bytes(6144)

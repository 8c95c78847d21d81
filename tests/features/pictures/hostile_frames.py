"""Files that are made to harm a reader of frames, by name, with a word of the refusal."""

import io
import struct
import zlib
from functools import partial

import numpy as np
from PIL import Image

from service.features.pictures.frames.fits import write_fits

SIDE = 1024


def hostile_files(rng):
    """(name, maker of the bytes, word that the refusal must hold)."""
    sky = rng.normal(207.0, 6.0, (SIDE, SIDE)).astype(np.uint16)
    whole = _fits(sky)
    yield "empty", lambda: b"", "empty"
    yield "text", lambda: b"hello, this is no frame", "is not FITS"
    yield "bigtiff", lambda: b"II+\0\x08\0\0\0", "BigTIFF"
    yield "pds3", lambda: b"PDS_VERSION_ID = PDS3\r\nRECORD_TYPE = FIXED_LENGTH\r\n", "a PDS3 file"
    yield "pds3 behind an SFDU", lambda: b"CCSD3ZF0000100000001NJPL3IF0PDS200000001", "a PDS3 file"
    yield "pds4", lambda: b'<?xml version="1.0"?><Product_Observational>', "PDS4"
    yield "xisf", lambda: b"XISF0100" + bytes(100), "XISF"
    yield "ser", lambda: b"LUCAM-RECORDER" + bytes(178), "SER"
    yield "fits cut off in its header", lambda: whole[:2000], "cut off"
    yield "fits cut off in its data", lambda: whole[:100_000], "cut off"
    yield (
        "fits without end",
        lambda: b"SIMPLE  =                    T".ljust(2880 * 200),
        "without END",
    )
    for key, value in (
        ("NAXIS1", 10**13),
        ("NAXIS1", -5),
        ("NAXIS2", 10**400),
        ("NAXIS", 10**6),
        ("BITPIX", 7),
        ("NAXIS1", "'many'"),
        ("BSCALE", "NaN"),
        ("BZERO", "1E999"),
        ("BSCALE", 0),
    ):
        yield f"fits {key} {str(value)[:12]}", partial(_fits_with, whole, key, value), key
    yield (
        "fits of tables alone",
        lambda: _header(NAXIS=0) + _header(XTENSION="'BINTABLE'", NAXIS=0),
        "no image",
    )
    yield "fits tiles", lambda: _header(NAXIS=0, ZIMAGE="T"), "ZNAXIS"
    yield "one pixel", lambda: _fits(sky[:1, :1]), "1 x 1 px"
    yield "twenty thousand wide", lambda: _fits(np.zeros((2, 20_000), np.uint16)), "20000 x 2 px"
    yield "png bomb", lambda: _png(20_000, 20_000, 0), "400000000 pixels"
    yield "png of more than it says", lambda: _png(SIDE, SIDE, 0, bytes(200 << 20)), "no contrast"
    yield "png text bomb", lambda: _png(SIDE, SIDE, 0, chunk=_text_bomb()), "PNG"
    yield "png profile bomb", lambda: _png(SIDE, SIDE, 0, chunk=_profile_bomb()), "PNG"
    yield "png cut off", lambda: _picture(sky, "PNG")[:50_000], "PNG"
    yield "colour", lambda: _picture(np.zeros((SIDE, SIDE, 3), np.uint8), "PNG"), "no contrast"
    yield (
        "colour tiff",
        lambda: _picture(np.zeros((SIDE, SIDE, 3), np.uint8), "TIFF"),
        "no contrast",
    )
    yield "a bit a pixel", lambda: _picture(np.zeros((SIDE, SIDE), bool), "PNG"), "a bit a pixel"
    grey = np.clip(sky, 0, 255).astype(np.uint8)
    yield "jpeg cut off", lambda: _picture(grey, "JPEG")[:20_000], "JPEG"
    yield "jpeg of no body", lambda: b"\xff\xd8\xff\xe0" + bytes(100), "JPEG"
    yield "jpeg bomb", lambda: _jpeg_of_size(_picture(grey, "JPEG"), 60_000), "3600000000 pixels"
    yield "bmp cut off", lambda: _picture(grey, "BMP")[:50_000], "BMP"
    bomb = b"BM" + struct.pack("<LLLLllHHL24x", 54, 0, 54, 40, 30_000, 30_000, 1, 24, 1)
    yield "bmp bomb", lambda: bomb, "900000000 pixels"
    yield "tiff bomb", lambda: _tiff_bomb(20_000, 20_000), "20000 x 20000 px"
    yield "tiff of more than it says", lambda: _tiff_bomb(SIDE, SIDE), "no contrast"
    yield "tiff with great tags", lambda: _tiff_tags(200), "TIFF tag"
    yield "tiff with great tags of fractions", lambda: _tiff_tags(200, 5, 8), "TIFF tag"
    yield "tiff with much exif", lambda: _tiff_of_exif(), "EXIF"
    yield "jpeg with much exif", lambda: _jpeg_of_exif(_picture(grey, "JPEG")), "EXIF"
    yield (
        "png with much exif",
        lambda: _png(SIDE, SIDE, 0, chunk=_chunk(b"eXIf", _exif())),
        "no contrast",
    )
    yield "tiff with many tags", lambda: _tiff_tags(60_000), "tags"
    yield "tiff cut off", lambda: _picture(sky, "TIFF")[:100_000], "cut off"
    yield (
        "tiff whose directory is elsewhere",
        lambda: b"II*\0" + struct.pack("<L", 1 << 31),
        "cut off",
    )
    yield "npy beyond any memory", lambda: _npy((10**9, 10**9), "<f8"), "1000000000 x 1000000000 px"
    yield "npy of objects", lambda: _npy((SIDE, SIDE), "|O"), "numbers"
    yield "npy of three dimensions", lambda: _npy((SIDE, SIDE, 5), "<u2"), "two dimensions"
    yield "npy with less than it says", lambda: _npy((SIDE, SIDE), "<f8"), "cut off"
    yield (
        "npy with a long header",
        lambda: b"\x93NUMPY\x02\0" + struct.pack("<L", 1 << 30),
        "header",
    )
    yield "npy with a header that does not end", lambda: _npy_header(b"{'shape': (\n"), "header"
    yield "npy negative", lambda: _npy((-SIDE, -SIDE), "<u2"), "px"
    yield "all NaN", lambda: _array(np.full((SIDE, SIDE), np.nan)), "no number"
    yield "all infinite", lambda: _array(np.full((SIDE, SIDE), np.inf, np.float32)), "no number"
    yield "all black", lambda: _fits(np.zeros((SIDE, SIDE), np.uint16)), "no contrast"
    yield (
        "8 bit saturated",
        lambda: _picture(np.full((SIDE, SIDE), 255, np.uint8), "PNG"),
        "no contrast",
    )
    mostly = np.where(rng.random((SIDE, SIDE)) < 0.9, 255, 100).astype(np.uint8)
    yield "8 bit mostly saturated", lambda: _picture(mostly, "PNG"), "saturated"
    yield "nothing but noise", lambda: _array(rng.integers(0, 39_000, (SIDE, SIDE))), ""
    squares = np.indices((SIDE, SIDE)).sum(axis=0) % 2 * 30_000
    yield "a chess board", lambda: _array(squares), ""
    yield "no star", lambda: whole, "no star"


def _fits(counts):
    file = io.BytesIO()
    write_fits(file, counts, {})
    return file.getvalue()


def _card(key, value):
    return f"{key:<8}= {value:>20}".ljust(80)


def _header(**cards):
    first = () if "XTENSION" in cards else (("SIMPLE", "T"),)
    lines = [_card(key, value) for key, value in (*first, ("BITPIX", 8), *cards.items())]
    text = "".join(lines) + "END".ljust(80)
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


def _fits_with(whole, key, value):
    """The file with one card of its header replaced."""
    cards = [whole[at : at + 80] for at in range(0, 2880, 80)]
    wanted = f"{key:<8}=".encode()
    cards = [_card(key, value)[:80].encode() if card.startswith(wanted) else card for card in cards]
    if not any(card.startswith(wanted) for card in cards):
        cards[cards.index(b"END".ljust(80))] = _card(key, value).encode()
    return b"".join(cards) + whole[2880:]


def _picture(values, file_format):
    file = io.BytesIO()
    Image.fromarray(values).save(file, file_format)
    return file.getvalue()


def _jpeg_of_size(whole, side):
    """A JPEG whose header claims another size."""
    at = whole.index(b"\xff\xc0") + 5
    return whole[:at] + struct.pack(">HH", side, side) + whole[at + 4 :]


def _chunk(kind, data):
    return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))


def _png(width, height, grey, more=b"", chunk=b""):
    """A PNG of one grey, rows deflated as they are made; `more` data behind its rows."""
    squeeze = zlib.compressobj(1)
    row = b"\0" + bytes([grey]) * width
    data = b"".join(squeeze.compress(row) for _ in range(height))
    data += squeeze.compress(more) + squeeze.flush()
    head = struct.pack(">LLBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", head)
        + chunk
        + _chunk(b"IDAT", data)
        + _chunk(b"IEND", b"")
    )


def _text_bomb():
    return _chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(256 << 20), 1))


def _profile_bomb():
    return _chunk(b"iCCP", b"profile\0\0" + zlib.compress(bytes(256 << 20), 1))


def _tiff(entries, behind=b""):
    """A little-endian TIFF with one directory of (tag, type, count, value) at its start."""
    directory = struct.pack("<H", len(entries))
    directory += b"".join(struct.pack("<HHLL", *entry) for entry in entries) + bytes(4)
    return b"II*\0" + struct.pack("<L", 8) + directory + behind


def _tiff_bomb(width, height):
    """Deflated data of 256 MB in one strip."""
    data = zlib.compress(bytes(256 << 20), 1)
    at = 8 + 2 + 12 * 9 + 4
    return _tiff(
        [
            (256, 4, 1, width),
            (257, 4, 1, height),
            (258, 3, 1, 8),
            (259, 3, 1, 8),
            (262, 3, 1, 1),
            (273, 4, 1, at),
            (277, 3, 1, 1),
            (278, 4, 1, height),
            (279, 4, 1, len(data)),
        ],
        data,
    )


def _tiff_tags(count, kind=1, size=1):
    """Tags that all point to the same ten megabytes."""
    behind = bytes(10 << 20)
    tags = [(256, 4, 1, SIDE), (257, 4, 1, SIDE)]
    tags += [(1000 + k, kind, len(behind) // size, 8) for k in range(count)]
    return _tiff(tags, behind)


def _exif():
    """EXIF of a million fractions, each of which becomes an object where all are read."""
    fractions = struct.pack("<LL", 3, 7) * (1 << 20)
    at = 8 + 2 * (2 + 12 + 4)
    inside = struct.pack("<HHHLL4x", 1, 40_000, 5, 1 << 20, at)
    return _tiff([(0x8769, 4, 1, 8 + 2 + 12 + 4)], inside + fractions)


def _tiff_of_exif():
    inside = struct.pack("<HHHLL4x", 1, 40_000, 5, 1 << 20, 8)
    size = [(256, 4, 1, SIDE), (257, 4, 1, SIDE)]
    return _tiff([*size, (0x8769, 4, 1, 8 + 2 + 12 * 3 + 4)], inside + bytes(8 << 20))


def _jpeg_of_exif(whole):
    """The same in pieces of 64 KiB, which Pillow joins."""
    data, size = _exif(), 65_000
    parts = [b"Exif\0\0" + data[at : at + size] for at in range(0, len(data), size)]
    told = b"".join(b"\xff\xe1" + struct.pack(">H", len(part) + 2) + part for part in parts)
    return whole[:2] + told + whole[2:]


def _npy(shape, descr):
    text = str({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    return _npy_header(text) + bytes(1000)


def _npy_header(text):
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text


def _array(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()

"""Files of three colours of 16 bits, and a camera's raw file, written byte by byte."""

import struct
import zlib

import numpy as np

SHORT, LONG = 3, 4


def png_of_16_bits(values):
    """A PNG of values (rows, columns, 2 to 4 samples): grey and opacity, or colours."""
    rows, columns, channels = values.shape
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    kind = {2: 4, 3: 2, 4: 6}[channels]
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", struct.pack(">LLBBBBB", columns, rows, 16, kind, 0, 0, 0))
        + _chunk(b"IDAT", zlib.compress(lines))
        + _chunk(b"IEND", b"")
    )


def _chunk(kind, data):
    return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))


def tiff_of_16_bits(values, order="<", packed=False):
    """A TIFF of values (rows, columns, 3), as they are or deflated."""
    rows, columns, channels = values.shape
    data = values.astype(order + "u2").tobytes()
    data = zlib.compress(data) if packed else data
    entries = {
        256: (LONG, [columns]),
        257: (LONG, [rows]),
        258: (SHORT, [16] * channels),
        259: (SHORT, [8 if packed else 1]),
        262: (SHORT, [2]),
        277: (SHORT, [channels]),
        278: (LONG, [rows]),
        284: (SHORT, [1]),
    }
    return tiff(entries, data, order)


def dng(values):
    """A camera's raw file: values (rows, columns) behind a pattern of red, green, green, blue."""
    rows, columns = values.shape
    entries = {
        254: (LONG, [0]),
        256: (LONG, [columns]),
        257: (LONG, [rows]),
        258: (SHORT, [16]),
        259: (SHORT, [1]),
        262: (SHORT, [32803]),
        277: (SHORT, [1]),
        278: (LONG, [rows]),
        33421: (SHORT, [2, 2]),
        33422: (1, [0, 1, 1, 2]),
        50706: (1, [1, 4, 0, 0]),
        50717: (LONG, [65535]),
    }
    return tiff(entries, values.astype("<u2").tobytes(), "<")


def tiff(entries, data, order):
    """A TIFF of one strip of data; entries are tag: (type, values)."""
    formats = {1: "B", SHORT: "H", LONG: "L"}
    entries = entries | {273: (LONG, [0]), 279: (LONG, [len(data)])}
    after = 8 + 2 + 12 * len(entries) + 4
    beside, lines = b"", []
    for tag in sorted(entries):
        kind, values = entries[tag]
        packed = struct.pack(order + formats[kind] * len(values), *values)
        if tag == 273:
            lines.append((tag, kind, 1, None))
        elif len(packed) <= 4:
            lines.append((tag, kind, len(values), packed.ljust(4, b"\0")))
        else:
            place = struct.pack(order + "L", after + len(beside))
            lines.append((tag, kind, len(values), place))
            beside += packed + b"\0" * (len(packed) % 2)
    strip = struct.pack(order + "L", after + len(beside))
    directory = b"".join(
        struct.pack(order + "HHL", tag, kind, count) + (strip if value is None else value)
        for tag, kind, count, value in lines
    )
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "LH", 8, len(lines))
    return head + directory + bytes(4) + beside + data


def colours(rng, rows=31, columns=47):
    """Values of 16 bits that need all of them."""
    return rng.integers(0, 65536, (rows, columns, 3)).astype(np.uint16)

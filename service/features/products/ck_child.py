"""Program that writes a C-kernel of type 3 from records, run as a child process.

    python ck_child.py FOLDER FILE INSTRUMENT [LSK SCLK]

FOLDER holds `records`, rows of encoded clock, quaternion (scalar first) and angular
velocity, and `begins`: the first row of each stretch, and whether it has rates.  Without
kernels the clock counts microseconds of TAI since 1972-01-01T00:00:00 TAI; with them the
records are encoded by the spacecraft's clock.
"""

import os
import sys
from collections.abc import Iterator

import numpy as np

IN_SEGMENT = 50_000
"""Greatest number of records in a segment of a C-kernel. A longer interval continues in the next
segment with its last record repeated, so that the step between both is not lost.
"""

CLOCK_ZERO_S = -883_656_000
"""Zero of the service's own clock in TAI seconds since 2000-01-01T12:00:00, as in `kernels`."""

Piece = tuple[int, int, bool]


def pieces(begins: "np.ndarray[tuple[int, int], np.dtype[np.int64]]", count: int) -> list[Piece]:
    """Intervals as first row, end, and presence of rates; long ones in overlapping pieces."""
    ends = [*begins[1:, 0].tolist(), count]
    found = []
    for (first, rated), end in zip(begins.tolist(), ends, strict=True):
        while end - first > IN_SEGMENT:
            found.append((first, first + IN_SEGMENT, bool(rated)))
            first += IN_SEGMENT - 1
        found.append((first, end, bool(rated)))
    return found


def segments(parts: list[Piece]) -> Iterator[list[Piece]]:
    """Group pieces into segments of limited size, each entirely with or without rates."""
    group: list[Piece] = []
    for part in parts:
        size = part[1] - (group[0][0] if group else part[0])
        if group and (size > IN_SEGMENT or part[2] != group[0][2] or part[0] < group[-1][1]):
            yield group
            group = []
        group.append(part)
    yield group


def main() -> None:
    """Write the C-kernel from the files in the folder given as argument."""
    import spiceypy

    place, file, instrument, *its_clock = sys.argv[1:]
    os.chdir(place)
    records = np.memmap("records", dtype=np.float64, mode="r").reshape(-1, 8)
    begins = np.fromfile("begins", dtype=np.int64).reshape(-1, 2)
    for kernel in its_clock:
        spiceypy.furnsh(kernel)
    handle = spiceypy.ckopn(file, "attitude", 0)
    for number, group in enumerate(segments(pieces(begins, len(records)))):
        first, end = group[0][0], group[-1][1]
        rows = np.array(records[first:end])
        if its_clock:
            seconds = rows[:, 0] / 1e6 + CLOCK_ZERO_S
            spacecraft = int(instrument) // 1000
            rows[:, 0] = [
                spiceypy.sce2c(spacecraft, spiceypy.unitim(each, "TAI", "ET")) for each in seconds
            ]
        spiceypy.ckw03(
            handle,
            rows[0, 0],
            rows[-1, 0],
            int(instrument),
            "J2000",
            group[0][2],
            f"attitude {number}",
            len(rows),
            np.ascontiguousarray(rows[:, 0]),
            np.ascontiguousarray(rows[:, 1:5]),
            np.ascontiguousarray(rows[:, 5:]),
            len(group),
            np.ascontiguousarray(rows[[part[0] - first for part in group], 0]),
        )
    spiceypy.ckcls(handle)


if __name__ == "__main__":
    main()

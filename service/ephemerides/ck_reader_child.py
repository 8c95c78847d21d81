"""Program that reads C-kernels of types 1 and 3, run as a child process.

    python ck_reader_child.py OUT MOST STRUCTURE CK KERNEL...

Writes to the folder OUT `records`, rows of nanoseconds of TAI since J2000 (int64), the four
components of SPICE's quaternion from J2000 and the rates about inertial axes in rad/s, NaN where
there are none (float64); and `segments`: rows of the first record, the number of records of each
interval, and 1 where nothing is known between its records.  Intervals are in the order of the
file: a later one has priority.  STRUCTURE is the NAIF id of the structure that is read, empty for
the only one.  Prints a line of JSON: `error`, or the `object`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import spiceypy as spice

Floats = np.ndarray[Any, np.dtype[np.float64]]
DISCRETE, CONTINUOUS = 1, 3
"""Types of C-kernel segments that are read."""
J2000 = 1
INERTIAL = range(1, 22)
"""Ids of SPICE's inertial frames, which have fixed rotations from J2000."""


class Refused(Exception):
    """Raised for a kernel that cannot be read, with the reason."""


def segments(handle: int) -> list[list[int]]:
    """Segments of a C-kernel: structure, frame, type, presence of rates, first and last address."""
    spice.dafbfs(handle)
    found = []
    while spice.daffna():
        found.append([int(each) for each in spice.dafus(spice.dafgs(), 2, 6)[1]])
    return found


def records_of(handle: int, kind: int, begin: int, end: int, rates: int) -> "tuple[Floats, Floats]":
    """Records (n, 8) of a C-kernel segment, clock first, and the starts of its intervals."""
    # The layouts of types 1 and 3 ("CK Required Reading"): packets, times, directory of times,
    # of type 3 starts of intervals, directory of starts, number of intervals; number of packets.
    size = 7 if rates else 4
    room = end - begin + 1
    (count,) = (int(each) for each in spice.dafgda(handle, end, end))
    intervals = int(spice.dafgda(handle, end - 1, end - 1)[0]) if kind == CONTINUOUS else 1
    if not (0 < count <= room // (size + 1) and 0 < intervals <= count):
        raise Refused("a segment of it is not as its type has it")
    packets = np.array(spice.dafgda(handle, begin, begin + count * size - 1)).reshape(-1, size)
    times_at = begin + count * size
    times = np.array(spice.dafgda(handle, times_at, times_at + count - 1))
    starts = times[:1]
    if kind == CONTINUOUS:
        starts_at = times_at + count + (count - 1) // 100
        starts = np.array(spice.dafgda(handle, starts_at, starts_at + intervals - 1))
    rate = packets[:, 4:] if rates else np.full((count, 3), np.nan)
    return np.column_stack([times, packets[:, :4], rate]), starts


def from_j2000(frame: int, records: Floats) -> Floats:
    """Convert quaternions and rates of records from another inertial frame to J2000."""
    if frame == J2000:
        return records
    matrix = np.array(spice.pxform("J2000", spice.frmnam(frame), 0.0))
    # SPICE's product of quaternions is that of their matrices: C-matrix times frame.
    turn = spice.m2q(matrix)
    q = np.array([spice.qxq(each, turn) for each in records[:, 1:5]])
    return np.column_stack([records[:, 0], q, records[:, 5:] @ matrix])


def main() -> None:
    """Read a C-kernel named on the command line; write its records and intervals to a folder."""
    out, most, asked, ck, *kernels = sys.argv[1:]
    for each in (*kernels, ck):
        spice.furnsh(each)
    handle = spice.dafopr(ck)
    found = segments(handle)
    if not found:
        raise Refused("has no segment")
    structures = sorted({each[0] for each in found})
    names = ", ".join(map(str, structures))
    if not asked and len(structures) > 1:
        raise Refused(f"orients several structures: {names}; choose one with --object")
    structure = int(asked) if asked else structures[0]
    found = [each for each in found if each[0] == structure]
    if not found:
        raise Refused(f"orients {names}, not {structure}")
    clock = spice.ckmeta(structure, "SCLK")
    try:
        spice.dtpool(f"SCLK_DATA_TYPE_{-clock}")
    except spice.NotFoundError:
        raise Refused(
            f"needs the clock of spacecraft {clock}: put its SCLK kernel (.tsc) in the same folder"
        ) from None
    count = 0
    spans: list[tuple[int, int, int]] = []
    with Path(out, "records").open("wb") as file:
        for _, frame, kind, rates, begin, end in found:
            if kind not in (DISCRETE, CONTINUOUS):
                raise Refused(f"has a segment of type {kind}; types 1 and 3 are read")
            if frame not in INERTIAL:
                name = spice.frmnam(frame) or frame
                raise Refused(f"refers to frame {name}; inertial frames of SPICE are read")
            rows, starts = records_of(handle, kind, begin, end, rates)
            rows = from_j2000(frame, rows)
            count_here = len(rows)
            if count + count_here > int(most):
                raise Refused(f"has more than {int(most):,} records")
            place = np.searchsorted(rows[:, 0], starts)
            spans += [
                (count + first, last - first, int(kind == DISCRETE))
                for first, last in zip(place, [*place[1:], count_here], strict=True)
            ]
            tai_s = [spice.unitim(spice.sct2e(clock, t), "ET", "TAI") for t in rows[:, 0]]
            ns = np.round(np.array(tai_s) * 1e9).astype(np.int64)
            file.write(np.column_stack([ns.view(np.float64), rows[:, 1:]]).tobytes())
            count += count_here
    np.array(spans, dtype=np.int64).tofile(Path(out, "segments"))
    # The bus of spacecraft SC is usually structure 1000 SC; an instrument has its own id.
    whole, part = divmod(structure, 1000)
    print(json.dumps({"object": str(structure if part else whole)}))


if __name__ == "__main__":
    try:
        main()
    except Refused as error:
        print(json.dumps({"error": str(error)}))
    except spice.exceptions.SpiceyError as error:
        words = f"{error.short}: {error.long}".strip()
        print(json.dumps({"error": f"is not read by SPICE: {words}"[:500]}))

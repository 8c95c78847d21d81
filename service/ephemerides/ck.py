"""Reader of C-kernels of types 1 and 3 through CSPICE, in a child process: CSPICE is global.

SPICE's quaternion is scalar-first and the conjugate of ours.  Each interpolation interval becomes a
segment; for type 1 each segment, known at its records only.  Where intervals overlap, a later
segment of the file has priority, as in SPICE.  Leap seconds come from ERFA's table unless a
leap-second kernel is given.
"""

import json
import lzma
import re
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path, PurePosixPath

import numpy as np

from service.ephemerides import known
from service.ephemerides.text_kernels import leap_second_kernel
from service.errors import BadFile, BadInput, Fault, shown_value
from service.extras import require_extra
from service.table_files.spool import PIECE_BYTES, folder
from service.vectors import attitude_matrices

CHILD_S = 600.0
"""Time limit in seconds of the child process that reads a C-kernel."""
MAX_UNPACKED_BYTES = 1 << 30
_CHILD = Path(__file__).with_name("ck_reader_child.py")
_UNPACKING = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    *(EOFError, OSError, RuntimeError, UnicodeDecodeError),
)
"""Exceptions raised for a damaged zip file, for example by a name that is not UTF-8."""
_KERNELS = (".tsc", ".tls")
"""Suffixes of clock and leap-second kernels, needed to read a C-kernel."""


def read_ck(file: Path, field: str = "file", object_id: str | None = None) -> known.KnownAttitudes:
    """Read a C-kernel with its clock kernel next to it, or a zip file with both.

    `object_id` is the NAIF id of the structure that is read from a kernel that orients several.

    Raises `BadFile` naming the file, and `NotAvailable` without spiceypy.
    """
    if object_id is not None and not re.fullmatch(r"-?\d{1,9}", object_id):
        message = "must be the NAIF id of a structure that a C-kernel orients, such as -82000"
        raise BadInput(Fault("--object", message, shown_value(object_id)))
    require_extra("spice", "spiceypy", field, file.name)
    with folder() as temporary:
        place = Path(temporary)
        if zipfile.is_zipfile(file):
            kernel, others = _unpacked(file, place)
        else:
            kernel, others = _linked(file, place)
        if not any(each.endswith(".tls") for each in others):
            (place / "leap_seconds.tls").write_text(leap_second_kernel(), encoding="ascii")
            others.append("leap_seconds.tls")
        return _read(file.name, place, object_id or "", kernel, others)


def _linked(file: Path, place: Path) -> tuple[str, list[str]]:
    """Link a C-kernel and its neighbours under short names, since SPICE limits path lengths."""
    beside = sorted(each for each in file.parent.iterdir() if each.suffix.lower() in _KERNELS)
    names = [f"k{number}{each.suffix.lower()}" for number, each in enumerate(beside)]
    for name, each in zip(["attitude.bc", *names], [file, *beside], strict=True):
        (place / name).symlink_to(each.resolve())
    return "attitude.bc", names


def _unpacked(file: Path, place: Path) -> tuple[str, list[str]]:
    """Unpack the kernels of a zip file under generated names."""
    found: dict[str, list[str]] = {suffix: [] for suffix in (".bc", *_KERNELS)}
    room = MAX_UNPACKED_BYTES
    try:
        with zipfile.ZipFile(file) as packed:
            for number, each in enumerate(packed.infolist()):
                suffix = PurePosixPath(each.filename).suffix.lower()
                if suffix not in found:
                    continue
                name = f"k{number}{suffix}"
                found[suffix].append(name)
                with packed.open(each) as source, (place / name).open("wb") as out:
                    while piece := source.read(PIECE_BYTES):
                        room -= len(piece)
                        if room < 0:
                            message = f"holds more than {MAX_UNPACKED_BYTES >> 20} MiB of kernels"
                            raise BadFile(Fault(file.name, message))
                        out.write(piece)
    except _UNPACKING as error:
        raise BadFile(Fault(file.name, f"cannot be unpacked: {error}")) from None
    if len(found[".bc"]) != 1:
        raise BadFile(Fault(file.name, f"must hold one C-kernel (.bc), not {len(found['.bc'])}"))
    return found[".bc"][0], [name for suffix in _KERNELS for name in found[suffix]]


def _read(
    name: str, place: Path, object_id: str, kernel: str, others: list[str]
) -> known.KnownAttitudes:
    command = [sys.executable, "-P", str(_CHILD), ".", str(known.MOST_RECORDS)]
    command += [object_id, kernel, *others]
    try:
        done = subprocess.run(command, cwd=place, capture_output=True, timeout=CHILD_S, check=False)
    except subprocess.TimeoutExpired:
        raise BadFile(Fault(name, f"is not read by SPICE within {CHILD_S:g} s")) from None
    if done.returncode:
        raise BadFile(Fault(name, "is no C-kernel: SPICE's reader broke off"))
    answer = json.loads(done.stdout.splitlines()[-1])
    if "error" in answer:
        raise BadFile(Fault(name, answer["error"]))
    records = np.fromfile(place / "records").reshape(-1, 8)
    spans = np.fromfile(place / "segments", dtype=np.int64).reshape(-1, 3)
    time_ns = np.ascontiguousarray(records[:, 0]).view(np.int64)
    norm = np.linalg.norm(records[:, 1:5], axis=1)
    if not np.all(np.abs(norm - 1.0) < 1e-3):
        row = int(np.flatnonzero(~(np.abs(norm - 1.0) < 1e-3))[0])
        message = f"must have norm 1 within 0.001; its norm is {norm[row]:.6g}"
        raise BadFile(Fault(f"{name}, record {row + 1}: quaternion", message))
    quaternion = np.column_stack([-records[:, 2:5], records[:, 1]]) / norm[:, None]
    rate = np.einsum("nij,nj->ni", attitude_matrices(quaternion), records[:, 5:])
    segments = []
    for first, count, discrete in spans.tolist():
        at, rows = f"record {first + 1}", slice(first, first + count)
        times = time_ns[rows]
        if np.any(np.diff(times) <= 0):
            raise BadFile(Fault(f"{name}, {at}", "times must increase within an interval"))
        rates = None if np.isnan(rate[first]).any() else rate[rows]
        segments.append(
            known.Segment(
                at,
                times,
                int(times[0]) - (known.DISCRETE_NS if discrete else 0),
                int(times[-1]) + (known.DISCRETE_NS if discrete else 0),
                quaternion[rows],
                known.told_rates(quaternion[rows], rates),
                bool(discrete),
            )
        )
    return known.known_attitudes(name, answer["object"], known.by_priority(segments))

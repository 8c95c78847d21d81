"""Attitudes as a C-kernel of type 3, zipped with the kernels needed to use it.

SPICE's quaternion is scalar-first and the conjugate of ours: (qc, -q1, -q2, -q3).  Its
angular velocity is in the axes of the reference frame, J2000: A^T w.  An interpolation
interval is an unbroken stretch.  CSPICE is global and not safe between threads: a child
process writes the file.
"""

import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from service.ephemerides.rows import Integers
from service.ephemerides.text_kernels import leap_second_kernel, text_kernel
from service.errors import AcquisitionError, BadConfiguration
from service.features.products import attitudes
from service.table_files.spool import folder, pieces
from service.times import TT_LESS_TAI_S
from service.vectors import Vector, attitude_matrices

CHILD_S = 600.0
"""Time limit of the child process in seconds."""
_CHILD = Path(__file__).with_name("ck_child.py")


def write_ck(series: attitudes.AttitudeSeries) -> Iterator[bytes]:
    """Write a zip file with the C-kernel, its clock, frame, leap-second and meta-kernels."""
    about = series.about
    name = body_name(about).lower()
    with folder() as temporary:
        place = Path(temporary)
        texts = {
            f"{name}.tls": leap_second_kernel(),
            f"{name}.tsc": _clock(about),
            f"{name}.tf": frame_kernel(about),
        }
        texts[f"{name}.tm"] = list_of_kernels([*texts, f"{name}.bc"])
        lines = (f"{key}: {value}\n" for key, value in about.provenance().items())
        texts["README.txt"] = "".join(lines)
        for file, text in texts.items():
            (place / file).write_text(text, encoding="utf-8", newline="")
        _keep_records(series, place)
        its_clock = [] if about.sclk_kernel is None else [f"{name}.tls", f"{name}.tsc"]
        _run_child(place, f"{name}.bc", instrument_id(about), its_clock)
        with zipfile.ZipFile(place / "kernels.zip", "w", zipfile.ZIP_DEFLATED) as packed:
            for file in (f"{name}.bc", *texts):
                packed.write(place / file, file)
        with (place / "kernels.zip").open("rb") as whole:
            yield from pieces(whole)


def _clock(about: attitudes.SeriesInfo) -> str:
    """Text of the spacecraft's clock kernel (SCLK): its own file, or one made here."""
    if about.sclk_kernel is None:
        return clock_kernel(about)
    try:
        return about.sclk_kernel.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BadConfiguration(f"{about.sclk_kernel}: cannot be read: {error.strerror}") from None


def _keep_records(series: attitudes.AttitudeSeries, place: Path) -> None:
    """Write the input files of the child process: attitude records, and the starts of intervals."""
    count = 0
    begins: list[tuple[int, int]] = []
    with (place / "records").open("wb") as file:
        for stretch in attitudes.stretches(series):
            for number, part in enumerate(stretch):
                if number == 0:
                    begins.append((count, int(not np.isnan(part.rate_deg_per_s[0, 0]))))
                file.write(_records(part).tobytes())
                count += len(part)
    np.array(begins, dtype=np.int64).tofile(place / "begins")


def _records(part: attitudes.AttitudeBlock) -> Vector:
    """Rows of encoded clock, SPICE's quaternion, and angular velocity in J2000 in rad/s."""
    ticks = clock_ticks(part.time_ns)[:, None]
    vector, scalar = part.quaternion[:, :3], part.quaternion[:, 3:]
    rate = np.radians(np.nan_to_num(part.rate_deg_per_s))
    inertial = np.einsum("nji,nj->ni", attitude_matrices(part.quaternion), rate)
    return np.concatenate([ticks, scalar, -vector, inertial], axis=1)


def _run_child(place: Path, file: str, instrument: int, its_clock: list[str]) -> None:
    command = [sys.executable, "-P", str(_CHILD), str(place), file, str(instrument), *its_clock]
    done = subprocess.run(command, capture_output=True, timeout=CHILD_S, check=False)
    if done.returncode:
        raise AcquisitionError(f"the C-kernel could not be written: {done.stderr[-500:]!r}")


# Text kernels: a spacecraft's clock, its frame, and a list of all.
#
# The clock is our own, for missions without one: seconds and microseconds of TAI since
# 1972-01-01T00:00:00 TAI, an encoded tick being a microsecond.

_CLOCK_ZERO_S = -883_656_000
"""Zero of the service's own clock in TAI seconds since 2000-01-01T12:00:00."""


def clock_ticks(tai_ns: Integers) -> Vector:
    """Encoded clock ticks of times as `Utc.tai_ns`; exact for whole microseconds."""
    return (tai_ns - _CLOCK_ZERO_S * 10**9) / 1e3


def body_name(about: attitudes.SeriesInfo) -> str:
    """Name of the spacecraft in SPICE kernels: capitals, digits and underscores."""
    return re.sub("[^A-Z0-9]", "_", about.spacecraft.upper())[:20]


def frame_name(about: attitudes.SeriesInfo) -> str:
    """Name of the spacecraft's body frame in SPICE kernels."""
    return f"{body_name(about)}_BODY"


def instrument_id(about: attitudes.SeriesInfo) -> int:
    """SPICE id of the structure whose orientation the C-kernel gives, and of its frame."""
    return about.naif_id * 1000


def clock_kernel(about: attitudes.SeriesInfo) -> str:
    """Text of a kernel (SCLK) of the service's own clock, for missions that name no clock."""
    id = -about.naif_id
    zero = f"{_CLOCK_ZERO_S + TT_LESS_TAI_S:.3f}"
    return text_kernel(
        "SCLK",
        f"Clock of {body_name(about)}: seconds and microseconds since 1972-01-01T00:00:00 TAI.",
        f"SCLK_KERNEL_ID            = ( @{about.created[:10]} )",
        f"SCLK_DATA_TYPE_{id}       = ( 1 )",
        f"SCLK01_TIME_SYSTEM_{id}   = ( 2 )",
        f"SCLK01_N_FIELDS_{id}      = ( 2 )",
        f"SCLK01_MODULI_{id}        = ( 10000000000 1000000 )",
        f"SCLK01_OFFSETS_{id}       = ( 0 0 )",
        f"SCLK01_OUTPUT_DELIM_{id}  = ( 1 )",
        f"SCLK_PARTITION_START_{id} = ( 0.0 )",
        f"SCLK_PARTITION_END_{id}   = ( 8.0E+15 )",
        f"SCLK01_COEFFICIENTS_{id}  = ( 0.0 {zero} 1.0 )",
    )


def frame_kernel(about: attitudes.SeriesInfo) -> str:
    """Text of the frame kernel (FK) of the body axes, whose orientation the C-kernel gives."""
    id, name = instrument_id(about), frame_name(about)
    return text_kernel(
        "FK",
        f"The body axes of {body_name(about)}.",
        f"NAIF_BODY_NAME += ( '{body_name(about)}' )",
        f"NAIF_BODY_CODE += ( {about.naif_id} )",
        f"FRAME_{name} = {id}",
        f"FRAME_{id}_NAME     = '{name}'",
        f"FRAME_{id}_CLASS    = 3",
        f"FRAME_{id}_CLASS_ID = {id}",
        f"FRAME_{id}_CENTER   = {about.naif_id}",
        f"CK_{id}_SCLK = {about.naif_id}",
        f"CK_{id}_SPK  = {about.naif_id}",
    )


def list_of_kernels(names: list[str]) -> str:
    """Text of the meta-kernel that loads all kernels from the current folder."""
    quoted = [f"  '{name}'" for name in names]
    return text_kernel("MK", "Load this from their folder.", "KERNELS_TO_LOAD = (", *quoted, ")")

"""Attitudes as a C-kernel of type 3, zipped with the kernels that it takes to use it.

SPICE's quaternion is scalar-first and the conjugate of ours: (qc, -q1, -q2, -q3).  Its
angular velocity is in the axes of the reference frame, J2000: A^T w.  An interpolation
interval is an unbroken stretch.  CSPICE is global and not safe between threads: a child
process writes the file.
"""

import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from service.attitude.rotations import matrices
from service.errors import AcquisitionError, BadConfiguration
from service.products.attitudes import AttitudeBlock, AttitudeSeries, SeriesInfo, stretches
from service.products.spice import kernels
from service.products.spool import folder, pieces
from service.vectors import Vector

CHILD_S = 600.0
"""The longest that the child may take."""
_CHILD = Path(__file__).with_name("ck_child.py")


def write_ck(series: AttitudeSeries) -> Iterator[bytes]:
    """Write a zip file with the C-kernel, clock, frame, leap seconds and their list."""
    about = series.about
    name = kernels.body_name(about).lower()
    with folder() as temporary:
        place = Path(temporary)
        texts = {
            f"{name}.tls": kernels.leap_second_kernel(),
            f"{name}.tsc": _clock(about),
            f"{name}.tf": kernels.frame_kernel(about),
        }
        texts[f"{name}.tm"] = kernels.list_of_kernels([*texts, f"{name}.bc"])
        told = (f"{key}: {value}\n" for key, value in about.provenance().items())
        texts["README.txt"] = "".join(told)
        for file, text in texts.items():
            (place / file).write_text(text, encoding="utf-8", newline="")
        _keep_records(series, place)
        its_clock = [] if about.sclk_kernel is None else [f"{name}.tls", f"{name}.tsc"]
        _run_child(place, f"{name}.bc", kernels.instrument_id(about), its_clock)
        with zipfile.ZipFile(place / "kernels.zip", "w", zipfile.ZIP_DEFLATED) as packed:
            for file in (f"{name}.bc", *texts):
                packed.write(place / file, file)
        with (place / "kernels.zip").open("rb") as whole:
            yield from pieces(whole)


def _clock(about: SeriesInfo) -> str:
    """The kernel of the spacecraft's clock: its own, or the one that we define."""
    if about.sclk_kernel is None:
        return kernels.clock_kernel(about)
    try:
        return about.sclk_kernel.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BadConfiguration(f"{about.sclk_kernel}: cannot be read: {error.strerror}") from None


def _keep_records(series: AttitudeSeries, place: Path) -> None:
    """Write for the child what the kernel is made of: the records, and where stretches begin."""
    count = 0
    begins: list[tuple[int, int]] = []
    with (place / "records").open("wb") as file:
        for stretch in stretches(series):
            for number, part in enumerate(stretch):
                if number == 0:
                    begins.append((count, int(not np.isnan(part.rate_deg_per_s[0, 0]))))
                file.write(_records(part).tobytes())
                count += len(part)
    np.array(begins, dtype=np.int64).tofile(place / "begins")


def _records(part: AttitudeBlock) -> Vector:
    """Rows of encoded clock (of ours), SPICE's quaternion, and angular velocity in J2000, rad/s."""
    ticks = kernels.clock_ticks(part.time_ns)[:, None]
    vector, scalar = part.quaternion[:, :3], part.quaternion[:, 3:]
    rate = np.radians(np.nan_to_num(part.rate_deg_per_s))
    inertial = np.einsum("nji,nj->ni", matrices(part.quaternion), rate)
    return np.concatenate([ticks, scalar, -vector, inertial], axis=1)


def _run_child(place: Path, file: str, instrument: int, its_clock: list[str]) -> None:
    command = [sys.executable, "-P", str(_CHILD), str(place), file, str(instrument), *its_clock]
    done = subprocess.run(command, capture_output=True, timeout=CHILD_S, check=False)
    if done.returncode:
        raise AcquisitionError(f"the C-kernel could not be written: {done.stderr[-500:]!r}")

"""Text kernels: a spacecraft's clock, its frame, leap seconds, and a list of all.

The clock is our own, for missions without one: seconds and microseconds of TAI since
1972-01-01T00:00:00 TAI, an encoded tick being a microsecond.
"""

import re

import erfa

from service.products.attitudes import Integers, SeriesInfo
from service.vectors import Vector

_CLOCK_ZERO_S = -883_656_000
"""TAI seconds from 2000-01-01T12:00:00 to the zero of the clock."""
_TT_LESS_TAI_S = 32.184
_MONTHS = {1: "JAN", 7: "JUL"}


def clock_ticks(tai_ns: Integers) -> Vector:
    """Encoded clock of moments given as `Utc.tai_ns`; exact for whole microseconds."""
    return (tai_ns - _CLOCK_ZERO_S * 10**9) / 1e3


def body_name(about: SeriesInfo) -> str:
    """The name of the spacecraft in kernels: capitals, digits and underscores."""
    return re.sub("[^A-Z0-9]", "_", about.spacecraft.upper())[:20]


def frame_name(about: SeriesInfo) -> str:
    """The name of the frame of its body."""
    return f"{body_name(about)}_BODY"


def instrument_id(about: SeriesInfo) -> int:
    """The id of the structure that the C-kernel orients, and of its frame."""
    return about.naif_id * 1000


def clock_kernel(about: SeriesInfo) -> str:
    """SCLK: the clock of the spacecraft."""
    id = -about.naif_id
    zero = f"{_CLOCK_ZERO_S + _TT_LESS_TAI_S:.3f}"
    return _kernel(
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


def frame_kernel(about: SeriesInfo) -> str:
    """FK: the frame of the body, whose orientation the C-kernel gives."""
    id, name = instrument_id(about), frame_name(about)
    return _kernel(
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


def leap_second_kernel() -> str:
    """LSK: leap seconds by ERFA's table, with the constants of NAIF's own kernels."""
    steps = [
        f"  {int(count)}, @{year}-{_MONTHS[int(month)]}-1"
        for year, month, count in erfa.leap_seconds.get().tolist()
        if year >= 1972
    ]
    return _kernel(
        "LSK",
        "Leap seconds by the table of ERFA.",
        "DELTET/DELTA_T_A = 32.184",
        "DELTET/K         = 1.657D-3",
        "DELTET/EB        = 1.671D-2",
        "DELTET/M         = ( 6.239996D0 1.99096871D-7 )",
        "DELTET/DELTA_AT  = (",
        *steps,
        ")",
    )


def list_of_kernels(names: list[str]) -> str:
    """Meta-kernel: loads all of them from the folder of the process."""
    quoted = [f"  '{name}'" for name in names]
    return _kernel("MK", "Load this from their folder.", "KERNELS_TO_LOAD = (", *quoted, ")")


def _kernel(kind: str, about: str, *lines: str) -> str:
    body = "\n".join(lines)
    return f"KPL/{kind}\n\n{about}\n\n\\begindata\n\n{body}\n\n\\begintext\n"

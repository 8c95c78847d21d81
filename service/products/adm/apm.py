"""APM version 2: one attitude, the last of a series."""

from collections.abc import Iterator

import numpy as np

from service.products.adm.forms import kvn, numbers, time_text
from service.products.adm.header import (
    RATE_WORDS,
    REF_FRAME_A,
    REF_FRAME_B,
    TIME_SYSTEM,
    header,
    identity,
)
from service.products.attitudes import AttitudeSeries

_FRAMES = [("REF_FRAME_A", REF_FRAME_A), ("REF_FRAME_B", REF_FRAME_B)]


def write_apm(series: AttitudeSeries) -> Iterator[bytes]:
    """Write the last attitude of a series, which has one at least; reads all of it."""
    for block in series.blocks:
        last = block.taken(slice(-1, None))
    parts = [
        kvn([("CCSDS_APM_VERS", "2.0")]),
        kvn(header(series.about)),
        "\n",
        kvn([*identity(series.about), ("TIME_SYSTEM", TIME_SYSTEM)]),
        "\n",
        kvn([("EPOCH", time_text(last.time[0]))]),
        "\nQUAT_START\n",
        kvn(_FRAMES),
        kvn(list(zip(("Q1", "Q2", "Q3", "QC"), numbers(last.quaternion[0].tolist()), strict=True))),
        "QUAT_STOP\n",
    ]
    if not np.isnan(last.rate_deg_per_s).any():
        words = RATE_WORDS[frozenset({last.rate_origin[0]})]
        rates = numbers(last.rate_deg_per_s[0].tolist())
        parts += [
            f"\nANGVEL_START\nCOMMENT Angular velocity {words}\n",
            kvn([*_FRAMES, ("ANGVEL_FRAME", REF_FRAME_B)]),
            kvn(
                [
                    (f"ANGVEL_{axis}", f"{rate} [deg/s]")
                    for axis, rate in zip("XYZ", rates, strict=True)
                ]
            ),
            "ANGVEL_STOP\n",
        ]
    yield "".join(parts).encode()

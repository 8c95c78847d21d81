"""AEM version 2: attitudes as a time series; APM version 2: the last one alone.

REF_FRAME_A and REF_FRAME_B fix the direction, from A to B; quaternions are scalar-last.
Version 1 had keywords for both, which version 2 has no longer.  A rate is in the axes of
the body, ANGVEL_FRAME.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from service.products.adm import (
    RATE_WORDS,
    REF_FRAME_A,
    REF_FRAME_B,
    TIME_SYSTEM,
    Pairs,
    header,
    identity,
    kvn,
    numbers,
    time_text,
    xml,
    xml_closing,
    xml_opening,
)
from service.products.attitudes import (
    AttitudeBlock,
    AttitudeSeries,
    SeriesInfo,
    stretches,
)
from service.products.spool import pieces, spool
from service.products.tables import rows_of_texts


@dataclass(frozen=True)
class Form:
    """How a message is written: its opening, metadata, states, ends."""

    opening: Callable[[Pairs], str]
    metadata: Callable[[Pairs], str]
    states: Callable[[AttitudeBlock], str]
    end_of_segment: str
    closing: str


def write_aem(series: AttitudeSeries, form: Form) -> Iterator[bytes]:
    """Write a series.

    The states of a stretch are kept in a temporary file, because its metadata begins with
    the time of its last one.
    """
    yield form.opening(header(series.about)).encode()
    for stretch in stretches(series):
        with spool() as file:
            metadata = _metadata(series.about, _spooled(stretch, form, file.write))
            yield form.metadata(metadata).encode()
            yield from pieces(file)
        yield form.end_of_segment.encode()
    yield form.closing.encode()


def _spooled(
    stretch: Iterable[AttitudeBlock], form: Form, write: Callable[[bytes], object]
) -> Iterator[AttitudeBlock]:
    for part in stretch:
        write(form.states(part).encode())
        yield part


def _metadata(about: SeriesInfo, parts: Iterable[AttitudeBlock]) -> Pairs:
    """The metadata of a stretch; reads all of it."""
    start = stop = ""
    origins: set[str] = set()
    for part in parts:
        start, stop = start or part.time[0], part.time[-1]
        origins.update(part.rate_origin.tolist())
    words = RATE_WORDS.get(frozenset(origins))
    told: Pairs = [] if words is None else [("COMMENT", f"Angular velocity {words}")]
    rates: Pairs = [] if words is None else [("ANGVEL_FRAME", REF_FRAME_B)]
    return [
        *told,
        *identity(about),
        ("REF_FRAME_A", REF_FRAME_A),
        ("REF_FRAME_B", REF_FRAME_B),
        ("TIME_SYSTEM", TIME_SYSTEM),
        ("START_TIME", time_text(start)),
        ("STOP_TIME", time_text(stop)),
        ("ATTITUDE_TYPE", "QUATERNION" if words is None else "QUATERNION/ANGVEL"),
        *rates,
    ]


def _values(part: AttitudeBlock) -> list[tuple[str, ...]]:
    """The numbers of each state as texts: the quaternion and, where known, the rate in deg/s."""
    values = part.quaternion
    if not np.isnan(part.rate_deg_per_s).any():
        values = np.concatenate([values, part.rate_deg_per_s], axis=1)
    return rows_of_texts(values)


def _kvn_opening(pairs: Pairs) -> str:
    return kvn([("CCSDS_AEM_VERS", "2.0")]) + kvn(pairs)


def _kvn_metadata(pairs: Pairs) -> str:
    return f"\nMETA_START\n{kvn(pairs)}META_STOP\n\nDATA_START\n"


def _kvn_states(part: AttitudeBlock) -> str:
    return "".join(
        f"{time[:-1]} {' '.join(values)}\n"
        for time, values in zip(part.time.tolist(), _values(part), strict=True)
    )


def _xml_opening(pairs: Pairs) -> str:
    return xml_opening("aem", pairs)


def _xml_metadata(pairs: Pairs) -> str:
    return f"    <segment>\n      <metadata>\n{xml(pairs, 8)}      </metadata>\n      <data>\n"


_QUATERNION = "<quaternion><Q1>%s</Q1><Q2>%s</Q2><Q3>%s</Q3><QC>%s</QC></quaternion>"
_ANGVEL = (
    '<angVel><ANGVEL_X units="deg/s">%s</ANGVEL_X><ANGVEL_Y units="deg/s">%s</ANGVEL_Y>'
    '<ANGVEL_Z units="deg/s">%s</ANGVEL_Z></angVel>'
)
_STATE = "        <attitudeState><{0}><EPOCH>%s</EPOCH>{1}</{0}></attitudeState>\n"
_STATES = {
    4: _STATE.format("quaternionEphemeris", _QUATERNION),
    7: _STATE.format("quaternionAngVel", _QUATERNION + _ANGVEL),
}
"""By the number of values of a state."""


def _xml_states(part: AttitudeBlock) -> str:
    return "".join(
        _STATES[len(values)] % (time[:-1], *values)
        for time, values in zip(part.time.tolist(), _values(part), strict=True)
    )


KVN = Form(_kvn_opening, _kvn_metadata, _kvn_states, "DATA_STOP\n", "")
XML = Form(
    _xml_opening,
    _xml_metadata,
    _xml_states,
    "      </data>\n    </segment>\n",
    xml_closing("aem"),
)


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

"""Attitude messages of CCSDS in KVN and XML (AEM, APM, ACM; 504.0-B-2).

A message is written from pairs of keyword and value, in order; the keyword `COMMENT` may be
repeated.  Both notations take the same pairs.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain
from xml.sax.saxutils import escape

import numpy as np

from service.ephemerides.kvn import ORIGINATOR, TIME_SYSTEM, Pairs, kvn, one_line, time_text
from service.ephemerides.rows import Integers
from service.features.products import attitudes
from service.table_files.spool import pieces, spool
from service.table_files.table import rows_of_texts
from service.vectors import Vector, full_matrices

_SCHEMA = "https://sanaregistry.org/r/ndmxml_unqualified/ndmxml-4.0.0-master-4.0.xsd"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"


def xml(pairs: Pairs, indent: int = 0) -> str:
    """XML elements, one line for each pair of keyword and value."""
    space = " " * indent
    return "".join(f"{space}<{key}>{escape(value)}</{key}>\n" for key, value in pairs)


def xml_opening(kind: str, header: Pairs) -> str:
    """Beginning of an XML message of a kind, such as `aem`, up to its body."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<{kind} xmlns:xsi="{_XSI}" xsi:noNamespaceSchemaLocation="{_SCHEMA}" '
        f'id="CCSDS_{kind.upper()}_VERS" version="2.0">\n'
        f"  <header>\n{xml(header, 4)}  </header>\n  <body>\n"
    )


def xml_closing(kind: str) -> str:
    """End of an XML message of a kind."""
    return f"  </body>\n</{kind}>\n"


def numbers(values: Iterable[float]) -> list[str]:
    """Finite numbers as text that reads back as the same float64; asserts no NaN."""
    texts = [repr(value) for value in values]
    assert all(math.isfinite(value) for value in values)
    return texts


REF_FRAME_A, REF_FRAME_B = "EME2000", "SC_BODY_1"

GRADE_WORDS = {
    "filtered": "Grade filtered: EKF of measured attitudes and gyro rates, from the past alone",
    "smoothed": "Grade smoothed: FILTER_SMOOTHER of measured attitudes and gyro rates",
}
"""Comments for filtered and smoothed attitudes in a message; raw ones need none."""
RATE_WORDS = {
    frozenset({"own"}): "as the batches gave it",
    frozenset({"derived"}): "derived from the attitudes",
    frozenset({"own", "derived"}): "of some states as the batches gave it, else derived",
    frozenset({"estimated"}): "estimated by the filter",
}
"""Comments on the origin of angular velocities, by the set of origins that occur."""


def header(about: attitudes.SeriesInfo) -> Pairs:
    """Header of a message: comments on its origin, its date and originator."""
    comments = [f"Written by attitude-acquisition {about.version}", f"Run {about.run}"]
    comments.append(
        f"Attitudes of status {about.status}"
        if about.status != "all"
        else "Attitudes good or suspect"
    )
    if about.grade in GRADE_WORDS:
        comments.append(GRADE_WORDS[about.grade])
    if about.start or about.end:
        what = "Batches" if about.grade == "raw" else "Samples"
        comments.append(
            f"{what} from {about.start or 'the first'} to before {about.end or 'the end'}"
        )
    comments.append(f"Largest gap within a segment {round(about.largest_gap_s, 6)!r} s")
    if about.record_head:
        comments.append(f"Record head {about.record_head}")
    return [
        *(("COMMENT", one_line(each)) for each in comments),
        ("CREATION_DATE", time_text(about.created)),
        ("ORIGINATOR", ORIGINATOR),
    ]


def identity(about: attitudes.SeriesInfo) -> Pairs:
    """Name and identifier of the spacecraft in a message."""
    return [
        ("OBJECT_NAME", one_line(about.spacecraft)),
        ("OBJECT_ID", one_line(about.object_id or about.spacecraft)),
    ]


# ACM version 2: attitudes, covariances, and how the attitudes were determined.
#
# Times count seconds from EPOCH_TZERO, leap seconds included.  The standard's covariances of type
# ANGLE are diagonal, in deg^2: with one tracker they are of its own axes, in which the matrix is
# nearly diagonal; with several they are of the body axes, and a comment says that the rest of the
# matrix is left out.

TRACKER_FRAME = "STARTRACKER_1"
COUNTS = ("OBSERVED", "UNIQUE", "AMBIGUOUS", "UNMATCHED")
"""Keywords of the star counts of all batches, in the order of `AttitudeRows.stars`."""
_DESIGNATOR = re.compile(r"\d{4}-\d{3}[A-Z]{1,3}")


def write_acm(series: attitudes.AttitudeSeries) -> Iterator[bytes]:
    """Write a series with at least one attitude as an ACM message.

    The covariances of all intervals are kept in a temporary file: they follow the last state.
    """
    about = series.about
    methods: Counter[str] = Counter()
    stars = np.zeros(len(COUNTS), dtype=np.int64)
    zero_ns: int | None = None
    with spool() as covariances:
        for stretch in attitudes.stretches(series):
            first = next(stretch)
            if zero_ns is None:
                zero_ns = int(first.time_ns[0])
                yield _opening(about, first.time[0]).encode()
            has_rates = not np.isnan(first.rate_deg_per_s).any()
            yield f"\nATT_START\n{kvn(_state_metadata(about, has_rates))}".encode()
            covariances.write(f"\nCOV_START\n{kvn(_covariance_metadata(about))}".encode())
            for part in chain([first], stretch):
                seconds = _seconds(part.time_ns - zero_ns)
                yield _lines(seconds, _states(part, has_rates)).encode()
                variances = _variances_deg2(about, part)
                covariances.write(_lines(seconds, variances).encode())
                methods.update(part.method.tolist())
                stars += part.stars.sum(axis=0)
            yield b"ATT_STOP\n"
            covariances.write(b"COV_STOP\n")
        yield from pieces(covariances)
    yield _determination(about, methods).encode()
    if about.grade != "raw":
        return
    counts = zip(COUNTS, stars.tolist(), strict=True)
    user_defined = [(f"USER_DEFINED_STARS_{name}", str(count)) for name, count in counts]
    yield f"\nUSER_START\n{kvn(user_defined)}USER_STOP\n".encode()


def _opening(about: attitudes.SeriesInfo, first: str) -> str:
    id = one_line(about.object_id or about.spacecraft)
    key = "INTERNATIONAL_DESIGNATOR" if _DESIGNATOR.fullmatch(id) else "OBJECT_DESIGNATOR"
    metadata = [
        ("OBJECT_NAME", one_line(about.spacecraft)),
        (key, id),
        ("TIME_SYSTEM", TIME_SYSTEM),
        ("EPOCH_TZERO", time_text(first)),
    ]
    opening = kvn([("CCSDS_ACM_VERS", "2.0")]) + kvn(header(about))
    return f"{opening}\nMETA_START\n{kvn(metadata)}META_STOP\n"


def _state_metadata(about: attitudes.SeriesInfo, has_rates: bool) -> Pairs:
    pairs: Pairs = [
        ("REF_FRAME_A", REF_FRAME_A),
        ("REF_FRAME_B", REF_FRAME_B),
        ("NUMBER_STATES", "7" if has_rates else "4"),
        ("ATT_TYPE", "QUATERNION"),
    ]
    if not has_rates:
        return pairs
    comment = "Rates are as the batches gave them, else derived from the attitudes"
    if about.grade != "raw":
        comment = "Rates are estimated by the filter"
    return [("COMMENT", comment), *pairs, ("RATE_TYPE", "ANGVEL")]


def _states(part: attitudes.AttitudeBlock, has_rates: bool) -> Vector:
    if not has_rates:
        return part.quaternion
    return np.concatenate([part.quaternion, part.rate_deg_per_s], axis=1)


def _covariance_metadata(about: attitudes.SeriesInfo) -> Pairs:
    words, frame = "in body axes; the rest of the matrix is left out", REF_FRAME_B
    if len(about.trackers) == 1:
        name = one_line(about.trackers[0].name)
        words, frame = f"in the axes of the tracker {name}", TRACKER_FRAME
    return [
        ("COMMENT", f"Variances of the small error rotation {words}"),
        ("COV_BASIS", "DETERMINED_GND"),
        ("COV_REF_FRAME", frame),
        ("COV_TYPE", "ANGLE"),
    ]


def _variances_deg2(about: attitudes.SeriesInfo, part: attitudes.AttitudeBlock) -> Vector:
    p = full_matrices(part.covariance_arcsec2)
    if len(about.trackers) == 1:
        axes = np.array(about.trackers[0].body_from_tracker)
        p = axes.T @ p @ axes
    return np.asarray(np.diagonal(p, axis1=1, axis2=2) / 3600.0**2)


def _determination(about: attitudes.SeriesInfo, methods: Counter[str]) -> str:
    ((method, _),) = methods.most_common(1)
    pairs: list[tuple[str, str]] = []
    if len(methods) > 1:
        pairs.append(("COMMENT", "Attitudes by " + " and ".join(sorted(methods))))
    pairs += [
        ("AD_METHOD", method.upper()),
        ("ATTITUDE_SOURCE", "GND"),
        ("NUMBER_STATES", "4"),
        ("ATTITUDE_STATES", "QUATERNION"),
        ("COV_TYPE", "ANGLE"),
        ("REF_FRAME_A", REF_FRAME_A),
        ("REF_FRAME_B", REF_FRAME_B),
    ]
    sensors = []
    for number, tracker in enumerate(about.trackers, start=1):
        sigma = repr(tracker.sigma_arcsec / 3600.0)
        sensor = [
            ("COMMENT", "Noise of the direction to a star, deg, about two axes across it"),
            ("SENSOR_NUMBER", str(number)),
            ("SENSOR_USED", one_line(tracker.name)),
            ("NUMBER_SENSOR_NOISE_COVARIANCE", "2"),
            ("SENSOR_NOISE_STDDEV", f"{sigma} {sigma}"),
        ]
        sensors.append(f"SENSOR_START\n{kvn(sensor)}SENSOR_STOP\n")
    return f"\nAD_START\n{kvn(pairs)}{''.join(sensors)}AD_STOP\n"


def _seconds(elapsed_ns: Integers) -> list[str]:
    """Seconds from nanoseconds, with all nine decimals."""
    whole, rest = np.divmod(elapsed_ns, 10**9)
    return [f"{s}.{ns:09d}" for s, ns in zip(whole.tolist(), rest.tolist(), strict=True)]


def _lines(seconds: list[str], values: Vector) -> str:
    return "".join(
        f"{time} {' '.join(row)}\n"
        for time, row in zip(seconds, rows_of_texts(values), strict=True)
    )


# AEM version 2: attitudes as a time series, a segment for each unbroken stretch.
#
# REF_FRAME_A and REF_FRAME_B fix the direction, from A to B; quaternions are scalar-last.
# Version 1 had keywords for both, which version 2 has no longer.  A rate is in the axes of
# the body, ANGVEL_FRAME.


@dataclass(frozen=True)
class Form:
    """Notation of a message (KVN or XML): functions and texts for its parts."""

    opening: Callable[[Pairs], str]
    metadata: Callable[[Pairs], str]
    states: Callable[[attitudes.AttitudeBlock], str]
    end_of_segment: str
    closing: str


def write_aem(series: attitudes.AttitudeSeries, form: Form) -> Iterator[bytes]:
    """Write a series as an AEM message.

    The states of an interval are kept in a temporary file, because its metadata, written first,
    contains the time of the last one.
    """
    yield form.opening(header(series.about)).encode()
    for stretch in attitudes.stretches(series):
        with spool() as file:
            metadata = _metadata(series.about, _spooled(stretch, form, file.write))
            yield form.metadata(metadata).encode()
            yield from pieces(file)
        yield form.end_of_segment.encode()
    yield form.closing.encode()


def _spooled(
    stretch: Iterable[attitudes.AttitudeBlock], form: Form, write: Callable[[bytes], object]
) -> Iterator[attitudes.AttitudeBlock]:
    for part in stretch:
        write(form.states(part).encode())
        yield part


def _metadata(about: attitudes.SeriesInfo, parts: Iterable[attitudes.AttitudeBlock]) -> Pairs:
    """Metadata of an unbroken interval; reads all of it."""
    start = stop = ""
    origins: set[str] = set()
    for part in parts:
        start, stop = start or part.time[0], part.time[-1]
        origins.update(part.rate_origin.tolist())
    words = RATE_WORDS.get(frozenset(origins))
    comments: Pairs = [] if words is None else [("COMMENT", f"Angular velocity {words}")]
    rates: Pairs = [] if words is None else [("ANGVEL_FRAME", REF_FRAME_B)]
    return [
        *comments,
        *identity(about),
        ("REF_FRAME_A", REF_FRAME_A),
        ("REF_FRAME_B", REF_FRAME_B),
        ("TIME_SYSTEM", TIME_SYSTEM),
        ("START_TIME", time_text(start)),
        ("STOP_TIME", time_text(stop)),
        ("ATTITUDE_TYPE", "QUATERNION" if words is None else "QUATERNION/ANGVEL"),
        *rates,
    ]


def _values(part: attitudes.AttitudeBlock) -> list[tuple[str, ...]]:
    """Numbers of each state as texts: the quaternion and, where known, the rate in deg/s."""
    values = part.quaternion
    if not np.isnan(part.rate_deg_per_s).any():
        values = np.concatenate([values, part.rate_deg_per_s], axis=1)
    return rows_of_texts(values)


def _kvn_states(part: attitudes.AttitudeBlock) -> str:
    return "".join(
        f"{time[:-1]} {' '.join(values)}\n"
        for time, values in zip(part.time.tolist(), _values(part), strict=True)
    )


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
"""Templates of an XML state by its number of values."""


def _xml_states(part: attitudes.AttitudeBlock) -> str:
    return "".join(
        _STATES[len(values)] % (time[:-1], *values)
        for time, values in zip(part.time.tolist(), _values(part), strict=True)
    )


KVN = Form(
    opening=lambda pairs: kvn([("CCSDS_AEM_VERS", "2.0")]) + kvn(pairs),
    metadata=lambda pairs: f"\nMETA_START\n{kvn(pairs)}META_STOP\n\nDATA_START\n",
    states=_kvn_states,
    end_of_segment="DATA_STOP\n",
    closing="",
)
XML = Form(
    opening=lambda pairs: xml_opening("aem", pairs),
    metadata=lambda pairs: (
        f"    <segment>\n      <metadata>\n{xml(pairs, 8)}      </metadata>\n      <data>\n"
    ),
    states=_xml_states,
    end_of_segment="      </data>\n    </segment>\n",
    closing=xml_closing("aem"),
)
write_aem_kvn = partial(write_aem, form=KVN)
write_aem_xml = partial(write_aem, form=XML)


_FRAMES = [("REF_FRAME_A", REF_FRAME_A), ("REF_FRAME_B", REF_FRAME_B)]


def write_apm(series: attitudes.AttitudeSeries) -> Iterator[bytes]:
    """Write the last attitude of a non-empty series as an APM message; reads the whole series."""
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

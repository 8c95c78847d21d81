"""ACM version 2: attitudes, covariances, and how the attitudes were determined.

Times count seconds from EPOCH_TZERO, leap seconds included.  The standard's covariances of type
ANGLE are diagonal, in deg^2: with one tracker they are of its own axes, in which the matrix is
nearly diagonal; with several they are of the body axes, and a comment says that the rest of the
matrix is left out.
"""

import re
from collections import Counter
from collections.abc import Iterator
from itertools import chain

import numpy as np

from service.products.adm import (
    REF_FRAME_A,
    REF_FRAME_B,
    TIME_SYSTEM,
    Pairs,
    header,
    kvn,
    one_line,
    time_text,
)
from service.products.attitudes import (
    AttitudeBlock,
    AttitudeSeries,
    Integers,
    SeriesInfo,
    stretches,
)
from service.products.spool import pieces, spool
from service.products.tables import rows_of_texts
from service.vectors import Vector

TRACKER_FRAME = "STARTRACKER_1"
COUNTS = ("OBSERVED", "UNIQUE", "AMBIGUOUS", "UNMATCHED")
"""Stars of all batches, in the order of `AttitudeRows.stars`."""
_ARCSEC2_IN_DEG2 = 3600.0**2
_DESIGNATOR = re.compile(r"\d{4}-\d{3}[A-Z]{1,3}")


def write_acm(series: AttitudeSeries) -> Iterator[bytes]:
    """Write a series, which has an attitude at least.

    The covariances of all stretches are kept in a temporary file: they follow the last state.
    """
    about = series.about
    methods: Counter[str] = Counter()
    stars = np.zeros(len(COUNTS), dtype=np.int64)
    zero_ns: int | None = None
    with spool() as covariances:
        for stretch in stretches(series):
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
    told = [(f"USER_DEFINED_STARS_{name}", str(count)) for name, count in counts]
    yield f"\nUSER_START\n{kvn(told)}USER_STOP\n".encode()


def _opening(about: SeriesInfo, first: str) -> str:
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


def _state_metadata(about: SeriesInfo, has_rates: bool) -> Pairs:
    told: Pairs = [
        ("REF_FRAME_A", REF_FRAME_A),
        ("REF_FRAME_B", REF_FRAME_B),
        ("NUMBER_STATES", "7" if has_rates else "4"),
        ("ATT_TYPE", "QUATERNION"),
    ]
    if not has_rates:
        return told
    comment = "Rates are as the batches gave them, else derived from the attitudes"
    if about.grade != "raw":
        comment = "Rates are estimated by the filter"
    return [("COMMENT", comment), *told, ("RATE_TYPE", "ANGVEL")]


def _states(part: AttitudeBlock, has_rates: bool) -> Vector:
    if not has_rates:
        return part.quaternion
    return np.concatenate([part.quaternion, part.rate_deg_per_s], axis=1)


def _covariance_metadata(about: SeriesInfo) -> Pairs:
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


def _variances_deg2(about: SeriesInfo, part: AttitudeBlock) -> Vector:
    p = part.covariance_arcsec2[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    if len(about.trackers) == 1:
        axes = np.array(about.trackers[0].body_from_tracker)
        p = axes.T @ p @ axes
    return np.asarray(np.diagonal(p, axis1=1, axis2=2) / _ARCSEC2_IN_DEG2)


def _determination(about: SeriesInfo, methods: Counter[str]) -> str:
    ((method, _),) = methods.most_common(1)
    told: list[tuple[str, str]] = []
    if len(methods) > 1:
        told.append(("COMMENT", "Attitudes by " + " and ".join(sorted(methods))))
    told += [
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
    return f"\nAD_START\n{kvn(told)}{''.join(sensors)}AD_STOP\n"


def _seconds(elapsed_ns: Integers) -> list[str]:
    """Seconds with all their digits."""
    whole, rest = np.divmod(elapsed_ns, 10**9)
    return [f"{s}.{ns:09d}" for s, ns in zip(whole.tolist(), rest.tolist(), strict=True)]


def _lines(seconds: list[str], values: Vector) -> str:
    return "".join(
        f"{time} {' '.join(row)}\n"
        for time, row in zip(seconds, rows_of_texts(values), strict=True)
    )

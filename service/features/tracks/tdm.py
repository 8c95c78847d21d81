"""Writer of a CCSDS Tracking Data Message (TDM, version 2, KVN), with a segment per object.

Right ascensions and declinations are as seen from the spacecraft, aberration removed, in EME2000;
times are those of the points.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from service.ephemerides.kvn import ORIGINATOR, TIME_SYSTEM, Pairs, kvn, one_line, time_text

REFERENCE_FRAME = "EME2000"


@dataclass(frozen=True)
class TrackedObject:
    """A tracked object with its points in order of time: UTC, degrees, magnitudes where known.

    `comments` are written into its segment.
    """

    name: str
    comments: Sequence[str]
    time: Sequence[str]
    ra_deg: Sequence[float]
    dec_deg: Sequence[float]
    magnitude: Sequence[float | None]


def write_tdm(
    observer: str, run: str, created: str, version: str, objects: Sequence[TrackedObject]
) -> Iterator[bytes]:
    """Write a TDM in pieces; `observer` is the spacecraft that saw the objects."""
    opening: Pairs = [
        ("CCSDS_TDM_VERS", "2.0"),
        ("COMMENT", f"Written by attitude-acquisition {one_line(version)}"),
        ("COMMENT", f"Run {one_line(run)}; points that no catalog star explains"),
        ("CREATION_DATE", time_text(created)),
        ("ORIGINATOR", ORIGINATOR),
    ]
    yield kvn(opening).encode()
    for each in objects:
        yield _segment(observer, each).encode()


def _segment(observer: str, tracked: TrackedObject) -> str:
    order = sorted(range(len(tracked.time)), key=tracked.time.__getitem__)
    times = [time_text(tracked.time[k]) for k in order]
    metadata: Pairs = [
        *(("COMMENT", one_line(each)) for each in tracked.comments),
        ("TIME_SYSTEM", TIME_SYSTEM),
        ("START_TIME", times[0]),
        ("STOP_TIME", times[-1]),
        ("PARTICIPANT_1", one_line(observer)),
        ("PARTICIPANT_2", one_line(tracked.name)),
        ("MODE", "SEQUENTIAL"),
        ("PATH", "2,1"),
        ("ANGLE_TYPE", "RADEC"),
        ("REFERENCE_FRAME", REFERENCE_FRAME),
    ]
    lines = []
    for k, time in zip(order, times, strict=True):
        lines.append(f"ANGLE_1 = {time} {tracked.ra_deg[k]!r}\n")
        lines.append(f"ANGLE_2 = {time} {tracked.dec_deg[k]!r}\n")
        if tracked.magnitude[k] is not None:
            lines.append(f"MAG = {time} {tracked.magnitude[k]!r}\n")
    return f"\nMETA_START\n{kvn(metadata)}META_STOP\n\nDATA_START\n{''.join(lines)}DATA_STOP\n"

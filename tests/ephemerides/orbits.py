"""Orbits, and files of them."""

import math

import numpy as np

from service.times import parse_utc, shifted

START = parse_utc("2022-01-17T12:00:00Z")
MU_KM3_PER_S2 = 398_600.4418


def orbit(seconds):
    """States (n, 6) of a circle at 6,800 km, inclined by 51.6 deg, km and km/s."""
    radius, tilt = 6_800.0, math.radians(51.6)
    rate = math.sqrt(MU_KM3_PER_S2 / radius**3)
    angle = rate * np.asarray(seconds, dtype=float)[:, None]
    along = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, math.cos(tilt), math.sin(tilt)]])
    position = radius * (np.cos(angle) * along[0] + np.sin(angle) * along[1])
    velocity = radius * rate * (np.cos(angle) * along[1] - np.sin(angle) * along[0])
    return np.hstack([position, velocity])


def oem_text(seconds, *, start=START, extra=(), version="2.0", **metadata):
    """A segment of an OEM in KVN, with its header."""
    times = [shifted(start, second).text[:-1] for second in seconds]
    told = {
        "OBJECT_NAME": "ISS",
        "OBJECT_ID": "1998-067A",
        "CENTER_NAME": "Earth",
        "REF_FRAME": "EME2000",
        "TIME_SYSTEM": "UTC",
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
    } | metadata
    lines = [
        f"CCSDS_OEM_VERS = {version}",
        "CREATION_DATE = 2022-01-17T20:44:45.347",
        "ORIGINATOR = NASA",
        "META_START",
        *(f"{name} = {value}" for name, value in told.items()),
        "META_STOP",
        "COMMENT states",
    ]
    for time, state in zip(times, orbit(seconds), strict=True):
        lines.append(" ".join([time, *(repr(float(each)) for each in state)]))
    return "\n".join([*lines, *extra]) + "\n"


def with_checksum(line):
    line = line[:68].ljust(68)
    return line + str(sum(int(each) if each.isdigit() else each == "-" for each in line) % 10)


ISS = [
    with_checksum("1 25544U 98067A   22017.50000000  .00006000  00000-0  11466-3 0  999"),
    with_checksum("2 25544  51.6441 331.4200 0006817  60.2000  80.1000 15.49600000 3217"),
]
ISS_EPOCH = parse_utc("2022-01-17T12:00:00Z")

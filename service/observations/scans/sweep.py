"""The angle of a star from the times at which it crossed the wires of a sweep."""

import math
from typing import NamedTuple

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.missions.scan import Sweep
from service.vectors import Vector


class Crossing(NamedTuple):
    """A star's measured angle at a time after the sweep began, with the angle's sigma."""

    angle_deg: float
    time_s: float
    sigma_arcsec: float


def crossing_of(times: Vector, scan: Sweep, field: str) -> Crossing:
    """The mean over the wires, in the middle of their times.

    `times` are in the mission's unit.  Raises `BadBatch` naming `field` for another number of
    times than of wires, times that do not rise, and times after the end of the sweep.
    """
    wires_deg = np.array(scan.wires_deg)
    if len(times) != len(wires_deg):
        there_are = f"has {len(times)} times; the tracker has {len(wires_deg)} wires"
        raise BadBatch(Fault(field, there_are))
    seconds = times * scan.time_unit_s
    late = np.flatnonzero(seconds > scan.duration_s)
    if len(late):
        at = int(late[0])
        message = f"is outside of the scan, which lasts {scan.duration_s:g} s"
        raise BadBatch(Fault(f"{field}.{at}", message, shown_value(float(times[at]))))
    early = np.flatnonzero(np.diff(times) <= 0.0)
    if len(early):
        at = int(early[0]) + 1
        message = "is not after the time before it: a star crosses the wires one after the other"
        raise BadBatch(Fault(f"{field}.{at}", message, shown_value(float(times[at]))))
    angles_deg = scan.start_deg + scan.rate_deg_per_s * seconds - wires_deg
    sigma_deg = scan.rate_deg_per_s * scan.time_sigma_s / math.sqrt(len(times))
    return Crossing(float(angles_deg.mean()), float(seconds.mean()), 3600.0 * sigma_deg)

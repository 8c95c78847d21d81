"""What a scanning tracker would count or time of a star that stands in a known direction."""

import math
from typing import Any

import numpy as np

from service.missions.mission import Tracker
from service.missions.scan import CrossScan, Sweep
from service.observations.focal_plane import measured_angles_deg
from service.vectors import Vector, rotate_about

IMAGE_SIGMA_SAMPLES = 1.2
LIGHT_OVER_NOISE = 300.0
"""Of a star of `LIGHT_AT_MAG`: the sum of its samples over the noise of one."""
LIGHT_AT_MAG, FAINTEST_MAG = 5.0, 7.5
FULL_SHARE = 0.8
MOST_STEPS_OFF = 2.0
_ROUNDS = 20


def readings(
    tracker: Tracker,
    direction: Vector,
    rates_rad_per_s: Vector,
    magnitude_mag: float,
    rng: np.random.Generator,
) -> dict[str, Any] | None:
    """The fields of a star that the tracker's scan gives, with their noise.

    `direction` (3,) is in tracker axes, at the star's time; a sweep begins then, and the body
    turns on with `rates_rad_per_s` (3,), about the tracker's axes.  None where the scan does not
    reach the star, and for a raster, which has no stars by themselves.
    """
    if isinstance(tracker.scan, CrossScan):
        return _counts(tracker, tracker.scan, direction, magnitude_mag, rng)
    if isinstance(tracker.scan, Sweep):
        return _times(tracker, tracker.scan, direction, rates_rad_per_s, rng)
    return None


def _counts(
    tracker: Tracker,
    scan: CrossScan,
    direction: Vector,
    magnitude_mag: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    angles = measured_angles_deg(direction[None], tracker.calibration)[0]
    step_deg = scan.step_arcsec / 3600.0
    nominal = np.round(angles + rng.uniform(-MOST_STEPS_OFF, MOST_STEPS_OFF, 2) * step_deg, 6)
    brightness = 10.0 ** (0.4 * (LIGHT_AT_MAG - min(magnitude_mag, FAINTEST_MAG)))
    light = LIGHT_OVER_NOISE * scan.noise_counts * brightness
    if scan.saturation_counts is not None:
        room = FULL_SHARE * (scan.saturation_counts - scan.background_counts)
        light = min(light, room * IMAGE_SIGMA_SAMPLES * math.sqrt(math.tau))
    samples = np.arange(scan.samples) - scan.samples // 2
    star: dict[str, Any] = {"h_deg": float(nominal[0]), "v_deg": float(nominal[1])}
    for axis, off in zip("hv", (angles - nominal) / step_deg, strict=True):
        image = np.exp(-0.5 * ((samples - off) / IMAGE_SIGMA_SAMPLES) ** 2)
        counts = scan.background_counts + light * image / image.sum()
        variance = np.full(scan.samples, scan.noise_counts**2)
        if scan.gain_e_per_count is not None:
            variance += counts / scan.gain_e_per_count
        noisy = counts + rng.normal(0.0, np.sqrt(variance))
        star[f"{axis}_counts"] = np.maximum(np.round(noisy, 1), 0.0).tolist()
    return star


def _times(
    tracker: Tracker, scan: Sweep, direction: Vector, rates: Vector, rng: np.random.Generator
) -> dict[str, Any] | None:
    star: dict[str, Any] = {}
    for axis, after_s in ((0, 0.0), (1, scan.v_after_s)):
        seconds = []
        for wire_deg in scan.wires_deg:
            passed_s = 0.0
            # The star moves much slower than the sweep: a fixed point is reached in a few rounds.
            for _ in range(_ROUNDS):
                turned = rotate_about(-rates * (after_s + passed_s), direction[None])
                angle_deg = measured_angles_deg(turned, tracker.calibration)[0, axis]
                passed_s = (angle_deg + wire_deg - scan.start_deg) / scan.rate_deg_per_s
            seconds.append(passed_s + rng.normal(0.0, scan.time_sigma_s))
        if not 0.0 <= min(seconds) <= max(seconds) <= scan.duration_s:
            return None
        star[f"{'hv'[axis]}_times"] = [round(each / scan.time_unit_s, 6) for each in seconds]
    return star

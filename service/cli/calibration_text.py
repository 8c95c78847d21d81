"""A calibration as text for people, and as JSON."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from service.vectors import ARCSEC_PER_RADIAN, Vector

if TYPE_CHECKING:
    from service.app.calibrations.estimates import CalibrationRun
    from service.calibration.estimate import Calibration

CERTAIN_SIGMAS = 3.0
VECTORS = (
    "scale and distortion in a mission file correct stars sent as angles (h_deg, v_deg) only, "
    "not those sent as vectors"
)
TIME_TAGS = "mission files hold no time tag: add it to time_offset_s where telemetry is made"


def calibration_text(result: "CalibrationRun") -> str:
    """Parameters with sigmas, residuals before and after, and what the stars do not show."""
    found = result.found
    summary = (
        f"{result.used} of {result.sampled} batches had identified stars ({result.total} in the "
        f"period, {result.first} to {result.last}); {len(found.stars)} stars, "
        f"{int(np.sum(~found.used))} left out as wrong."
    )
    lines = [summary, "", *_residual_lines(found)]
    if result.tried:
        tried = ", ".join(
            f"{each.degree}: {each.residual_over_sigma:.3f}{' (chosen)' if each.chosen else ''}"
            for each in result.tried
        )
        lines += ["", f"Held-out residual over sigma by degree of the distortion: {tried}."]
    lines += ["", f"{'':2}{'unknown':34}{'value':>14}{'sigma':>12}  unit"]
    for unknown, value, sigma in zip(found.unknowns, found.value, found.sigma, strict=True):
        mark = "* " if abs(value) > CERTAIN_SIGMAS * sigma else "  "
        lines.append(f"{mark}{unknown.name:34}{value:>14.6g}{sigma:>12.2g}  {unknown.unit}")
    lines.append(f"* differs from the mission's by more than {CERTAIN_SIGMAS:g} sigmas")
    lines += ["", "Not observable:"]
    lines += [f"  {each.name}: {each.reason}." for each in found.not_observable]
    lines += ["", *(f"Note: {each}." for each in notes(found))]
    return "\n".join(lines).rstrip()


def _residual_lines(found: "Calibration") -> list[str]:
    lines = ["Residuals per axis, rms (with the present mission file -> calibrated):"]
    lines += [
        (
            f"  {each['tracker']}: {each['before_arcsec']:.2f} -> {each['after_arcsec']:.2f} "
            f"arcsec, {each['before_over_sigma']:.2f} -> {each['after_over_sigma']:.2f} sigmas, "
            f"{each['stars']} stars"
        )
        for each in residuals_by_tracker(found)
    ]
    lines.append(f"  together, per degree of freedom: {found.residual_over_sigma:.3f} sigmas")
    return lines


def residuals_by_tracker(found: "Calibration") -> list[dict[str, Any]]:
    """Of each tracker the rms of the residuals of used stars, before and after."""
    sigma_arcsec = found.stars.sigma_rad[:, None] * ARCSEC_PER_RADIAN
    rows = []
    for index, tracker in enumerate(found.stars.trackers):
        own = found.used & (found.stars.tracker == index)
        if own.any():
            rows.append(
                {
                    "tracker": tracker.name,
                    "stars": int(own.sum()),
                    "before_arcsec": _rms((found.before * sigma_arcsec)[own]),
                    "after_arcsec": _rms((found.residual * sigma_arcsec)[own]),
                    "before_over_sigma": _rms(found.before[own]),
                    "after_over_sigma": _rms(found.residual[own]),
                }
            )
    return rows


def _rms(values: Vector) -> float:
    return math.sqrt(float(np.mean(values**2)))


def notes(found: "Calibration") -> list[str]:
    """What a mission file cannot hold of this calibration."""
    kinds = {each.kind for each in found.unknowns}
    told = [VECTORS] if kinds & {"scale", "distortion"} else []
    return told + ([TIME_TAGS] if "time_tag" in kinds else [])


def calibration_json(result: "CalibrationRun") -> dict[str, Any]:
    """The result with its covariance, in the units of the unknowns."""
    found = result.found
    return {
        "batches": {
            "total": result.total,
            "sampled": result.sampled,
            "used": result.used,
            "refused": result.refused,
            "first": result.first,
            "last": result.last,
        },
        "stars": len(found.stars),
        "stars_left_out": int(np.sum(~found.used)),
        "degree": found.model.degree,
        "held_out": [
            {
                "degree": each.degree,
                "residual_over_sigma": each.residual_over_sigma,
                "chosen": each.chosen,
            }
            for each in result.tried
        ],
        "residual_over_sigma": found.residual_over_sigma,
        "residuals": residuals_by_tracker(found),
        "unknowns": [
            {
                "name": unknown.name,
                "tracker": found.stars.trackers[unknown.tracker].name,
                "kind": unknown.kind,
                "value": float(value),
                "sigma": float(sigma),
                "unit": unknown.unit,
            }
            for unknown, value, sigma in zip(found.unknowns, found.value, found.sigma, strict=True)
        ],
        "covariance": found.covariance.tolist(),
        "not_observable": [
            {"name": each.name, "reason": each.reason} for each in found.not_observable
        ],
        "notes": notes(found),
    }

"""Calibration results as text for a terminal."""

from typing import Any

import msgspec
import numpy as np

from service.features.calibration import estimates
from service.features.calibration.estimate import Calibration
from service.features.calibration.estimates import CalibrationRun

CERTAIN_SIGMAS = 3.0


def calibration_text(result: CalibrationRun) -> str:
    """Format a calibration: parameters with sigmas, residuals, undetermined parameters."""
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
    for each in estimates.unknowns_of(result):
        mark = "* " if abs(each.value) > CERTAIN_SIGMAS * each.sigma else "  "
        lines.append(f"{mark}{each.name:34}{each.value:>14.6g}{each.sigma:>12.2g}  {each.unit}")
    lines.append(f"* differs from the mission's by more than {CERTAIN_SIGMAS:g} sigmas")
    lines += ["", "Not observable:"]
    lines += [f"  {each.name}: {each.reason}." for each in estimates.not_observable_of(result)]
    lines += ["", *(f"Note: {each}." for each in estimates.notes(result))]
    return "\n".join(lines).rstrip()


def _residual_lines(found: Calibration) -> list[str]:
    lines = ["Residuals per axis, rms (with the present mission file -> calibrated):"]
    lines += [
        (
            f"  {each.tracker}: {each.before_arcsec:.2f} -> {each.after_arcsec:.2f} "
            f"arcsec, {each.before_over_sigma:.2f} -> {each.after_over_sigma:.2f} sigmas, "
            f"{each.stars} stars"
        )
        for each in estimates.residuals_by_tracker(found)
    ]
    lines.append(f"  together, per degree of freedom: {found.residual_over_sigma:.3f} sigmas")
    return lines


def calibration_json(result: CalibrationRun) -> dict[str, Any]:
    """Result of a calibration as in `GET /api/v1/calibrations/{id}`, with its covariance."""
    found: dict[str, Any] = msgspec.to_builtins(estimates.result_of(result))
    return found | {"covariance": result.covariance.tolist()}

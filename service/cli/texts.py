"""Calibrations and compared runs as text for a terminal."""

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from service.app import calibration_estimates
from service.contract.runs import RunComparison, RunTransition
from service.ingest.reprocess import ReprocessProgress

if TYPE_CHECKING:
    from service.app.calibration_estimates import CalibrationRun
    from service.calibration.estimate import Calibration

WIDTH = 96


CERTAIN_SIGMAS = 3.0


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
    for each in calibration_estimates.unknowns_of(result):
        mark = "* " if abs(each.value) > CERTAIN_SIGMAS * each.sigma else "  "
        lines.append(f"{mark}{each.name:34}{each.value:>14.6g}{each.sigma:>12.2g}  {each.unit}")
    lines.append(f"* differs from the mission's by more than {CERTAIN_SIGMAS:g} sigmas")
    lines += ["", "Not observable:"]
    lines += [
        f"  {each.name}: {each.reason}." for each in calibration_estimates.not_observable_of(result)
    ]
    lines += ["", *(f"Note: {each}." for each in calibration_estimates.notes(result))]
    return "\n".join(lines).rstrip()


def _residual_lines(found: "Calibration") -> list[str]:
    lines = ["Residuals per axis, rms (with the present mission file -> calibrated):"]
    lines += [
        (
            f"  {each.tracker}: {each.before_arcsec:.2f} -> {each.after_arcsec:.2f} "
            f"arcsec, {each.before_over_sigma:.2f} -> {each.after_over_sigma:.2f} sigmas, "
            f"{each.stars} stars"
        )
        for each in calibration_estimates.residuals_by_tracker(found)
    ]
    lines.append(f"  together, per degree of freedom: {found.residual_over_sigma:.3f} sigmas")
    return lines


def calibration_json(result: "CalibrationRun") -> dict[str, Any]:
    """The result as `GET /api/v1/calibrations/{id}` has it, with its covariance."""
    found: dict[str, Any] = msgspec.to_builtins(calibration_estimates.result_of(result))
    return found | {"covariance": result.covariance.tolist()}


WORDS = {"good": "attitudes good", "suspect": "attitudes suspect", "none": "no attitude"}


def progress_text(progress: ReprocessProgress) -> str:
    """The number of processed batches."""
    done = (
        f"{progress.recorded} recorded, {progress.before} there already, {progress.refused} refused"
    )
    return f"run {progress.run}, of {progress.total} batches:\n  {done}"


def comparison_text(compared: RunComparison) -> str:
    """The stars and attitudes of both runs."""
    stars, attitudes = compared.stars, compared.attitudes
    observed = stars.observed or 1
    lines = [
        "",
        f"{'':<26}{compared.run or 'every run':>16}{compared.other:>28}",
        f"{'batches in both':<26}{compared.batches:>16}{compared.batches:>28}",
        f"{'stars':<26}{stars.observed:>16}{stars.observed:>28}",
    ]
    for outcome in ("unique", "ambiguous", "unmatched"):
        before, after = (getattr(each, outcome) for each in (stars.before, stars.after))
        lines.append(f"  {outcome:<24}{_share(before, observed):>16}{_share(after, observed):>28}")
    for status, name in WORDS.items():
        before, after = (getattr(each, status) for each in (attitudes.before, attitudes.after))
        lines.append(f"{name:<26}{before:>16}{after:>28}")
    angle = attitudes.angle_arcsec
    if angle is not None:
        lines += ["", f"angle between the {attitudes.in_both} attitudes that both have:"]
        lines.append(
            f"  median {angle.median:.3f}″, 95 % within {angle.p95:.3f}″, at most {angle.max:.3f}″"
        )
    changed = [each for each in stars.transitions if each.is_change]
    if changed:
        lines += ["", "stars that came out otherwise:"]
        lines += [f"  {each.stars:>8}  {_words(each)}" for each in changed]
    elif compared.batches:
        lines += ["", "every star came out alike"]
    return "\n".join(lines)


def _share(count: int, observed: int) -> str:
    return f"{count} ({100 * count / observed:.2f} %)"


def _words(each: RunTransition) -> str:
    if each.before == each.after:
        return "unique in both, but not the same star"
    return f"{each.before} before, {each.after} after"

"""Comparison of answers with the truth: right and wrong stars, attitude errors and sigmas."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from service.vectors import attitude_error_arcsec, matrix_from_quaternion

CHI_SQUARE_997 = 14.16
"""The 99.73 % point of chi-square with three degrees of freedom."""
GAUSSIAN_MEDIAN = 0.6745
"""Median of |x| for a Gaussian x with sigma one, to estimate sigma robustly by a median."""


@dataclass
class Score:
    """Accumulated comparison of answers with the truth, for batches with one kind of error."""

    batches: int = 0
    refused: int = 0
    stars: Counter[str] = field(default_factory=Counter)
    """Numbers of stars by outcome, `observed` for all, and `wrong`: unique, but a false star."""
    worst_axis_arcsec: list[float] = field(default_factory=list)
    predicted_arcsec: list[float] = field(default_factory=list)
    chi_square: list[float] = field(default_factory=list)
    """Normalised error e^T P^-1 e of each attitude, with its error e and covariance P."""
    solving_us: list[float] = field(default_factory=list)
    whole_us: list[float] = field(default_factory=list)

    def add(self, answer: Mapping[str, Any], truth: Mapping[str, Any]) -> None:
        """Count one answer, compared with the truth of its batch."""
        self.batches += 1
        true_of = {each["tracker"]: each["stars"] for each in truth["observations"]}
        for tracker in answer["observations"]:
            for star, true in zip(tracker["stars"], true_of[tracker["tracker"]], strict=True):
                self.stars["observed"] += 1
                self.stars[star["outcome"]] += 1
                if star["star"] is not None and star["star"]["id"] != true:
                    self.stars["wrong"] += 1
        timings = answer["timings_us"]
        self.solving_us.append(timings["identify"] + timings["solve"])
        self.whole_us.append(sum(us for us in timings.values() if us is not None))
        if answer["attitude"] is not None:
            self._add_attitude(answer["attitude"], truth["quaternion"])

    def _add_attitude(self, attitude: Mapping[str, Any], true_quaternion: list[float]) -> None:
        error = attitude_error_arcsec(
            matrix_from_quaternion(attitude["quaternion"]), matrix_from_quaternion(true_quaternion)
        )
        covariance = np.asarray(attitude["covariance_arcsec2"])
        variances, axes = np.linalg.eigh(covariance)
        self.worst_axis_arcsec.append(abs(float(error @ axes[:, -1])))
        self.predicted_arcsec.append(float(np.sqrt(variances[-1])))
        self.chi_square.append(float(error @ np.linalg.solve(covariance, error)))

    def percent(self, outcome: str) -> float:
        """Percentage of the observed stars with an outcome, NaN without stars."""
        observed = self.stars["observed"]
        return 100.0 * self.stars[outcome] / observed if observed else float("nan")

    @property
    def attitudes(self) -> int:
        """Number of batches with an attitude."""
        return len(self.chi_square)

    @property
    def seen_sigma_arcsec(self) -> float:
        """Robust sigma in arcsec of the attitudes' actual errors about their worst axes."""
        return _median(self.worst_axis_arcsec) / GAUSSIAN_MEDIAN

    @property
    def predicted_sigma_arcsec(self) -> float:
        """Median in arcsec of the errors that covariances predict about the worst axes."""
        return _median(self.predicted_arcsec)

    @property
    def within_percent(self) -> float:
        """Percentage of attitudes within the 99.73 % error ellipsoid."""
        inside = sum(each <= CHI_SQUARE_997 for each in self.chi_square)
        return 100.0 * inside / self.attitudes if self.attitudes else float("nan")

    @property
    def median_solving_us(self) -> float:
        """Median time of identification and solution together, in microseconds."""
        return _median(self.solving_us)

    @property
    def median_whole_us(self) -> float:
        """Median time of all steps of an answer, recording included, in microseconds."""
        return _median(self.whole_us)


def score(
    results: Iterable[Mapping[str, Any]], truths: Iterable[Mapping[str, Any]]
) -> dict[str, Score]:
    """Scores of results against truths in the same order, by kind of simulated error.

    A refused batch is counted as such and has no stars.
    """
    scores: dict[str, Score] = {}
    for result, truth in zip(results, truths, strict=True):
        stretch = scores.setdefault(truth["stretch"], Score())
        if "problem" in result:
            stretch.refused += 1
        else:
            stretch.add(result, truth)
    return scores


def together(scores: Iterable[Score]) -> Score:
    """The score of all batches behind several scores together."""
    whole = Score()
    for each in scores:
        whole.batches += each.batches
        whole.refused += each.refused
        whole.stars += each.stars
        lists = ("worst_axis_arcsec", "predicted_arcsec", "chi_square", "solving_us", "whole_us")
        for name in lists:
            getattr(whole, name).extend(getattr(each, name))
    return whole


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def score_table(scores: dict[str, dict[str, Score]]) -> str:
    """Table of scores, with a row each for nominal intervals and for errors of every mission."""
    head = (
        f"{'':<15}{'batches':>8}{'stars':>7}{'unique':>9}{'ambig.':>8}{'unmatch.':>9}{'wrong':>8}"
        f"{'attitudes':>11}{'error':>8}{'sigma':>7}{'within':>8}{'solve':>8}{'whole':>8}"
    )
    units = (
        f"{'':<15}{'':>8}{'':>7}{'%':>9}{'%':>8}{'%':>9}{'%':>8}"
        f"{'':>11}{'arcsec':>8}{'arcsec':>7}{'%':>8}{'µs':>8}{'µs':>8}"
    )
    lines = [head, units]
    for name, stretches in scores.items():
        lines.append(_row(f"{name} nominal", stretches.get("nominal", Score())))
        serious = [each for kind, each in stretches.items() if kind != "nominal"]
        lines.append(_row(f"{name} serious", together(serious)))
    notes = (
        "nominal: the a priori error that the mission allows for; serious: a growing attitude",
        "error and false stars.  wrong: reported as unique, but not the true star.  error, sigma:",
        "one sigma along the attitude's worst axis, as measured and as predicted by the",
        "covariance.  within: attitudes inside their own 99.7 % region.  solve:",
        "identification and solution; whole: zone and recording too; medians of a batch.",
    )
    return "\n".join([*lines, "", *notes])


def _row(title: str, of: Score) -> str:
    return (
        f"{title:<15}{of.batches:>8}{of.stars['observed']:>7}{of.percent('unique'):>9.2f}"
        f"{of.percent('ambiguous'):>8.2f}{of.percent('unmatched'):>9.2f}{of.percent('wrong'):>8.2f}"
        f"{of.attitudes:>11}{of.seen_sigma_arcsec:>8.2f}{of.predicted_sigma_arcsec:>7.2f}"
        f"{of.within_percent:>8.2f}{of.median_solving_us:>8.0f}{of.median_whole_us:>8.0f}"
    )

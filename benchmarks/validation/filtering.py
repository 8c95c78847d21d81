"""Filter and smoother of attitude and gyro bias over simulated passes of three hours.

Results are compared with Farrenkopf's steady state, and with their own covariances over many runs.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, between
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import FilterSettings
from service.features.definitive.kernels.result import AttitudeHistory
from service.features.definitive.kernels.smoother import smooth
from service.gyro.samples import GyroModel
from tests import chance
from tests.features.definitive import simulated
from tests.features.definitive.farrenkopf import steady_sigmas
from tests.features.definitive.simulated import ARCSEC

Array = npt.NDArray[np.float64]

RUNS, QUICK_RUNS = 200, 12
HOURS, SETTLED_HOURS = 3, 2
GAP_S = 600
DAY_S, TIMES_FASTER = 86400, 10_000
HEAD = "arcsec, across / about the boresight"
COLUMNS = (
    "Farrenkopf",
    "filter's sigma",
    "filter's rms",
    "smoother's rms",
    "NEES/6",
    "NIS/3",
    "smoother's NEES/6",
    "NEES inside",
    "NIS inside",
)
GROUP = 10
INSIDE = (
    "share of epochs within the 95 % region of one run / of the mean over ten runs / of the mean "
    "over all: .95 is expected of each. The errors of an epoch last about 1,000 s, so the means "
    "of many epochs leave their region together: for exact filters of the second case the shares "
    "scatter by .003, .009 and .035 (one sigma, 80 simulations of 200 runs)"
)
SINGLE, QUICK_SINGLE = 0.016, 0.10
"""Greatest difference of the share of single runs from .95: five sigmas of exact filters."""
OFF, QUICK_OFF = 0.08, 0.33
"""Greatest difference of the mean of NEES/6 from 1: five sigmas of exact filters, 200 runs."""
RMS_PERCENT, QUICK_RMS_PERCENT = 11.5, 46.0
"""Greatest difference in percent of an rms error from its sigma: five standard errors.

The standard error of 2.3 % is that of the second case's closed loop, whose squared errors last 730
s, over the last hour of 200 runs.
"""
CHECKED_S = (600, 3600, HOURS * 3600)
"""Epochs at which the sum over the independent runs is compared with chi-square."""
SIGMA_V, SIGMA_U = math.sqrt(10.0) * 1e-7, math.sqrt(10.0) * 1e-10
SOURCES = (
    "service/features/definitive/kernels",
    "service/attitude/quaternions.py",
    "service/vectors.py",
    "tests/features/definitive/simulated.py",
    "tests/features/definitive/farrenkopf.py",
)


@dataclass(frozen=True)
class Case:
    """Case: trackers with `sigmas_arcsec` about x, y, z measure every `every_s`; gyro at 1 Hz.

    A case with `gap` has no tracker for 600 s before the last hour.  `largest_ratio` bounds the
    ratio of the smoothed to the filtered variance.
    """

    name: str
    model: GyroModel
    every_s: int
    sigmas_arcsec: tuple[float, float, float]
    gap: bool = False
    errors: bool = False
    largest_ratio: float = 0.6

    @property
    def steady(self) -> bool:
        """True if Farrenkopf's solution is valid."""
        return not (self.gap or self.errors)


FINE, MEMS = GyroModel(SIGMA_V, SIGMA_U), GyroModel(5e-6, 1e-8)
CASES = (
    Case("6/40 arcsec, 1 Hz", FINE, 1, (6.0, 6.0, 40.0)),
    Case("20/25 arcsec every 8 s", FINE, 8, (20.0, 20.0, 25.0)),
    Case("the same, gap of 600 s", FINE, 8, (20.0, 20.0, 25.0), gap=True),
    # The steady ratio of so coarse a gyro is .603: the past says less about the present.
    Case("MEMS gyro, 6/40 arcsec, 1 Hz", MEMS, 1, (6.0, 6.0, 40.0), largest_ratio=0.61),
    Case(
        "20/25 arcsec every 8 s, slews, scale and alignment off by 1e-4",
        GyroModel(SIGMA_V, SIGMA_U, scale=1e-4, misalignment_rad=1e-4),
        8,
        (20.0, 20.0, 25.0),
        errors=True,
    ),
)


@dataclass
class Measured:
    """Results of the runs of one case; sigmas and errors in arcsec about x, y, z."""

    case: Case
    nees: list[Array] = field(default_factory=list)
    nis: list[Array] = field(default_factory=list)
    smoothed_nees: list[Array] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    smoothed_errors: list[Array] = field(default_factory=list)
    sigma: Array = field(default_factory=lambda: np.zeros(3))
    mean_variance: Array = field(default_factory=lambda: np.zeros(3))
    ratio: tuple[float, float] = (math.nan, math.nan)
    starts: int = 0

    def share_inside(self, values: Sequence[Array], degrees: int, runs: int | None = None) -> float:
        """Share of epochs whose mean over groups of runs is within its 95 % region.

        Without `runs` the mean is over all runs.
        """
        runs = runs or len(values)
        low, high = chi2.ppf([0.025, 0.975], degrees * runs) / runs
        groups = np.reshape(values[: len(values) // runs * runs], (-1, runs, len(values[0])))
        means = groups.mean(axis=1)
        return float(np.mean((means >= low) & (means <= high)))


def run_case(case: Case, runs: int, rng: np.random.Generator) -> Measured:
    """Results of all runs of one case: the same motion with different noise."""
    rate = simulated.slews if case.errors else simulated.inertial_hold
    truth = simulated.truth_of(rate, HOURS * 3600.0)
    rows = np.arange(0, HOURS * 3600 + 1, case.every_s)
    if case.gap:
        settled = SETTLED_HOURS * 3600
        rows = rows[(rows <= settled - GAP_S) | (rows >= settled)]
    found = Measured(case)
    for _ in tqdm(range(runs), desc=case.name, leave=False):
        one_run(case, truth, rows, rng, found)
    found.mean_variance /= runs
    return found


def one_run(
    case: Case, truth: Any, rows: npt.NDArray[np.int64], rng: np.random.Generator, found: Measured
) -> None:
    """Filter and smooth one pass, and append its figures to the results."""
    errors = simulated.random_errors(case.model, rng) if case.errors else None
    gyro, bias = simulated.gyro_of(truth, case.model, rng, errors=errors)
    if errors is not None:
        bias = bias + truth.rate_rad_s @ errors.T
    attitudes = simulated.attitudes_of(truth, rows, case.sigmas_arcsec, rng)
    result = filter_attitude(case.model, gyro, attitudes)
    smoothed = smooth(result, case.model)
    settled, n = SETTLED_HOURS * 3600, len(truth.time_s)
    found.starts += result.starts
    found.nees.append(simulated.nees(result.history, truth, bias))
    found.smoothed_nees.append(simulated.nees(smoothed, truth, bias))
    found.nis.append(result.innovations.nis[1:])
    late = slice(settled, None)
    measured = rows[rows >= settled]
    found.errors.append(simulated.attitude_errors(result.history, truth)[measured] / ARCSEC)
    found.smoothed_errors.append(simulated.attitude_errors(smoothed, truth)[late] / ARCSEC)
    found.mean_variance += variances(result.history)[measured].mean(axis=0)
    found.sigma = np.sqrt(variances(result.history)[-1])
    middle = slice(n // 4, n - n // 4)
    ratios = variances(smoothed)[middle] / variances(result.history)[middle]
    found.ratio = float(ratios.min()), float(ratios.max())


def variances(history: AttitudeHistory) -> Array:
    """Variances (n, 3) about the body axes in arcsec^2, without additions by single rejections."""
    return np.asarray(np.diagonal(history.model_covariance, axis1=1, axis2=2)[:, :3] / ARCSEC**2)


def bounds_of(found: Measured, quick: bool) -> list[Bound]:
    """Bounds of one case; wider with a few runs."""
    case, name = found.case, found.case.name
    off, single = (QUICK_OFF, QUICK_SINGLE) if quick else (OFF, SINGLE)
    least = 1.0 - off if not case.errors else 0.3
    runs = len(found.nees)
    begun_anew = chance.at_most(6 * runs, FilterSettings().start_gate_tail)
    bounds = [
        between(f"{name}: mean of NEES/6", float(np.mean(found.nees)) / 6.0, least, 1.0 + off),
        between(f"{name}: mean of NIS/3", float(np.mean(found.nis)) / 3.0, 1.0 - off, 1.0 + off),
        # Each of six measurements that confirm a start begins it anew with this probability.
        at_most(f"{name}: starts in a run", found.starts / runs, 1.0 + begun_anew / runs),
    ]
    if case.errors:
        return bounds
    epochs = len(found.nis[0])
    bounds += [
        between(
            f"{name}: epochs of single runs with NEES inside",
            found.share_inside(found.nees, 6, 1),
            0.95 - single,
            0.95 + single,
        ),
        between(
            f"{name}: epochs of single runs with NIS inside",
            found.share_inside(found.nis, 3, 1),
            0.95 - single,
            0.95 + single,
        ),
        # Innovations are white: nothing leaves the region together.
        at_least(
            f"{name}: epochs with the mean NIS inside",
            found.share_inside(found.nis, 3),
            chance.at_least(epochs, 0.95) / epochs,
        ),
    ]
    freedom = 6 * runs
    low, high = chi2.ppf([chance.TAIL, 1.0 - chance.TAIL], freedom) / freedom
    bounds += [
        between(
            f"{name}: mean of NEES/6 over the runs at {at_s} s",
            float(np.mean([each[at_s] for each in found.nees])) / 6.0,
            float(low),
            float(high),
        )
        for at_s in CHECKED_S
    ]
    if case.steady:
        apart = np.abs(found.sigma / steady_of(case) - 1.0).max()
        rms = np.sqrt(np.mean(np.square(found.errors), axis=(0, 1)) / found.mean_variance)
        bounds += [
            at_most(f"{name}: sigma off Farrenkopf's, %", 100.0 * float(apart), 3.0),
            at_most(
                f"{name}: rms error off its sigma, %",
                100.0 * float(np.abs(rms - 1.0).max()),
                QUICK_RMS_PERCENT if quick else RMS_PERCENT,
            ),
            at_least(f"{name}: smoothed over filtered variance, least", found.ratio[0], 0.2),
            at_most(
                f"{name}: smoothed over filtered variance, largest",
                found.ratio[1],
                case.largest_ratio,
            ),
        ]
    return bounds


def steady_of(case: Case) -> Array:
    """Farrenkopf's sigmas after an update, in arcsec."""
    v, u = case.model.sigma_v_rad_s0_5, case.model.sigma_u_rad_s1_5
    pairs = [steady_sigmas(s * ARCSEC, case.every_s, v, u) for s in case.sigmas_arcsec]
    return np.array([after for _, after in pairs]) / ARCSEC


def measured(quick: bool, seed: int) -> list[Measured]:
    """Results of all cases."""
    rng = np.random.default_rng(seed)
    return [run_case(case, QUICK_RUNS if quick else RUNS, rng) for case in CASES]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the accuracy and consistency of filter and smoother."""
    cases = measured(quick, seed)
    figures: dict[str, Any] = {HEAD: ", ".join(COLUMNS)}
    figures |= {each.case.name: ", ".join(row_of(each)[1:]) for each in cases}
    figures["inside"] = INSIDE
    took_s = day_s(seed)
    figures["a day at 1 Hz, times faster than it lasted"] = DAY_S / took_s
    bounds = [b for each in cases for b in bounds_of(each, quick)]
    most_s = DAY_S / TIMES_FASTER
    return Report("filtering", figures, [*bounds, at_most("a day at 1 Hz", took_s, most_s, "s")])


def day_s(seed: int) -> float:
    """Seconds to filter and smooth a day of gyro samples and attitudes at 1 Hz, precompiled."""
    rng = np.random.default_rng(seed)
    truth = simulated.truth_of(simulated.orbital_rate, float(DAY_S))
    gyro, _ = simulated.gyro_of(truth, FINE, rng)
    rows = np.arange(DAY_S + 1)
    attitudes = simulated.attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng)
    begin = time.perf_counter()
    smooth(filter_attitude(FINE, gyro, attitudes), FINE)
    return time.perf_counter() - begin


def row_of(found: Measured) -> tuple[str, ...]:
    """Row of the table for one case."""
    filtered, smoothed = (
        np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
        for errors in (found.errors, found.smoothed_errors)
    )
    steady = steady_of(found.case) if found.case.steady else None
    return (
        found.case.name,
        "-" if steady is None else f"{steady[0]:.3f} / {steady[2]:.3f}",
        f"{found.sigma[0]:.3f} / {found.sigma[2]:.3f}",
        f"{filtered[0]:.2f} / {filtered[2]:.2f}",
        f"{smoothed[0]:.2f} / {smoothed[2]:.2f}",
        f"{np.mean(found.nees) / 6.0:.3f}",
        f"{np.mean(found.nis) / 3.0:.3f}",
        f"{np.mean(found.smoothed_nees) / 6.0:.3f}",
        _inside(found, found.nees, 6),
        _inside(found, found.nis, 3),
    )


def _inside(found: Measured, values: Sequence[Array], degrees: int) -> str:
    """Text of the shares of epochs within their regions; see `INSIDE`."""
    shares = (found.share_inside(values, degrees, runs) for runs in (1, GROUP, None))
    return " / ".join(f"{share:.3f}" for share in shares)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about filtering."""
    cases = measured(quick, seed)
    text = f"""
Passes of {HOURS} h at rest (the last case: slews of 65 deg) are measured by a gyro at 1 Hz
and by a tracker, {QUICK_RUNS if quick else RUNS} times each with other noise. Angles are arcsec,
about x and about the boresight z, over the last hour and, of the filter, at the epochs of
measurements. Farrenkopf's closed form is the steady state of a filter of one axis. NEES is
e^T P^-1 e of attitude and bias, NIS the same of innovations; each is divided by its degrees of
freedom. With errors of scale and alignment the filter widens the bias at every change of the rate
anew, so its covariance is on the safe side. The last two columns are each the {INSIDE}.

{table(("", *COLUMNS), [row_of(each) for each in cases], numbers=len(COLUMNS))}
"""
    return Written(text, [bound for each in cases for bound in bounds_of(each, quick)])


SECTION = Section("Attitude over time", write, SOURCES)

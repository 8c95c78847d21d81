"""Faults that the consistency test of an attitude cannot detect.

    python -m benchmarks consistency

An attitude is `suspect` when the weighted squares of its residuals (TASTE) are
beyond the 99.9 % point of chi-square.  The test sees only what makes the stars
disagree with one another, and only as much of it as their number shows: noise
that is somewhat larger than told, and small misalignments between trackers, pass.
How often they pass is what chi-square says, central and non-central.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, ncx2

from benchmarks.bounds import Bound, at_most, every, mean_as_expected, share_as_expected
from benchmarks.record import CORE
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.attitude.solution import AttitudeSolution, solve_attitude
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec

Array = npt.NDArray[np.float64]

CASES, QUICK_CASES = 4000, 300
SIGMA_ARCSEC, RADIUS_DEG, BETWEEN_DEG = 2.1213203, 4.0, 60.0
"""Star sigma and field radius of XTE's tracker, and angle between two trackers."""
SUSPECT = 0.001
AROUND_ARCSEC = 5.0
"""Greatest increase of the median error, in arcseconds, by noise beyond a misalignment."""
FEW = 30
"""Number of good attitudes below which their errors have no bound."""
NOISES, STARS = (1.0, 1.5, 2.0, 3.0), (2, 3, 5, 10)
MISALIGNED_ARCSEC, STARS_EACH = (0.0, 10.0, 30.0, 60.0, 300.0), (1, 2, 5)


@dataclass(frozen=True)
class Row:
    """Kind of batch: numbers of solved and of good ones, expected share, and errors."""

    label: tuple[str, str, str]
    solved: int
    good: int
    expected: float
    squares: list[float]
    """Values of e^T P^-1 e of the good attitudes."""
    error_arcsec: float
    """Median error angle of the good attitudes, about all axes."""
    noise: float
    off_arcsec: float

    @property
    def name(self) -> str:
        """Name of the row in one line."""
        return ", ".join(self.label)

    @property
    def error_sigma(self) -> float:
        """Root mean square error over its sigma; 1 if the covariance is right."""
        return math.sqrt(float(np.mean(self.squares)) / 3.0)

    @property
    def passing(self) -> Bound:
        """Bound of the number of good attitudes by chi-square."""
        return share_as_expected(f"{self.name}: good", self.good, self.solved, self.expected)

    @property
    def error(self) -> Bound:
        """Bound of the error: enlarged as the noise, or limited by the misalignment."""
        if self.off_arcsec > 0.0:
            label = f"{self.name}: median error"
            return at_most(label, self.error_arcsec, self.off_arcsec + AROUND_ARCSEC, "arcsec")
        label = f"{self.name}: mean of e^T P^-1 e over the squared noise"
        scaled = [square / self.noise**2 for square in self.squares]
        return mean_as_expected(label, scaled, 3.0, 6.0)


def noisy(noise: float, stars: int, count: int, rng: np.random.Generator) -> Row:
    """Row of one tracker whose stars have more noise than their sigmas."""
    freedom = 2 * stars - 3
    expected = float(chi2.cdf(chi2.isf(SUSPECT, freedom) / noise**2, freedom))
    label = ("one tracker", f"{stars} stars", f"noise {noise:g} times as told")
    found = [_solved(rng, (stars,), noise, 0.0) for _ in range(count)]
    return _row(label, found, [expected] * count, noise, 0.0)


def misaligned(off_arcsec: float, stars: int, count: int, rng: np.random.Generator) -> Row:
    """Row of two trackers with as many stars each, the second rotated about a random axis."""
    freedom = 4 * stars - 3
    point = float(chi2.isf(SUSPECT, freedom))
    found, expected = [], []
    for _ in range(count):
        state = rng.bit_generator.state
        found.append(_solved(rng, (stars, stars), 1.0, off_arcsec))
        after = rng.bit_generator.state
        # The same stars and turn without noise: their TASTE is the non-centrality.
        rng.bit_generator.state = state
        exact, _ = _solved(rng, (stars, stars), 0.0, off_arcsec)
        rng.bit_generator.state = after
        extra = exact.taste if exact is not None else math.nan
        expected.append(float(ncx2.cdf(point, freedom, extra)) if extra > 1e-9 else 1.0 - SUSPECT)
    each = f"{stars} star{'s' if stars > 1 else ''} each"
    return _row(
        ("two trackers", each, f'second off by {off_arcsec:g}"'), found, expected, 1.0, off_arcsec
    )


def _solved(
    rng: np.random.Generator, stars: tuple[int, ...], noise: float, off_arcsec: float
) -> tuple[AttitudeSolution | None, Array]:
    """Attitude of random stars, and its error; the true attitude is the identity."""
    parts, seen = [], []
    for place, number in enumerate(stars):
        tilt = math.radians(BETWEEN_DEG * place)
        boresight = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
        radius = math.radians(RADIUS_DEG) * np.sqrt(rng.uniform(size=(number, 1)))
        aside = rng.normal(size=(number, 3))
        aside = _unit(aside - (aside @ boresight)[:, None] * boresight)
        exact = np.cos(radius) * boresight + np.sin(radius) * aside
        turn = _unit(rng.normal(size=3)) * off_arcsec / ARCSEC_PER_RADIAN if place else np.zeros(3)
        scatter = noise * SIGMA_ARCSEC / ARCSEC_PER_RADIAN * rng.normal(size=exact.shape)
        parts.append(exact)
        seen.append(_unit(exact + np.cross(turn, exact) + scatter))
    tracker_of = np.repeat(np.arange(len(stars)), stars)
    sigma = np.full(sum(stars), SIGMA_ARCSEC / ARCSEC_PER_RADIAN)
    names = tuple(f"TRACKER_{k + 1}" for k in range(len(stars)))
    found = solve_attitude(np.vstack(seen), np.vstack(parts), sigma, tracker_of, names)
    if not isinstance(found, AttitudeSolution):
        return None, np.full(3, np.nan)
    return found, attitude_error_arcsec(found.matrix, np.eye(3))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _row(
    label: tuple[str, str, str],
    found: list[tuple[AttitudeSolution | None, Array]],
    expected: list[float],
    noise: float,
    off_arcsec: float,
) -> Row:
    # Two stars almost in one place give no attitude; nothing is to be tested then.
    solved = [(s, e, p) for (s, e), p in zip(found, expected, strict=True) if s is not None]
    good = [(s, e) for s, e, _ in solved if not s.suspect]
    squares = [float(e @ np.linalg.solve(s.covariance_arcsec2, e)) for s, e in good]
    return Row(
        label,
        len(solved),
        len(good),
        float(np.mean([p for _, _, p in solved])),
        squares,
        float(np.median([np.linalg.norm(e) for _, e in good])) if good else math.nan,
        noise,
        off_arcsec,
    )


def measured(quick: bool, seed: int) -> list[Row]:
    """Rows of all kinds."""
    count, rng = QUICK_CASES if quick else CASES, np.random.default_rng(seed)
    rows = [noisy(noise, stars, count, rng) for noise in NOISES for stars in STARS]
    return rows + [
        misaligned(off, stars, count, rng) for off in MISALIGNED_ARCSEC for stars in STARS_EACH
    ]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the share of good attitudes of each kind against the expected one."""
    rows = measured(quick, seed)
    figures = {
        row.name: f"good {row.good / row.solved:.1%}, expected {row.expected:.1%}" for row in rows
    }
    return Report("consistency", figures, bounds_of(rows))


def bounds_of(rows: list[Row]) -> list[Bound]:
    """Bounds of all rows; errors only in rows with enough good attitudes."""
    return [
        *every("rows with as many good as chi-square foresees", [row.passing for row in rows]),
        *every(
            "rows with errors as the noise or the misalignment makes them",
            [row.error for row in rows if row.good >= FEW],
        ),
    ]


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about consistency."""
    rows = measured(quick, seed)
    text = f"""
The status `suspect` is a test of whether the stars agree with one another: TASTE beyond the 99.9 %
point of chi-square. It is no proof that an attitude is right. By its nature it lets pass noise that
is larger than the sigma that is told, where there are few stars to show it; a misalignment of
10 to 30 arcsec between trackers that see a star or two each; and any misalignment whatever of a
tracker that is the only one. Every row has {QUICK_CASES if quick else CASES:,} random fields of
{RADIUS_DEG:g} deg radius with rightly named stars of {SIGMA_ARCSEC:.2f} arcsec per axis; two
trackers are {BETWEEN_DEG:g} deg apart, and the second one is turned about any axis. A cell holds
the percentage whose status is `good`, in brackets what chi-square foresees (central for noise,
non-central for a misalignment); then of the good ones the error over the sigma that the covariance
states (1 where that is true), and the median error about all axes in arcsec.

{_table(rows, "one tracker")}

{_table(rows, "two trackers")}
"""
    return Written(text, bounds_of(rows))


def _table(rows: list[Row], trackers: str) -> str:
    """Table with a row for each fault, and a column for each number of stars."""
    cells: dict[str, list[str]] = {}
    shown = [row for row in rows if row.label[0] == trackers]
    for row in shown:
        errors = f"; {row.error_sigma:.2f}; {row.error_arcsec:.1f}" if row.good else ""
        good = f"{100.0 * row.good / row.solved:.1f} ({100.0 * row.expected:.1f})"
        cells.setdefault(row.label[2], []).append(f"{good}{errors}")
    stars = tuple(dict.fromkeys(row.label[1] for row in shown))
    lines = [(wrong, *of_stars) for wrong, of_stars in cells.items()]
    return table((trackers, *stars), lines, numbers=len(stars))


SECTION = Section("What the consistency test lets pass", write, CORE)

"""Test of claimed probabilities: of stars claimed at p a share p must be right.

python -m benchmarks calibration           every condition by itself
python -m benchmarks calibration --quick   small samples
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, pictures_of, table
from benchmarks.validation.verified_views import Condition, interval, judged_views
from service.vectors import Vector
from studies.documents import Folder

VIEWS, QUICK_VIEWS = 10_000, 120
EDGES = (0.0, 0.5, 0.9, 0.99, 0.999, 1.0)
NAMED, NAMED_WRONG = 0.999, 0.001
OFF = 0.03
"""Greatest deficit of the right share against the claimed one, in bins from .9 to .999."""
FEW = 20
"""Number of claims below which a bin has no bound."""

TIMES_THE_VIEWS = {"two of five spurious": 2}
"""Factors on the number of views for conditions in which fewer stars can be named."""

CONDITIONS = {
    "nominal errors": Condition(("cap", "band")),
    "serious errors": Condition(("cap", "band"), errors="serious"),
    "two of five spurious": Condition(("cap", "band"), spurious=2),
    "empty sky": Condition(("cap_desert", "band_desert")),
    "dense sky": Condition(("cap_forest", "band_forest")),
    "a fifth of the catalog missing": Condition(("cap", "band"), missing=0.2),
    "magnitudes off by 0.5": Condition(("cap", "band"), offset_mag=0.5),
    "doubles not merged": Condition(("cap", "band"), merged=False),
    "3 to 12 stars": Condition(("cap", "band"), stars=3, most_stars=12),
}


@dataclass(frozen=True)
class Bin:
    """Claims between two probabilities: mean claimed probability, and number of right claims."""

    least: float
    most: float
    claimed: float
    claims: int
    right: int

    @property
    def share(self) -> float:
        """Share of right claims."""
        return self.right / self.claims if self.claims else float("nan")

    @property
    def shown(self) -> str:
        """Text of the number of claims and the share of right ones."""
        return f"{self.claims:,}: {self.share:.2%}" if self.claims else "-"


@dataclass(frozen=True)
class Reliability:
    """Bins of one condition, and their bounds."""

    condition: str
    bins: tuple[Bin, ...]

    @property
    def named(self) -> Bin:
        """Bin of the claims at which a star is named."""
        return self.bins[-1]

    @property
    def wrong_at_most(self) -> float:
        """Upper end of the 95 % interval of the share of wrong stars among named ones."""
        return interval(self.named.claims - self.named.right, self.named.claims)[1]

    def bounds(self, quick: bool) -> list[Bound]:
        """Bounds of the condition; a small sample has none on the share of wrong names."""
        wrong = self.named.claims - self.named.right
        bounds = [
            at_most(f"{self.condition}: named wrongly", wrong, 0)
            if quick and wrong == 0
            else at_most(
                f"{self.condition}: named wrongly, upper end, %",
                100.0 * self.wrong_at_most,
                100.0 * NAMED_WRONG,
            )
        ]
        for each in self.bins[2:-1]:
            if each.claims >= FEW:
                # Within OFF of what was claimed, or no further than chance explains.
                low = interval(round(each.claimed * each.claims), each.claims)[0]
                label = f"{self.condition}, {each.least:g} to {each.most:g}: share right"
                bounds.append(at_least(label, each.share, min(each.claimed - OFF, low)))
        return bounds


def claims(condition: Condition, views: int, seed: int) -> tuple[Vector, Vector]:
    """Probability of the likeliest name of every star, and whether it is right."""
    claimed, right = [], []
    for judged in judged_views(condition, views, seed):
        star, probability = judged.first()
        some = star >= 0
        claimed.append(probability[some])
        right.append((star == judged.truth)[some])
    return np.concatenate(claimed), np.concatenate(right)


def binned(name: str, claimed: Vector, right: Vector) -> Reliability:
    """Claims of a condition, binned by probability."""
    bins = []
    for k, (least, most) in enumerate(pairwise(EDGES)):
        last = k == len(EDGES) - 2
        inside = (claimed >= least) & ((claimed < most) | last)
        number = int(inside.sum())
        mean = float(claimed[inside].mean()) if number else (least + most) / 2.0
        bins.append(Bin(least, most, mean, number, int(right[inside].sum())))
    return Reliability(name, tuple(bins))


def measured(quick: bool, seed: int) -> list[Reliability]:
    """Bins of all conditions."""
    views = QUICK_VIEWS if quick else VIEWS
    return [
        binned(name, *claims(condition, views * TIMES_THE_VIEWS.get(name, 1), seed))
        for name, condition in tqdm(CONDITIONS.items(), desc="calibration", unit="condition")
    ]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the claims and right shares of each condition, by bin."""
    found = measured(quick, seed)
    figures = {
        f"{each.condition}, {part.least:g} to {part.most:g}": part.shown
        for each in found
        for part in each.bins
    }
    figures |= {
        f"{each.condition}, named: wrong at most (95 %)": f"{each.wrong_at_most:.3%}"
        for each in found
    }
    return Report("calibration", figures, bounds_of(found, quick))


def bounds_of(found: list[Reliability], quick: bool) -> list[Bound]:
    """Bounds of all conditions."""
    return [bound for each in found for bound in each.bounds(quick)]


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about probabilities, with its picture."""
    found = measured(quick, seed)
    rows = [
        (
            each.condition,
            CONDITIONS[each.condition].prior_error,
            *(part.shown for part in each.bins[:-1]),
            f"{each.named.claims:,}",
            each.named.claims - each.named.right,
            f"{each.wrong_at_most:.3%}",
        )
        for each in found
    ]
    head = (
        "condition",
        "a priori off by",
        *(f"{a:g} to {b:g}" for a, b in pairwise(EDGES[:-1])),
        "named",
        "wrong",
        "at most",
    )
    text = f"""
A star is `unique` from a probability of 0.999. Does that mean what it says? Of every star the
likeliest name is taken, whether it was given as the answer or as the first of its rivals, and
counted by the probability claimed for it: how many claims, and the share of them that is right.
*Named* are the claims of 0.999 and more, with the number that is wrong and the upper end of the
95 % interval of its share, which must not exceed 0.1 %. In the bins from 0.9 to 0.999 the share
right may not be more than 3 points below what was claimed, beyond what chance explains; bins of
fewer than {FEW} claims and those below 0.9 are shown only: no star is named there. Each condition
is {QUICK_VIEWS if quick else VIEWS:,} views, twice that where two of five stars are spurious, half
of them caps and half bands. The rotation that the a priori attitude is off by is given about body
Z, Y and X, first that of the caps; serious errors have 12 arcsec and 0.3 mag beside it.

{table(head, rows, numbers=3)}

![Wrong as often as claimed](plots/calibration.svg)

Below the line the probabilities are too modest, above it they claim too much. An arrow is the upper
end of the interval where no claim was wrong.
"""
    return Written(
        text,
        bounds_of(found, quick),
        pictures_of("calibration", lambda folder: _draw(found, folder)),
    )


def _draw(found: list[Reliability], pictures: Folder) -> None:
    """Draw the share of wrong claims over the claimed probability of error."""
    figure = pictures.figure(7.5, 5.0)
    axes = figure.subplots()
    axes.plot([1e-7, 1.0], [1e-7, 1.0], color="#888888", linewidth=0.8)
    for place, each in enumerate(found):
        color = f"C{place}"
        for part in (part for part in each.bins if part.claims >= FEW):
            wrong = part.claims - part.right
            low, high = interval(wrong, part.claims)
            claimed = max(1.0 - part.claimed, 1e-7)
            if wrong:
                axes.plot([claimed, claimed], [max(low, 1e-5), high], color=color, linewidth=1)
                axes.plot(claimed, wrong / part.claims, "o", color=color, markersize=4)
            else:
                axes.plot(claimed, high, "v", color=color, markersize=5, fillstyle="none")
        axes.plot([], [], "o", color=color, markersize=4, label=each.condition)
    axes.set(xscale="log", yscale="log", xlim=(5e-8, 1.0), ylim=(1e-5, 1.0))
    axes.set_xlabel("claimed to be wrong, on average of a bin")
    axes.set_ylabel("wrong")
    axes.legend(fontsize=7, loc="lower right")
    pictures.save(figure, "calibration")


SECTION = Section(
    "What a probability is worth",
    write,
    (*CORE, *SIMULATOR, "benchmarks/validation/verified_views.py"),
)

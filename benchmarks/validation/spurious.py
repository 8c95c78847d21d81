"""Spurious stars (planets, debris, hot pixels), with votes and verified identification.

python -m benchmarks spurious
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, every
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, pictures_of, table
from benchmarks.validation.verified_views import Condition, judged_views
from service.missions.mission import Identifier
from studies.documents import Folder

SPURIOUS, QUICK_SPURIOUS = 20_000, 300
VOTES_SHARE = 0.1
"""Share of the views for votes, which need no more."""


@dataclass(frozen=True)
class Case:
    """Case: world, numbers of stars and spurious stars, and limits in percent.

    `prior_off_deg` is that of a `Condition`.
    """

    world: str
    spurious: int
    stars: int
    least_right: float | None
    most_right: float = 100.0
    most_wrong: float = 0.2
    most_named: float = 0.4
    least_first: float = 99.0
    prior_off_deg: float | None = None

    @property
    def condition(self) -> Condition:
        """Condition for drawing the views."""
        return Condition(
            (self.world,),
            stars=self.stars,
            spurious=self.spurious,
            prior_off_deg=self.prior_off_deg,
        )

    @property
    def label(self) -> str:
        """Label of the row in a few words."""
        wide = "" if self.prior_off_deg is None else f", prior 0 to {self.prior_off_deg:g}°"
        return f"{PLACES[self.world]}, {self.spurious} of {self.stars}{wide}"


FEW_RIGHT = 5.0
"""Greatest percentage that can be named with two real stars left among thousands."""
WIDE_DEG = 2.0
"""Greatest a priori error in degrees of rows without the paper's errors: that of a slew."""
CASES = (
    *(Case(world, 1, 5, 99.5) for world in ("cap", "cap_forest", "band", "band_forest")),
    *(Case(world, 2, 5, 99.0) for world in ("cap", "cap_forest", "band", "band_forest")),
    *(Case(world, 3, 5, 99.5) for world in ("cap", "cap_forest")),
    Case("band", 3, 5, None, FEW_RIGHT, least_first=90.0),
    Case("band_forest", 3, 5, None, FEW_RIGHT, least_first=80.0),
    *(Case(world, 5, 10, 99.5) for world in ("cap", "band", "band_forest")),
    Case("cap", 1, 5, 99.5, prior_off_deg=WIDE_DEG),
    Case("cap", 2, 5, 99.0, prior_off_deg=WIDE_DEG),
    Case("cap", 3, 5, 40.0, 80.0, least_first=85.0, prior_off_deg=WIDE_DEG),
)
PLACES = {"cap": "cap", "cap_forest": "cap forest", "band": "band", "band_forest": "band forest"}


@dataclass(frozen=True)
class Shares:
    """Counts of real stars right, wrong, and right in the likeliest name; spurious stars named."""

    real: int
    spurious: int
    right: int
    wrong: int
    first: int
    named: int

    @property
    def right_pct(self) -> float:
        """Percentage of real stars named rightly."""
        return 100.0 * self.right / self.real

    @property
    def wrong_pct(self) -> float:
        """Percentage of real stars named wrongly."""
        return 100.0 * self.wrong / self.real

    @property
    def first_pct(self) -> float:
        """Percentage of real stars whose likeliest name is right."""
        return 100.0 * self.first / self.real

    @property
    def named_pct(self) -> float:
        """Percentage of spurious stars with a name."""
        return 100.0 * self.named / self.spurious


def shares(
    case: Case,
    spurious: int,
    seed: int,
    identifier: Identifier = "verified",
    step: Callable[[int], object] = int,
) -> Shares:
    """Counts of a case with at least a number of spurious stars."""
    total = np.zeros(6, np.int64)
    views = -(-spurious // case.spurious)
    for judged in judged_views(case.condition, views, seed, identifier):
        real, unique = judged.truth >= 0, judged.found.unique
        same = judged.found.star == judged.truth
        first = judged.first()[0] if identifier == "verified" else judged.found.star
        total += [
            real.sum(),
            (~real).sum(),
            (real & unique & same).sum(),
            (real & unique & ~same).sum(),
            (real & (first == judged.truth)).sum(),
            (~real & unique).sum(),
        ]
        step(case.spurious)
    return Shares(*total.tolist())


def bounds_of(measured_cases: Sequence[tuple[Case, Shares, Shares]]) -> list[Bound]:
    """Bounds of every case; the votes must name at least as many spurious stars in each."""
    votes = [
        at_least(f"{case.label}: spurious named by votes", by_votes.named_pct, found.named_pct, "%")
        for case, found, by_votes in measured_cases
    ]
    return [
        *(bound for case, found, _ in measured_cases for bound in _case_bounds(case, found)),
        *every("spurious named by votes, no fewer than verified", votes),
    ]


def _case_bounds(case: Case, found: Shares) -> list[Bound]:
    name = case.label
    bounds = [
        at_least(f"{name}: right", found.right_pct, case.least_right, "%")
        if case.least_right is not None
        else at_most(f"{name}: right", found.right_pct, case.most_right, "%"),
        at_least(f"{name}: first right", found.first_pct, case.least_first, "%"),
        at_most(f"{name}: wrong", found.wrong_pct, case.most_wrong, "%"),
        at_most(f"{name}: spurious named", found.named_pct, case.most_named, "%"),
    ]
    if case.least_right is not None and case.most_right < 100.0:
        bounds.append(at_most(f"{name}: right", found.right_pct, case.most_right, "%"))
    return bounds


def measured(quick: bool, seed: int) -> list[tuple[Case, Shares, Shares]]:
    """Counts of every case, verified and by votes."""
    spurious = QUICK_SPURIOUS if quick else SPURIOUS
    found = []
    with tqdm(total=len(CASES) * spurious, desc="spurious", unit="star", unit_scale=True) as bar:
        for case in CASES:
            verified = shares(case, spurious, seed, step=bar.update)
            votes = shares(case, max(1, int(spurious * VOTES_SHARE)), seed, "starid")
            found.append((case, verified, votes))
    return found


def run(quick: bool, seed: int) -> Report:
    """Benchmark of every case."""
    figures: dict[str, str] = {}
    cases = measured(quick, seed)
    for case, found, _ in cases:
        figures[case.label] = (
            f"right {found.right_pct:.2f} %, wrong {found.wrong_pct:.3f} %, first right "
            f"{found.first_pct:.2f} %, spurious named {found.named_pct:.3f} % of {found.spurious:,}"
        )
    return Report("spurious", figures, bounds_of(cases))


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about spurious stars."""
    found = measured(quick, seed)
    rows = [
        (
            PLACES[case.world],
            case.condition.prior_error,
            f"{case.spurious} of {case.stars}",
            f"{ours.right_pct:.2f}",
            f"{ours.wrong_pct:.3f}",
            f"{ours.first_pct:.2f}",
            f"{ours.named_pct:.3f}",
            f"{votes.right_pct:.1f}",
            f"{votes.wrong_pct:.1f}",
            f"{votes.named_pct:.1f}",
        )
        for case, ours, votes in found
    ]
    head = (
        "place", "a priori off by", "spurious", "right", "wrong", "first right", "named",
        "votes: right", "wrong", "named",
    )  # fmt: skip
    text = f"""
Some of a view's stars are put anywhere in its field: a planet, debris, a hot pixel. They keep their
magnitudes, so that nothing but their place speaks against them. In percent: of the real stars those
right, wrong, and those whose likeliest name is right, given as the answer or first of the ranked
list; of the spurious stars those that were named. At least {found[0][1].spurious:,} spurious stars
a row, a tenth of that for the votes. The a priori error is that of the paper's nominal runs, about
body Z, Y and X, except in the last rows, where it is drawn evenly up to {WIDE_DEG:g} degrees.

{table(head, rows, numbers=7)}

![Real stars right, and spurious stars named](plots/spurious.svg)

With three of five spurious in a band two real stars are left among thousands. Two stars fit by
chance, so that hardly any is named; the ranked list mostly has the right one first. In a cap two
real stars suffice where the a priori attitude is known to an arcminute. Where it may be degrees
off, they do not: only the share of the row with 3 of 5 and 0 to {WIDE_DEG:g}° is named.
"""
    return Written(
        text, bounds_of(found), pictures_of("spurious", lambda folder: _draw(found, folder))
    )


def _draw(found: list[tuple[Case, Shares, Shares]], pictures: Folder) -> None:
    """Draw bars of every case: the real stars right, and the spurious ones named."""
    figure = pictures.figure(9.0, 4.2)
    axes = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(found))[::-1]
    names = [case.label for case, _, _ in found]
    for up, color, label, which in ((0.2, "#0b5394", "verified", 0), (-0.2, "#b45309", "votes", 1)):
        mine: list[Shares] = [(each[1], each[2])[which] for each in found]
        style = {"height": 0.38, "color": color, "label": label}
        axes[0].barh(places + up, [shares.right_pct for shares in mine], **style)
        axes[1].barh(places + up, [shares.named_pct for shares in mine], **style)
    axes[0].set_title("real stars named rightly (%)")
    axes[1].set_title("spurious stars given a name (%)")
    axes[0].set_yticks(places, names)
    axes[1].legend(fontsize=7)
    pictures.save(figure, "spurious")


SECTION = Section(
    "Spurious stars", write, (*CORE, *SIMULATOR, "benchmarks/validation/verified_views.py")
)

"""Spurious stars: planets, debris, hot pixels among the stars, by votes and verified.

python -m benchmarks spurious
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from benchmarks.report import Report
from benchmarks.sections import Section, Written, pictures_of, table
from benchmarks.verified_views import Condition, judged_views
from service.missions.mission import Identifier
from service.simulate.drawing import Folder

SPURIOUS, QUICK_SPURIOUS = 20_000, 300
VOTES_SHARE = 0.1
"""The votes need no more than a tenth of the views to show what they are worth."""


@dataclass(frozen=True)
class Case:
    """A row: where, how many of how many stars are spurious; what is asked of it, in percent."""

    world: str
    spurious: int
    stars: int
    least_right: float | None
    most_wrong: float | None = None
    most_named: float | None = None
    least_first: float | None = None


CASES = (
    *(Case(world, 1, 5, 99.5, most_named=0.4) for world in ("cap", "cap_forest", "band")),
    Case("band_forest", 1, 5, 99.5, most_named=0.4),
    *(Case(world, 2, 5, 99.0, most_named=0.4) for world in ("cap", "cap_forest", "band")),
    Case("band_forest", 2, 5, 99.0, most_named=0.4),
    *(Case(world, 3, 5, 99.5) for world in ("cap", "cap_forest")),
    *(Case(w, 3, 5, None, most_wrong=0.2, least_first=90.0) for w in ("band", "band_forest")),
    *(Case(world, 5, 10, 99.5) for world in ("cap", "band", "band_forest")),
)
PLACES = {"cap": "cap", "cap_forest": "cap forest", "band": "band", "band_forest": "band forest"}


@dataclass(frozen=True)
class Shares:
    """Of the real stars right, wrong, and the likeliest name right; of the spurious those named."""

    real: int
    spurious: int
    right: int
    wrong: int
    first: int
    named: int

    @property
    def right_pct(self) -> float:
        """Real stars named rightly."""
        return 100.0 * self.right / self.real

    @property
    def wrong_pct(self) -> float:
        """Real stars named wrongly."""
        return 100.0 * self.wrong / self.real

    @property
    def first_pct(self) -> float:
        """Real stars whose likeliest name is right."""
        return 100.0 * self.first / self.real

    @property
    def named_pct(self) -> float:
        """Spurious stars that are given a name."""
        return 100.0 * self.named / self.spurious


def shares(
    case: Case,
    spurious: int,
    seed: int,
    identifier: Identifier = "verified",
    step: Callable[[int], object] = int,
) -> Shares:
    """A case with at least so many spurious stars."""
    condition = Condition((case.world,), stars=case.stars, spurious=case.spurious)
    total = np.zeros(6, np.int64)
    views = -(-spurious // case.spurious)
    for judged in judged_views(condition, views, seed, identifier):
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


def faults_of(case: Case, found: Shares) -> list[str]:
    """What a case asks and has not got."""
    name = f"{PLACES[case.world]}, {case.spurious} of {case.stars}"
    asked = (
        ("right", found.right_pct, case.least_right, 1),
        ("first right", found.first_pct, case.least_first, 1),
        ("wrong", found.wrong_pct, case.most_wrong, -1),
        ("spurious named", found.named_pct, case.most_named, -1),
    )
    return [
        f"{name}: {got:.2f} % {what}"
        for what, got, bound, sign in asked
        if bound is not None and sign * (got - bound) < 0
    ]


def measured(quick: bool, seed: int) -> list[tuple[Case, Shares, Shares]]:
    """Every case, verified and by votes."""
    spurious = QUICK_SPURIOUS if quick else SPURIOUS
    found = []
    with tqdm(total=len(CASES) * spurious, desc="spurious", unit="star", unit_scale=True) as bar:
        for case in CASES:
            verified = shares(case, spurious, seed, step=bar.update)
            votes = shares(case, max(1, int(spurious * VOTES_SHARE)), seed, "starid")
            found.append((case, verified, votes))
    return found


def run(quick: bool, seed: int) -> Report:
    """The benchmark: every case."""
    figures, faults = {}, []
    for case, found, _ in measured(quick, seed):
        figures[f"{PLACES[case.world]}, {case.spurious} of {case.stars}"] = (
            f"right {found.right_pct:.2f} %, wrong {found.wrong_pct:.3f} %, first right "
            f"{found.first_pct:.2f} %, spurious named {found.named_pct:.3f} % of {found.spurious:,}"
        )
        faults += faults_of(case, found)
    return Report("spurious", figures, not faults, faults)


def write(quick: bool, seed: int) -> Written:
    """The section of the verification."""
    found = measured(quick, seed)
    rows = [
        (
            PLACES[case.world],
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
        "place", "spurious", "right", "wrong", "first right", "named",
        "votes: right", "wrong", "named",
    )  # fmt: skip
    faults = [fault for case, ours, _ in found for fault in faults_of(case, ours)]
    text = f"""
Some of a view's stars are put anywhere in its field: a planet, debris, a hot pixel. They keep their
magnitudes, so that nothing but their place speaks against them. In percent: of the real stars those
right, wrong, and those whose likeliest name is right, given as the answer or first of the ranked
list; of the spurious stars those that were named. At least {found[0][1].spurious:,} spurious stars
a row, a tenth of that for the votes.

{table(head, rows, numbers=7)}

![Real stars right, and spurious stars named](plots/spurious.svg)

With three of five spurious in a band two real stars are left among thousands. Two stars fit by
chance, so that hardly any is named; the ranked list still has the right one first.
"""
    return Written(text, not faults, pictures_of("spurious", lambda folder: _draw(found, folder)))


def _draw(found: list[tuple[Case, Shares, Shares]], pictures: Folder) -> None:
    """Bars of every case: the real stars right, and the spurious ones named."""
    figure = pictures.figure(9.0, 4.2)
    axes = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(found))[::-1]
    names = [f"{PLACES[case.world]}, {case.spurious} of {case.stars}" for case, _, _ in found]
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


SECTION = Section("Spurious stars", write)

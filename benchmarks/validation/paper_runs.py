"""All 94 runs of Fink & Shoup's Tables 2 to 10: votes against 1994, verified against votes.

    python -m benchmarks paper_runs

A quarter of an hour of one core; it takes the cores that there are.  As a
section of the verification it makes the page of the tables beside it.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, pictures_of, table
from studies.documents import Folder
from studies.paper_1994.command import PAPER_IDENTIFIER, document
from studies.paper_1994.command import measured as measured_times
from studies.paper_1994.experiments import run_experiments
from studies.paper_1994.plots import draw
from studies.paper_1994.printed import Run, the_paper
from studies.paper_1994.tables import TITLES
from studies.paper_1994.tally import (
    AMBIGUOUS,
    MISIDENTIFIED,
    UNMATCHED,
    Tally,
    differences,
    is_inside,
)

STARS, QUICK_STARS = 20_000, 400
SEEDS = 3
"""Number of seeds pooled for votes; verified identification shows the first seed only."""
LEAST_INSIDE, LEAST_AGREE = 85, 0.98
MOST_WRONG, MOST_WRONG_OF_RUN_PCT = 1e-5, 0.05
MOST_OPEN_PCT, NOISY_PCT, DESERT_PCT = 0.5, 1.0, 1.5
NOISY_ARCSEC, NOISY_MAG = 9.0, 0.3
"""Noise of a noisy run: three times the nominal noise."""
BAD_ARCSEC = 85.0 * 3600.0
FOOT_PCT = 2e-3
"""Least percentage that is drawn."""


def most_open_pct(run: Run) -> float:
    """Greatest percentage of stars that verified identification may leave open in a run."""
    if run.table == "9D" and max(run.rotation_arcsec) > BAD_ARCSEC:
        return DESERT_PCT
    noisy = run.sigma_arcsec >= NOISY_ARCSEC or run.sigma_mag >= NOISY_MAG
    return NOISY_PCT if noisy else MOST_OPEN_PCT


def open_pct(tally: Tally) -> float:
    """Percentage of ambiguous and unmatched stars."""
    return 100.0 * (tally.total(AMBIGUOUS) + tally.total(UNMATCHED)) / tally.stars


def wrong_pct(tally: Tally) -> float:
    """Percentage of misidentified stars."""
    return 100.0 * tally.total(MISIDENTIFIED) / tally.stars


def bounds_of(votes: Sequence[Tally], verified: Sequence[Tally], quick: bool) -> list[Bound]:
    """Bounds of all runs; fewer for a small sample."""
    stars = sum(tally.stars for tally in verified)
    wrong = sum(tally.total(MISIDENTIFIED) for tally in verified)
    allowed = max(int(MOST_WRONG * stars), 1 if quick else 0)
    bounds = [at_most(f"verified: misidentified of {stars:,} stars", wrong, allowed)]
    if quick:
        return bounds
    agree = np.mean([rate.agrees for tally in votes for rate in differences(tally)])
    bounds += [
        at_least("votes: printed runs inside", sum(map(is_inside, votes)), LEAST_INSIDE),
        at_least("votes: share of the rates as the reference's", float(agree), LEAST_AGREE),
    ]
    for most in sorted({most_open_pct(tally.run) for tally in verified}):
        alike = [tally for tally in verified if most_open_pct(tally.run) == most]
        worst = max(alike, key=open_pct)
        about = f"verified: not identified, worst of {len(alike)} runs alike ({_name(worst)})"
        bounds.append(at_most(about, open_pct(worst), most, "%"))
    for table_ in dict.fromkeys(tally.run.number for tally in verified):
        of_table = [tally for tally in verified if tally.run.number == table_]
        misnamed = max(map(wrong_pct, of_table))
        bounds.append(
            at_most(
                f"Table {table_}: verified, misidentified in the worst run",
                misnamed,
                MOST_WRONG_OF_RUN_PCT,
                "%",
            )
        )
    return bounds


def measured(quick: bool, seed: int) -> tuple[list[Tally], list[Tally], list[int]]:
    """Tallies by votes, verified tallies, and the seeds."""
    stars = QUICK_STARS if quick else STARS
    seeds = [seed + k for k in range(1 if quick else SEEDS)]
    runs = the_paper().runs_of(list(TITLES))
    votes = run_experiments(runs, stars, seeds, ("starid",))
    return votes, run_experiments(runs, stars, seeds[:1], ("verified",)), seeds


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the rates that all runs have in common."""
    votes, verified, _ = measured(quick, seed)
    agree = [rate.agrees for tally in votes for rate in differences(tally)]
    figures = {
        "printed runs inside": f"{sum(map(is_inside, votes))} of {len(votes)}",
        "rates as the reference's": f"{sum(agree)} of {len(agree)}",
        "verified: stars": sum(tally.stars for tally in verified),
        "verified: misidentified": sum(tally.total(MISIDENTIFIED) for tally in verified),
        "verified: worst run not identified, %": max(map(open_pct, verified)),
    }
    return Report("paper_runs", figures, bounds_of(votes, verified, quick))


def write(quick: bool, seed: int) -> Written:
    """Section of the verification, and the page with every run by votes."""
    votes, verified, seeds = measured(quick, seed)
    with tempfile.TemporaryDirectory() as folder:
        plots = Path(folder) / "plots"
        draw(votes, plots)
        times = measured_times(list(TITLES), seeds[0], PAPER_IDENTIFIER)
        pages = {"paper.md": document(votes, seeds, times, plots, Path(folder) / "paper.md")}
        pictures = {path.name: path.read_text("utf-8") for path in sorted(plots.glob("*.svg"))}
    pictures |= pictures_of("paper", lambda folder: _draw(votes, verified, folder))
    return Written(
        _text(votes, verified, seeds), bounds_of(votes, verified, quick), pictures, pages
    )


def _text(votes: Sequence[Tally], verified: Sequence[Tally], seeds: Sequence[int]) -> str:
    rows = []
    for number in dict.fromkeys(tally.run.number for tally in votes):
        old = [tally for tally in votes if tally.run.number == number]
        new = [tally for tally in verified if tally.run.number == number]
        rows.append(
            (
                f"{number}. {TITLES[number]}",
                f"{sum(map(is_inside, old))} of {len(old)}",
                f"{max(map(open_pct, old)):.2f}",
                f"{max(map(wrong_pct, old)):.2f}",
                f"{max(map(open_pct, new)):.2f}",
                sum(tally.total(MISIDENTIFIED) for tally in new),
                sum(tally.stars for tally in new),
            )
        )
    head = (
        "table", "inside", "votes: worst not identified %", "wrong %",
        "verified: worst not identified %", "stars wrong", "of",
    )  # fmt: skip
    inside = sum(map(is_inside, votes))
    pairs = [(tally, rate) for tally in votes for rate in differences(tally)]
    agree = sum(rate.agrees for _, rate in pairs)
    stars = sum(tally.stars for tally in verified)
    wrong = sum(tally.total(MISIDENTIFIED) for tally in verified)
    left = sum(tally.total(AMBIGUOUS) + tally.total(UNMATCHED) for tally in verified)
    missed = sum(tally.total(MISIDENTIFIED) for tally in votes) / sum(t.stars for t in votes)
    return f"""
The simulator of Fink & Shoup's paper, made anew, sends its views through the same code as any
batch, with the votes as the identifier and with `verified`, the service's default. Every run of
Tables 2 to 10 has at least {min(t.stars for t in votes):,} stars by votes, seeds
{", ".join(map(str, seeds))} pooled, and {min(t.stars for t in verified):,} verified, seed
{seeds[0]}. [paper.md](paper.md) says how the paper was read; `acquire simulate paper` prints every
run, by votes and verified.

{table(head, rows, numbers=6)}

**Votes beside 1994.** A printed run is *inside* where its counts lie in the 95 % region of
experiments of the paper's size: {inside} of {len(votes)} are, and at least {LEAST_INSIDE} are asked
for. Against an independent implementation of the same reading, {agree} of {len(pairs)} rates
({agree / len(pairs):.1%}) lie within three combined standard errors or 0.05 percentage points; 98 %
are asked for. [paper.md](paper.md) names the others and says why they differ.

**Verified beside the votes.** Over all runs {wrong} of {stars:,} stars are misidentified
({1e5 * wrong / stars:.2f} in 100,000; at most 1 is asked for), where the votes misidentify
{missed:.2%}; {left / stars:.2%} are left ambiguous or unmatched. Of each run at most
{MOST_OPEN_PCT} % may be, {NOISY_PCT} % where the noise is three times nominal or more, and
{DESERT_PCT} % in the cap desert with the attitude off by 90° and more.

![Stars not named rightly, run by run](plots/paper-verified.svg)
"""


def _name(tally: Tally) -> str:
    return f"{tally.run.table} {tally.run.run}"


def _draw(votes: Sequence[Tally], verified: Sequence[Tally], pictures: Folder) -> None:
    """Draw the share of stars of every run not named rightly, by votes and verified."""
    figure = pictures.figure(9.0, 3.6)
    axis = figure.subplots()
    for tallies, color, label, marker in (
        (votes, "#b45309", "votes", "o"),
        (verified, "#0b5394", "verified", "s"),
    ):
        share = [max(open_pct(tally) + wrong_pct(tally), FOOT_PCT) for tally in tallies]
        axis.plot(share, marker, color=color, markersize=3.5, label=label)
    asked = [most_open_pct(tally.run) for tally in verified]
    axis.plot(asked, drawstyle="steps-mid", color="#888888", linewidth=0.8, label="asked for")
    tables = [tally.run.table for tally in votes]
    first = [k for k, name in enumerate(tables) if k == 0 or tables[k - 1] != name]
    for k in first[1:]:
        axis.axvline(k - 0.5, color="#cccccc", linewidth=0.8)
    axis.set_xticks(first, [f"T{tables[k]}" for k in first])
    axis.set(yscale="log", ylim=(0.8 * FOOT_PCT, 110.0), ylabel="not named rightly (%)")
    axis.set_xlabel(f"runs, table by table; at the foot {FOOT_PCT:g} % or less")
    axis.grid(visible=False, axis="x")
    axis.legend(fontsize=7, loc="upper right")
    pictures.save(figure, "paper-verified")


SECTION = Section("The runs of the paper", write, (*CORE, *SIMULATOR, "studies/paper_1994"))

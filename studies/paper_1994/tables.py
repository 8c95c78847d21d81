"""The tables as Markdown that reads well in a terminal too: the paper's numbers beside ours."""

from collections.abc import Mapping, Sequence

from studies.documents import markdown
from studies.paper_1994.printed import Run
from studies.paper_1994.region import (
    Difference,
    differences,
    distance_squared,
    is_inside,
    spread,
)
from studies.paper_1994.tally import AMBIGUOUS, MISIDENTIFIED, UNMATCHED, Tally

TITLES: Mapping[int, str] = {
    2: "Increasing attitude error, cap",
    3: "Increasing attitude error, band",
    4: "Increasing magnitude error, cap",
    5: "Increasing magnitude error, band",
    6: "Increasing position error, cap",
    7: "Increasing position error, band",
    8: "Bands about the Sun",
    9: "Star desert and star forest, cap",
    10: "Star desert and star forest, band",
    11: "Execution times, cap",
    12: "Execution times, band",
    13: "k_g and the memory it bounds, cap",
    14: "k_g and the memory it bounds, band",
}


def heading(table: int) -> str:
    """A table's heading."""
    return f"### Table {table}. {TITLES[table]}"


def improvements(tallies: Sequence[Tally]) -> str:
    """Rows of Tables 2 to 10 for an identifier that is meant to do better than the paper's."""
    header = ("run", "1994: not identified", "wrong", "stars", "ambiguous", "unmatched", "wrong")
    return markdown(
        header,
        (
            (
                _label(tally.run),
                _count(tally.run.printed.ambiguous, tally.run.printed.stars),
                _count(tally.run.printed.misidentified, tally.run.printed.stars),
                str(tally.stars),
                *(
                    _count(tally.total(k), tally.stars)
                    for k in (AMBIGUOUS, UNMATCHED, MISIDENTIFIED)
                ),
            )
            for tally in tallies
        ),
    )


def rates(tallies: Sequence[Tally]) -> str:
    """Rows of Tables 2 to 10: printed counts and rates, ours, and whether they agree."""
    header = (
        "run",
        "stars of 1994",
        "not identified",
        "wrong",
        "ours: stars",
        "not identified",
        "wrong",
        "reference",
        "distance²",
        "inside",
    )
    return markdown(header, (_rates_row(tally) for tally in tallies))


def _rates_row(tally: Tally) -> tuple[str, ...]:
    run = tally.run
    printed = run.printed
    unidentified, wrong = differences(tally)
    return (
        _label(run),
        str(printed.stars),
        _count(printed.ambiguous, printed.stars),
        _count(printed.misidentified, printed.stars),
        str(tally.stars),
        _rate(unidentified),
        _rate(wrong),
        f"{_of_reference(unidentified)} / {_of_reference(wrong)}",
        f"{distance_squared(printed, spread(tally)):.2f}",
        "yes" if is_inside(tally) else "NO",
    )


def _label(run: Run) -> str:
    return f"{run.table[-1]} {run.run}" if run.table[-1] in "DF" else run.run


def _count(count: int, stars: int) -> str:
    return f"{count} ({100.0 * count / stars:.2f} %)"


def _rate(rate: Difference) -> str:
    return f"{rate.ours_pct:.2f} ± {rate.ours_sigma_pct:.2f} %"


def _of_reference(rate: Difference) -> str:
    return f"{rate.reference_pct:.2f}{'' if rate.agrees else '!'}"


def improvement_summary(tallies: Sequence[Tally]) -> str:
    """Stars of all runs: how many were not identified, how many misidentified."""
    stars = sum(tally.stars for tally in tallies)
    wrong = sum(tally.total(MISIDENTIFIED) for tally in tallies)
    unidentified = sum(tally.total(AMBIGUOUS) + tally.total(UNMATCHED) for tally in tallies)
    return (
        f"Of {stars} stars in {len(tallies)} runs: misidentified {_count(wrong, stars)}, "
        f"not identified {_count(unidentified, stars)}."
    )


def summary(tallies: Sequence[Tally]) -> str:
    """How many printed runs lie inside, and how many rates agree with the reference."""
    inside = sum(is_inside(tally) for tally in tallies)
    pairs = [(tally, differences(tally)) for tally in tallies]
    agree = sum(rate.agrees for _, both in pairs for rate in both)
    experiments = min(spread(tally).experiments for tally in tallies)
    share = 100.0 * agree / (2 * len(tallies))
    regions = (
        f"Printed runs inside the 95 % region of experiments of their size: {inside} of "
        f"{len(tallies)} ({experiments:.0f} experiments a run or more)."
    )
    reference = (
        "Rates that agree with the reference within three combined standard errors or 0.05 "
        f"percentage points: {agree} of {2 * len(tallies)} ({share:.1f} %)."
    )
    lines = [regions, reference]
    outside = [f"{t.run.table} {t.run.run}" for t in tallies if not is_inside(t)]
    differ = [f"{t.run.table} {t.run.run}" for t, both in pairs if not all(r.agrees for r in both)]
    if outside:
        lines.append(f"Outside: {'; '.join(outside)}.")
    if differ:
        lines.append(f"Other than the reference: {'; '.join(differ)}.")
    return "\n".join(lines)

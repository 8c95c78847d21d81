"""Page about lost in space: bounds, tables, plots."""

import io
import math
import platform
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.bounds import Bound, at_least, at_most, faults_of
from benchmarks.record import CORE, SIMULATOR, record_of
from benchmarks.validation.lost_in_space.conditions import UNCALIBRATED_MAG, WITHOUT_MAGNITUDES
from benchmarks.validation.lost_in_space.rows import Row, interval, more_often

OURS = ("lost_in_space", "pipeline, a priori")
SOURCES = (
    *CORE,
    *SIMULATOR,
    "benchmarks/validation/lost_in_space",
)
LEAST_RIGHT = {
    "0 px": 0.995,
    "0.5 px": 0.993,
    "1 px": 0.990,
    "2 px": 0.983,
    "five brightest": 0.998,
    "five, prior 0.05 deg": 0.999,
    "five, prior 0.3 deg": 0.999,
    "five, prior 1 deg": 0.999,
    "five, prior 3 deg": 0.999,
    "ten and 0 spurious": 0.998,
    "ten and 2 spurious": 0.998,
    "ten and 5 spurious": 0.998,
    "ten and 10 spurious": 0.998,
    "sigma told half": 0.98,
    "sigma told double": 0.98,
    "focal length off 0.2 %": 0.98,
    "magnitudes off 0.7": 0.98,
    WITHOUT_MAGNITUDES: 0.98,
    **dict.fromkeys(UNCALIBRATED_MAG, 0.98),
}
LEAST_RIGHT_OF_SIX, LEAST_OF_SIX = {"1 px": 0.999}, 0.998
"""Least share of right answers for fields of six or more stars: by condition, and default."""
MOST_WRONG = {"1 px": 1 / 40_000, "2 px": 2 / 20_000, "random points": 1e-4, "mirrored": 0.0}
"""Greatest shares of wrong answers; a sample smaller than one per share may have one more."""
FEWER = {(name, WITHOUT_MAGNITUDES) for name in UNCALIBRATED_MAG}
"""Conditions that need at least as many right answers as another one."""
SIGNIFICANT = 0.05
NOT_ON_THE_PAGE = (
    *("0 px", "0.5 px", "five, prior 0.05 deg", "five, prior 1 deg"),
    *("ten and 0 spurious", "ten and 2 spurious", "sigma told half"),
)
"""Conditions that the command prints and the page omits; the plots have some of them."""
OF_THE_SECTION = (
    *("1 px", "2 px", "random points", "mirrored"),
    *(WITHOUT_MAGNITUDES, *UNCALIBRATED_MAG),
)
"""Conditions with rates in the section of the verification."""
PLOTTED = ("0 px", "0.5 px", "1 px", "2 px")


def bounds_of(rows: Sequence[Row]) -> list[Bound]:
    """Bounds of the service's rows; a figure is out of bounds beyond 95 % of chance."""
    bounds = []
    for row in rows:
        if row.solver not in OURS:
            continue
        where = f"{row.condition}: {row.solver}"
        if (least := LEAST_RIGHT.get(row.condition)) is not None:
            bounds.append(_share_at_least(f"{where}: right", row.right, row.scenes, least))
            if row.six:
                least = LEAST_RIGHT_OF_SIX.get(row.condition, LEAST_OF_SIX)
                label = f"{where}: right of those with six stars"
                bounds.append(_share_at_least(label, row.right_of_six, row.six, least))
        allowed = math.ceil(MOST_WRONG.get(row.condition, 1e-4) * row.scenes)
        bounds.append(at_most(f"{where}: wrong of {row.scenes:,}", row.wrong, allowed))
        for other in rows:
            # Compare only rows with the same scenes.
            if (row.condition, other.condition) in FEWER and row.scenes == other.scenes:
                label = f"{where}: right, beside {other.right:,} of {other.condition}"
                bounds.append(at_least(label, row.right, other.right))
            if other.condition == row.condition and other is not row:
                chance = more_often(row, other)
                label = f"{where}: chance that it is wrong so much more often than {other.solver}"
                bounds.append(at_least(label, chance, SIGNIFICANT))
    return bounds


def _share_at_least(what: str, hits: int, of: int, least: float) -> Bound:
    """Bound of a share: the upper end of its 95 % interval must reach the least share."""
    measured = f"{hits / of:.2%} of {of:,}" if of else "none"
    return Bound(what, measured, f"at least {least:.1%}", of > 0 and interval(hits, of)[1] >= least)


def shown_rows(rows: Iterable[Row]) -> str:
    """Table of the rows for the terminal and the page."""
    head = (
        "| condition | solver | scenes | right % (95 %) | six stars or more % | wrong | none "
        "| median ms | p99 ms | longest ms | MB |"
    )
    lines = [head, "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"]
    for row in rows:
        low, high = interval(row.right, row.scenes)
        six = f"{100 * row.right_of_six / row.six:.2f}" if row.six and row.right else "-"
        share = f"{100 * row.right / row.scenes:.2f} ({100 * low:.2f}-{100 * high:.2f})"
        lines.append(
            f"| {row.condition} | {row.solver} | {row.scenes:,} "
            f"| {share if row.right else '-'} | {six} | {row.wrong} | {row.none} "
            f"| {row.median_ms:.4f} | {row.p99_ms:.3f} | {row.max_ms:.1f} "
            f"| {row.database_mb:.1f} |"
        )
    return "\n".join(lines)


def section_text(rows: Sequence[Row]) -> str:
    """Text for the page of verifications: the service's own rates, without times."""
    lines = [
        "Scenes of a camera of 10 degrees and 1,024 pixels at attitudes spread evenly, stars to",
        "V 6 after half a magnitude of noise, so that stars are lost and added; the index goes to",
        "V 6.5. Right: boresight within 0.1 deg and total rotation within 1 deg. The bounds are of",
        "all conditions; [lost-in-space.md](lost-in-space.md) has more of them, other solvers, and",
        "the times.",
        "A search that the magnitudes refuse is repeated without them: with any offset at least as",
        "many are right as without magnitudes.",
        "",
        "| condition | scenes | right | of those with six stars | wrong | none |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        if row.condition not in OF_THE_SECTION:
            continue
        six = f"{row.right_of_six / row.six:.2%}" if row.six and row.right else "-"
        right = f"{row.right / row.scenes:.2%}" if row.right else "-"
        lines.append(
            f"| {row.condition} | {row.scenes:,} | {right} | {six} | {row.wrong} | {row.none} |"
        )
    return "\n".join(lines)


def document(rows: Sequence[Row], scenes: int, seed: int, turn: int) -> tuple[str, dict[str, str]]:
    """Page, and its plots by file name."""
    pictures = {
        "lost-in-space-rates.svg": _plot(rows, "rates"),
        "lost-in-space-times.svg": _plot(rows, "times"),
    }
    faults = faults_of(bounds_of(rows))
    verdict = (
        "Everything is within its bounds."
        if not faults
        else "**Out of bounds:** " + "; ".join(faults) + "."
    )
    text = f"""# Lost in space, beside other solvers

For engineers who need an attitude without a prior, or who compare solvers.
Written by
`python -m benchmarks.validation.lost_in_space --scenes {scenes} --seed {seed} --write` in an
environment with the extra `peers`; its figures are not edited by hand. Python
{platform.python_version()}. {verdict}

{record_of(SOURCES).sentence} Seed {seed}, {scenes:,} scenes at one pixel.
<!-- {record_of(SOURCES)} -->

## What is asked

A camera of 10 degrees and 1,024 pixels looks anywhere. It shows the stars that are no fainter
than V 6 after half a magnitude of noise, so that stars are lost and fainter ones added, some of
them fainter than any solver's database, which goes to V 6.5. Places are off by the pixels given,
35 arcsec each. *Right* is an attitude whose boresight is within 0.1 deg and whose total rotation
is within 1 deg of the truth; *wrong* is any other; *none* is no answer. "Six stars or more" counts
fields with at least six detected stars of the database.

- **five brightest**: of the fields of 4 deg radius that show five stars or more, at 0.1 px.
- **prior**: the same with an a priori attitude off by so much about any axis, through the whole
  pipeline (`verified`, a zone of stars to V 7.5 built for every scene) and tetra3rs in its
  tracking mode.
- **ten and N spurious**: the ten brightest stars with N points anywhere, as bright as stars are.
- **random points**: 5 to 20; **mirrored**: one axis turned round at 1 px. Nothing is right there.
- **sigma told**, **magnitudes off**: what only our solver is told, and told wrongly; **no
  magnitudes** and **without zero point** (-2.5 log10 of counts) likewise. Where the search with
  magnitudes is refused, ours searches again without them; its times include both.

All solvers look for the same stars, those of our run catalog to V 6.5; ours also knows those to
V 7.5 when it holds an attitude against the sky. Each is driven as its documents say
(`benchmarks/validation/lost_in_space/peers.py`). cedar-solve and ruststartracker, which take
milliseconds, get the first scenes only. Solvers take turns in blocks of {turn} scenes. Times are of
the process's own clock around one call from Python.

## What came of it

{shown_rows(row for row in rows if row.condition not in NOT_ON_THE_PAGE)}

Without `--write` the command prints more conditions.

![Share of right answers](plots/lost-in-space-rates.svg)

![Times](plots/lost-in-space-times.svg)
"""
    return text, pictures


def _plot(rows: Sequence[Row], kind: str) -> str:
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "lost-in-space"
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    chosen = [row for row in rows if row.condition in PLOTTED]
    for solver in dict.fromkeys(row.solver for row in chosen):
        mine = [row for row in chosen if row.solver == solver]
        x = [float(row.condition.split()[0]) for row in mine]
        if kind == "rates":
            bounds = [interval(row.right, row.scenes) for row in mine]
            share = [100 * row.right / row.scenes for row in mine]
            low = [s - 100 * b[0] for s, b in zip(share, bounds, strict=True)]
            high = [100 * b[1] - s for s, b in zip(share, bounds, strict=True)]
            axes.errorbar(x, share, yerr=[low, high], marker="o", capsize=3, label=solver)
        else:
            line: Any = axes.plot(x, [row.median_ms for row in mine], marker="o", label=solver)
            axes.plot(x, [row.p99_ms for row in mine], "--", color=line[0].get_color(), alpha=0.6)
    axes.set_xlabel("position noise, px")
    if kind == "rates":
        axes.set_ylabel("right, % of all scenes")
    else:
        axes.set_ylabel("ms a scene: median, dashed 99th percentile")
        axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    plt.close(figure)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"

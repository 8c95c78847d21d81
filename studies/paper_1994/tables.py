"""Tables of the paper's numbers and ours in Markdown that is also readable in a terminal.

Tables 11 to 14 compare times, k_g, and the memory that k_g bounds.
"""

import math
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.acquire import acquire
from service.acquire.prewarm import prewarm_kernels
from service.cli.markdown import markdown
from service.identify.prior_attitude import prior_attitude, search_region
from service.missions.mission import Band, Identifier, Mission
from service.sky.geometry.pairs import PAIRS_PER_BIN, build_pairs
from service.sky.model import SkyModel
from service.sky.zones import build_zone
from studies.paper_1994.experiments import open_sky
from studies.paper_1994.printed import Run, Times, World, the_paper
from studies.paper_1994.tally import (
    AMBIGUOUS,
    MISIDENTIFIED,
    UNMATCHED,
    Difference,
    Tally,
    differences,
    distance_squared,
    is_inside,
    spread,
)
from studies.paper_1994.views import EPOCH, View, batch_of, draw_zone, paper_mission

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
    """Heading of a table, with number and title."""
    return f"### Table {table}. {TITLES[table]}"


def improvements(tallies: Sequence[Tally]) -> str:
    """Rows of Tables 2 to 10 for an identifier that should outperform the paper's."""
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
    """Rows of Tables 2 to 10: printed counts and rates, ours, and their agreement."""
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
    """Sentence with the numbers of unidentified and misidentified stars in all runs."""
    stars = sum(tally.stars for tally in tallies)
    wrong = sum(tally.total(MISIDENTIFIED) for tally in tallies)
    unidentified = sum(tally.total(AMBIGUOUS) + tally.total(UNMATCHED) for tally in tallies)
    return (
        f"Of {stars} stars in {len(tallies)} runs: misidentified {_count(wrong, stars)}, "
        f"not identified {_count(unidentified, stars)}."
    )


def summary(tallies: Sequence[Tally]) -> str:
    """Sentences with the number of printed runs in the 95 % region and of agreeing rates."""
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


BYTES_PER_PAIR = 8 + 4 + 4 + 4 / PAIRS_PER_BIN
"""Memory of a pair in bytes: a separation, two rows and a share of a bin."""


LIMITS_S = {11: 4.0, 12: 600.0}
"""Time limits in seconds: for an update (XTE, SWAS), and for the result of a pass (SOHO)."""

Row = dict[str, Any]


# A zone with no pairs worth mentioning: its time is that of choosing the stars.
_NO_PAIRS_DEG = 1e-9


@dataclass(frozen=True)
class ZoneTime:
    """Times of building one zone and identifying its views, in seconds.

    `first_s` includes the pair index and the first identification, `later_s` are the later
    identifications, `batch_s` whole batches in the pipeline.
    """

    stars: int
    pairs: int
    pairs_bytes: int
    generate_s: float
    first_s: float
    later_s: tuple[float, ...]
    batch_s: tuple[float, ...]


def measure(case: Times, seed: int, identifier: Identifier = "starid") -> list[ZoneTime]:
    """Measure the times of a row's zones, ten views each, with nominal errors, in this process."""
    world = the_paper().worlds[case.world]
    sky = open_sky()
    mission = paper_mission(world.mission)
    prewarm_kernels(sky, {mission.name: mission}, [identifier])
    catalog = sky.run_catalog(mission, EPOCH)
    rng = np.random.default_rng([seed, int(case.table)])
    return [
        _measure_zone(world, list(draw_zone(world, number, mission, catalog, rng)), sky, identifier)
        for number in range(case.zones)
    ]


def _measure_zone(
    world: World, views: list[View], sky: SkyModel, identifier: Identifier
) -> ZoneTime:
    mission = paper_mission(world.mission)
    catalog = sky.run_catalog(mission, EPOCH)
    nominal = next(run for run in the_paper().runs if run.world == world.name)
    batches = [batch_of(view, nominal, mission, identifier) for view in views if len(view.star)]
    prior = batches[0].a_priori
    assert prior is not None
    presumed = prior_attitude(prior, EPOCH, mission)
    region = search_region(mission.trackers[0], presumed, mission, "a_priori")

    clock = [time.perf_counter()]
    zone = build_zone(mission.name, catalog, region, _NO_PAIRS_DEG)
    clock.append(time.perf_counter())
    pairs = build_pairs(zone.direction, mission.tolerances.pair_separation_max_deg)
    clock.append(time.perf_counter())

    # The pipeline builds the zone for itself once; only its identification counts here.
    first, *later = [
        acquire(batch, mission, sky).timings_us["identify"] * 1e-6 for batch in batches
    ]
    whole = []
    for batch in batches[1:]:
        started = time.perf_counter()
        acquire(batch, mission, sky)
        whole.append(time.perf_counter() - started)
    return ZoneTime(
        stars=len(zone.star),
        pairs=pairs.count,
        pairs_bytes=pairs.nbytes,
        generate_s=clock[1] - clock[0],
        first_s=clock[2] - clock[1] + first,
        later_s=tuple(later),
        batch_s=tuple(whole),
    )


def proportion(stars: int, pairs: int) -> float:
    """Share k_g of all pairs of a zone's stars that are close enough to be seen together."""
    return pairs / (stars * (stars - 1) / 2.0)


def time_row(case: Times, zones: Sequence[ZoneTime], identifier: str) -> Row:
    """Result row of Table 11 or 12, times in ms: least, median and greatest.

    `stars` and `pairs` are of the fastest and the slowest zone, as in the paper.
    """
    ordered = sorted(zones, key=lambda zone: zone.generate_s + zone.first_s)
    ends = ordered[0], ordered[-1]
    total_s = sum(zone.generate_s + zone.first_s + sum(zone.later_s) for zone in zones)
    return {
        "table": int(case.table),
        "case": case.case,
        "identifier": identifier,
        "zones": len(zones),
        "stars": [zone.stars for zone in ends],
        "pairs": [zone.pairs for zone in ends],
        "generate_ms": _spread_ms(zone.generate_s for zone in zones),
        "first_ms": _spread_ms(zone.first_s for zone in zones),
        "later_ms": _spread_ms(second for zone in zones for second in zone.later_s),
        "batch_ms": _spread_ms(second for zone in zones for second in zone.batch_s),
        "slowest_ms": 1e3 * (ends[1].generate_s + ends[1].first_s),
        "all_ms": 1e3 * total_s,
    }


def times(rows: Sequence[Row]) -> str:
    """Tables 11 and 12 in Markdown: the paper's seconds, least to greatest; our milliseconds."""
    header = (
        *("case", "step", "1994 (s)", "ours: least, median, most (ms)"),
        *("NCAP 1994", "ours", "NTOT 1994", "ours"),
    )
    lines: list[tuple[str, ...]] = []
    for row in rows:
        case = _case(row)
        sizes = (case.stars, row["stars"], case.pairs, row["pairs"])
        none, count = ("", "", "", ""), row["zones"]
        each_s, each_ms = case.total_s / count, row["all_ms"] / count
        steps: tuple[tuple[str, str, str], ...] = (
            ("SIDS and first", _seconds(case.first_s), _ms(row["first_ms"])),
            ("later ones", _seconds(case.later_s), _ms(row["later_ms"])),
            ("later, whole batch", "", _ms(row["batch_ms"])),
            (f"all {count} zones", f"{case.total_s:.2f}", _ms([row["all_ms"]])),
            ("mean of a zone", f"{each_s:.2f}", _ms([each_ms])),
        )
        first = (row["case"], "zone", _seconds(case.generate_s), _ms(row["generate_ms"]))
        lines += [(*first, *map(_range, sizes)), *(("", *step, *none) for step in steps)]
    return markdown(header, lines)


ABOUT_TIMES = (
    "NCAP and NTOT are those of the fastest and of the slowest zone; the greatest times include "
    "other work of the machine."
)


def limit(rows: Sequence[Row]) -> str:
    """Sentence with a mission's time limit and the time of the slowest zone."""
    slowest = max(rows, key=lambda row: float(row["slowest_ms"]))
    allowed = LIMITS_S[slowest["table"]]
    return (
        f"The mission allows {allowed:g} s; the slowest zone ({slowest['case']}), its pairs and "
        f"the first identification took {slowest['slowest_ms']:.3f} ms together."
    )


def _case(row: Row) -> Times:
    return next(
        each
        for each in the_paper().times
        if (each.table, each.case) == (str(row["table"]), row["case"])
    )


def _range(values: Sequence[int]) -> str:
    return "..".join(map(str, dict.fromkeys(values)))


def _seconds(values: tuple[float, float]) -> str:
    return f"{values[0]:.2f}..{values[1]:.2f}"


def _spread_ms(seconds: Iterable[float]) -> list[float]:
    values = [1e3 * value for value in seconds]
    return [min(values), statistics.median(values), max(values)]


def _ms(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def proportion_rows(table: int, case: Times, zones: Sequence[ZoneTime]) -> list[Row]:
    """Result rows of Table 13 or 14: of one zone, or of those with the most and fewest stars.

    The bound is that of equations 1 and 2.
    """
    ordered = sorted(zones, key=lambda zone: (zone.stars, zone.pairs))
    share = geometric_share(paper_mission(the_paper().worlds[case.world].mission))
    found = []
    for k in sorted({0, -1} if case.stars[0] != case.stars[1] else {0}, reverse=True):
        zone, place = ordered[k], 1 if k else 0
        found.append(
            {
                "table": table,
                "case": case.case,
                "stars_1994": case.stars[place],
                "pairs_1994": case.pairs[place],
                "k_g_1994": proportion(case.stars[place], case.pairs[place]),
                "stars": zone.stars,
                "pairs": zone.pairs,
                "k_g": proportion(zone.stars, zone.pairs),
                "k_g_areas": share,
                "pairs_bound": share * zone.stars * (zone.stars - 1) / 2.0,
                "index_bytes": zone.pairs_bytes,
            }
        )
    return found


def proportions(rows: Sequence[Row]) -> str:
    """Tables 13 and 14 in Markdown: k_g, the bound on NTOT, and the size of a pair index."""
    header = (
        *("case", "NCAP 1994", "NTOT 1994", "k_g 1994", "NCAP", "NTOT", "k_g"),
        *("k_g of the areas", "bound on NTOT", "bound (kB)", "index (kB)"),
    )
    lines = [
        (
            row["case"],
            *(str(row[name]) for name in ("stars_1994", "pairs_1994")),
            f"{row['k_g_1994']:.4f}",
            *(str(row[name]) for name in ("stars", "pairs")),
            *(f"{row[name]:.4f}" for name in ("k_g", "k_g_areas")),
            f"{row['pairs_bound']:.0f}{'' if row['pairs'] <= row['pairs_bound'] else ' !'}",
            f"{row['pairs_bound'] * BYTES_PER_PAIR / 1e3:.0f}",
            f"{row['index_bytes'] / 1e3:.0f}",
        )
        for row in rows
    ]
    return markdown(header, lines)


def geometric_share(mission: Mission) -> float:
    """Approximate k_g of the paper: thrice the field of view's area over the zone's, both flat."""
    radius = mission.trackers[0].field_of_view_radius_deg
    if isinstance(mission.zone, Band):
        return 3.0 * math.pi * radius**2 / (360.0 * 2.0 * mission.zone.half_width_deg)
    return 3.0 * (radius / mission.zone.radius_deg) ** 2

"""Tables 11 to 14 as Markdown: the times of 1994 beside ours, k_g and the memory that it bounds."""

import math
import statistics
from collections.abc import Iterable, Sequence

from service.missions.mission import Band, Mission
from service.sky.geometry.pairs import PAIRS_PER_BIN
from service.studies.paper_1994.printed import Times, the_paper
from service.studies.paper_1994.tables import markdown
from service.studies.paper_1994.timings import ZoneTime, proportion
from service.studies.paper_1994.views import paper_mission

BYTES_PER_PAIR = 8 + 4 + 4 + 4 / PAIRS_PER_BIN
"""A separation, two rows and a share of a bin."""


def times(measured: Sequence[tuple[Times, Sequence[ZoneTime]]]) -> str:
    """Rows of Tables 11 and 12: seconds of 1994, least to greatest, beside our milliseconds.

    Ours end at the median: the greatest would tell of the machine's other work.
    """
    header = (
        "case",
        "step",
        "1994 (s)",
        "ours, least..median (ms)",
        "NCAP 1994",
        "ours",
        "NTOT 1994",
        "ours",
    )
    rows: list[tuple[str, ...]] = []
    for case, zones in measured:
        stars, pairs = [zone.stars for zone in zones], [zone.pairs for zone in zones]
        sizes = (_range(case.stars), _range(stars), _range(case.pairs), _range(pairs))
        later = [second for zone in zones for second in zone.later_s]
        whole = [second for zone in zones for second in zone.batch_s]
        total = sum(zone.generate_s + zone.first_s + sum(zone.later_s) for zone in zones)
        none = ("", "", "", "")
        rows += [
            (
                case.case,
                "zone",
                _seconds(case.generate_s),
                _ms(z.generate_s for z in zones),
                *sizes,
            ),
            ("", "SIDS and first", _seconds(case.first_s), _ms(z.first_s for z in zones), *none),
            ("", "later ones", _seconds(case.later_s), _ms(later), *none),
            ("", "later, whole batch", "", _ms(whole), *none),
            ("", f"all {len(zones)} zones", f"{case.total_s:.2f}", _ms([total]), *none),
        ]
    return markdown(header, rows)


def _range(values: Sequence[int]) -> str:
    return str(min(values)) if min(values) == max(values) else f"{min(values)}..{max(values)}"


def _seconds(values: tuple[float, float]) -> str:
    return f"{values[0]:.2f}..{values[1]:.2f}"


def _ms(seconds: Iterable[float]) -> str:
    values = [1e3 * value for value in seconds]
    low, high = min(values), statistics.median(values)
    return f"{low:.3f}" if len(values) == 1 else f"{low:.3f}..{high:.3f}"


def proportions(measured: Sequence[tuple[Times, Sequence[ZoneTime]]]) -> str:
    """Rows of Tables 13 and 14: k_g, the bound it sets on NTOT, and the bytes of a pair index."""
    header = (
        "case",
        "NCAP 1994",
        "NTOT 1994",
        "k_g 1994",
        "NCAP",
        "NTOT",
        "k_g",
        "k_g of the areas",
        "bound on NTOT",
        "bound (kB)",
        "index (kB)",
    )
    rows: list[tuple[str, ...]] = []
    for case, zones in measured:
        ordered = sorted(zones, key=lambda zone: (zone.stars, zone.pairs))
        mission = paper_mission(the_paper().worlds[case.world].mission)
        share = geometric_share(mission)
        # One zone where they are all the same, else the one with fewest stars and that with most.
        for k in sorted({0, -1} if case.stars[0] != case.stars[1] else {0}, reverse=True):
            zone, place = ordered[k], 1 if k else 0
            bound = share * zone.stars * (zone.stars - 1) / 2.0
            ncap, ntot = case.stars[place], case.pairs[place]
            rows.append(
                (
                    case.case,
                    str(ncap),
                    str(ntot),
                    f"{proportion(ncap, ntot):.4f}",
                    str(zone.stars),
                    str(zone.pairs),
                    f"{proportion(zone.stars, zone.pairs):.4f}",
                    f"{share:.4f}",
                    f"{bound:.0f}{'' if zone.pairs <= bound else ' !'}",
                    f"{bound * BYTES_PER_PAIR / 1e3:.0f}",
                    f"{zone.pairs_bytes / 1e3:.0f}",
                )
            )
    return markdown(header, rows)


def geometric_share(mission: Mission) -> float:
    """The paper's approximation of k_g: thrice the field of view's area over the zone's, flat."""
    radius = mission.trackers[0].field_of_view_radius_deg
    if isinstance(mission.zone, Band):
        return 3.0 * math.pi * radius**2 / (360.0 * 2.0 * mission.zone.half_width_deg)
    return 3.0 * (radius / mission.zone.radius_deg) ** 2

"""Report of a mission check, as text for a terminal and as JSON."""

import sys
import textwrap
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.intervals import wilson
from service.mission_checks.mission_check import (
    FEW_STARS,
    Finding,
    TrackerView,
    findings,
    tracker_views,
)
from service.mission_checks.zone_census import ZoneCensus, axes_deg, zone_censuses
from service.sky.catalog.run_catalog import RunCatalog, build_run_catalog
from service.times import FIRST_YEAR, LAST_YEAR, parse_utc, utc_now

if TYPE_CHECKING:
    from service.missions.mission import Mission
    from service.simulate.expected import Expected
    from service.sky.catalog.star_catalog import Catalog

WIDTH = 96
SHADES = " .:-=+*#%@"
FAINTEST_SHARE = 99.0
"""Percentile of magnitudes taken as the faint limit of a star catalog."""


@dataclass(frozen=True)
class MissionReport:
    """Results of checking a mission file."""

    mission: "Mission"
    run_catalog: RunCatalog
    views: list[TrackerView]
    zones: list[ZoneCensus]
    findings: list[Finding]
    expected: "list[Expected]" = field(default_factory=list)


def examined(mission: "Mission", catalog: "Catalog", epoch: float | None) -> MissionReport:
    """Check a mission with the run catalog of an epoch in years, by default the present year."""
    year = mission.catalog.epoch_of(epoch_of(epoch))
    run_catalog = build_run_catalog(catalog, mission.run_catalog_settings, year)
    if len(run_catalog) == 0:
        empty = Finding("wrong", "catalog", "leaves no star in the run catalog")
        return MissionReport(mission, run_catalog, [], [], [empty])
    views, zones = tracker_views(mission, run_catalog), zone_censuses(mission, run_catalog)
    faintest_mag = float(np.percentile(catalog.magnitude_v_mag, FAINTEST_SHARE))
    found = findings(mission, faintest_mag, views, zones)
    return MissionReport(mission, run_catalog, views, zones, found)


def with_expectation(report: MissionReport, catalog: "Catalog", seconds: float) -> MissionReport:
    """Add outcomes of views simulated for `seconds`; unchanged if no zones were checked."""
    from service.acquire.kernel_build import KernelBuild
    from service.simulate.expected import expected_outcomes
    from service.sky.cache import LruCache
    from service.sky.model import SkyModel

    if not report.zones:
        return report
    if KernelBuild().is_needed:
        text = "the first start on a machine compiles for one to two minutes"
        print(text, file=sys.stderr, flush=True)
    sky = SkyModel(catalog, LruCache(256 << 20))
    moment = parse_utc(f"{report.run_catalog.epoch_year:.0f}-03-01T00:00:00Z")
    return replace(report, expected=expected_outcomes(report.mission, sky, moment, seconds))


def epoch_of(epoch: float | None) -> float:
    """Year of `--epoch`, by default now; raises `BadInput` outside of the supported years."""
    year = utc_now().julian_year if epoch is None else epoch
    if not FIRST_YEAR <= year <= LAST_YEAR + 1:
        message = f"must be from {FIRST_YEAR} to {LAST_YEAR + 1}, as the time of a batch"
        raise BadInput(Fault("--epoch", message, shown_value(epoch)))
    return year


def refusals(error: Exception, file: Path) -> list[dict[str, str]]:
    """Faults of an unreadable mission file, by key."""
    found = []
    for line in str(error).splitlines():
        key, _, text = line.removeprefix(f"{file}: ").partition(": ")
        found.append({"level": "wrong", "key": key, "text": text})
    return found


def report_json(report: MissionReport) -> dict[str, Any]:
    """Report of a mission check as plain values, for JSON."""
    ra_deg, dec_deg = axes_deg()
    return {
        "mission": report.mission.name,
        "epoch_year": report.run_catalog.epoch_year,
        "run_catalog_stars": len(report.run_catalog),
        "findings": [asdict(each) for each in report.findings],
        "trackers": [asdict(each) for each in report.views],
        "zones": [
            {
                "of": each.of,
                **{name: asdict(spread) for name, spread in each.spread.items()},
                "ra_deg": ra_deg.tolist(),
                "dec_deg": dec_deg.tolist(),
                "pairs_by_dec_ra": each.pairs.tolist(),
            }
            for each in report.zones
        ],
        "expected": [
            {
                "sky": each.sky,
                "views": each.views,
                "attitudes": each.attitudes,
                "stars": each.stars,
            }
            for each in report.expected
        ],
    }


def report_text(report: MissionReport) -> str:
    """Report of a mission check as text, with a map of pairs for each shape of zone."""
    mission, stars = report.mission, len(report.run_catalog)
    lines = [
        (
            f"{mission.name}: {len(mission.trackers)} tracker(s), {stars} stars to "
            f"{mission.catalog.magnitude_limit_mag:g} mag in the run catalog of "
            f"{report.run_catalog.epoch_year:g}"
        ),
        "",
    ]
    for each in report.findings:
        lines += textwrap.wrap(
            f"{each.level:<10}{each.key}: {each.text}", WIDTH, subsequent_indent=" " * 10
        )
    if not report.findings:
        lines.append("ok        nothing is wrong, nothing is unusual")
    lines += ["", *_sentences(report)]
    lines += ["", f"{'over the whole sky':<44}{'least':>10}{'median':>10}{'most':>10}"]
    for view in report.views:
        lines.append(_row(f"stars in the view of {view.tracker}", view.stars))
        lines.append(
            f"  fewer than {FEW_STARS} of them in {100.0 * view.few_share:.1f} % of the sky"
        )
    for zone in report.zones:
        lines.append(zone.of)
        lines += [_row(f"  {name}", spread) for name, spread in zone.spread.items()]
    for zone in report.zones:
        lines += ["", *_map(zone)]
    return "\n".join(lines)


def _sentences(report: MissionReport) -> list[str]:
    """Wrapped sentences on a mission's views, zone and expected outcomes."""
    mission, zone = report.mission, report.mission.zone
    lines = [
        f"{view.tracker} sees {FEW_STARS} stars or more in {100.0 * (1.0 - view.few_share):.0f} % "
        f"of the sky; {view.stars.median} in a usual view."
        for view in report.views
    ]
    field_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    error = f"{mission.presumed_error_deg:.3g} deg"
    if not mission.knows_attitude:
        lines.append("The mission is lost in space: each batch is sought in the whole sky.")
    elif zone.kind == "band":
        lines.append(
            f"The band is {zone.half_width_deg:g} deg wide to either side: the radius of the field "
            f"of view, {field_deg:g} deg, and an error of the Sun-pointed axis of {error}."
        )
    else:
        lines.append(
            f"The zone has a radius of {zone.radius_deg:g} deg: that of the field of view, "
            f"{field_deg:g} deg, and an a priori error of {error} about each axis."
        )
    lines += [
        f"Expected in {each.sky} sky ({_LATITUDES[each.sky]} deg from the plane of the Milky Way; "
        f"{each.views} simulated views), with 95 % intervals: {_share(each, 'unique')} of the "
        f"stars unique, {_share(each, 'ambiguous')} ambiguous, {_share(each, 'unmatched')} "
        f"unmatched, {_share(each, 'wrong')} wrong; a good attitude in "
        f"{100.0 * each.attitudes / each.views:.0f} % of the views."
        for each in report.expected
    ]
    return [part for line in lines for part in textwrap.wrap(line, WIDTH)]


def _share(expected: "Expected", outcome: str) -> str:
    """Share of stars in percent with its interval; views count, as their stars are correlated."""
    found = wilson(expected.share(outcome), expected.views)
    low, high = (f"{100.0 * each:.1f}" for each in (found.low, found.high))
    return f"{100.0 * found.value:.1f} % ({low} to {high})"


_LATITUDES = {"clear": "more than 30", "dense": "less than 10"}


def _row(title: str, of: Any) -> str:
    return f"{title:<44}{of.least:>10,}{of.median:>10,}{of.most:>10,}"


def _map(zone: ZoneCensus) -> list[str]:
    """Map of pairs by the direction of the zone's axis, one character per direction."""
    _, dec_deg = axes_deg()
    most = max(1, zone.spread["pairs"].most)
    shade = np.minimum(zone.pairs * len(SHADES) // most, len(SHADES) - 1).astype(int)
    lines = [f"pairs in a {zone.of}, by the direction of its axis; '@' is {most:,}"]
    # East is to the left, as on the sky.
    for dec, row in zip(dec_deg, shade[:, ::-1], strict=True):
        lines.append(f"{dec:+5.0f} |{''.join(SHADES[each] for each in row)}|")
    half = " " * 33
    return [*lines, f"  RA  360{half}180{half}0 deg"]

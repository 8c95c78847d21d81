"""Commands `acquire simulate mission`, `paper` and `imaging`, if this package is installed.

The service finds `add` by the entry point of `pyproject.toml` in this folder.
"""

import io
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import (
    add_command,
    add_json,
    commands_of,
    count,
    mission_of_file_or_name,
    print_json,
)
from service.errors import BadInput, Fault, shown_value
from service.missions.identifiers import IDENTIFIERS

IN_ZONES = [name for name, entry in IDENTIFIERS.items() if entry.searches_zone]
VOTES = "starid"
TESTS_USUALLY_ON = ("magnitude", "cross_product", "pole")
TESTS_USUALLY_OFF = ("fov_rotation", "match_groups")
DEFAULT_STARS = 10_000
STANDARD_OUTPUT = Path("-")
NOTES = """\
names of a sweep, with the paper's where it has one:
  tolerances of the mission file: pair_separation_max_deg (HMAX), separation_deg (SEPTOL),
    magnitude_mag (XMTOL), magnitude_order_mag (TMAGMX), cross_product_deg (CAPMAX,
    BANMAX), pole_difference_deg (BANTOL1), pole_angle_deg (BANTOL2), fov_rotation_deg
  size of the zone: radius_deg (CCAP), half_width_deg (WBAND)
  errors: phi_deg, theta_deg, psi_deg (LIBROT), off_axis_deg (RCVIEW),
    position_error_arcsec (per tangent axis; SIGOBS is 1.414 times it),
    magnitude_error_mag (SIGMAG), magnitude_bound_mag (RCMAG)
Without a sweep tolerances, zone, position_error_arcsec and magnitude_error_mag are those of
the mission file, the angles are 0, off_axis_deg is the margin of the zone about the
field of view, and magnitude_bound_mag is six times magnitude_error_mag.
All settings see the same stars and draws. Nothing is searched outside the zone."""


def add(commands: Any) -> None:
    """Add the commands of the studies to the group `simulate`."""
    group = commands_of(commands, "simulate")
    _add_imaging(group)
    _add_mission(group)
    _add_paper(group)


def _add_json_file(parser: ArgumentParser, what: str) -> None:
    """Add the option `--json [OUT]`, which writes `what` as JSON to a file or prints it."""
    parser.add_argument(
        "--json",
        type=Path,
        nargs="?",
        const=STANDARD_OUTPUT,
        metavar="OUT",
        help=f"write {what} to OUT; without OUT, print them instead of the tables",
    )


def _add_mission(group: Any) -> None:
    parser = add_command(
        group,
        "mission",
        _run_mission,
        notes=NOTES,
        first="--sweep --at-most-ambiguous --stars --plot",
    )
    parser.add_argument(
        "mission", metavar="MISSION", help="the name of a spacecraft, or a mission file (.toml)"
    )
    parser.add_argument(
        "--sweep",
        action="append",
        default=[],
        metavar="NAME=VALUES",
        help="values such as .01,.02,.05, or a range such as .3:.9:.2; one value sets it; may be "
        "repeated, for every combination",
    )
    parser.add_argument(
        "--direction",
        type=_direction,
        metavar="RA,DEC",
        help="deg; draw the axes of zones about this direction; default: over the whole sky",
    )
    parser.add_argument(
        "--within", type=float, metavar="DEG", help="largest angle from it (RCCAT); default 0"
    )
    parser.add_argument("--tracker", metavar="NAME", help="default: the first of the mission")
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        choices=TESTS_USUALLY_ON,
        metavar="TEST",
        help=f"switch a test of the votes off: {', '.join(TESTS_USUALLY_ON)}; may be repeated",
    )
    parser.add_argument(
        "--with",
        dest="with_",
        action="append",
        default=[],
        choices=TESTS_USUALLY_OFF,
        metavar="TEST",
        help=f"switch a test of the votes on: {', '.join(TESTS_USUALLY_OFF)}; may be repeated",
    )
    parser.add_argument(
        "--identifier",
        choices=IN_ZONES,
        metavar="NAME",
        help=f"{', '.join(IN_ZONES)}; default: {VOTES} where a test or a tolerance is asked for "
        "that only it uses, else the mission's",
    )
    _add_draws(parser)
    _add_outputs(parser)


def _add_draws(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--stars",
        type=count,
        default=DEFAULT_STARS,
        metavar="N",
        help=f"approximate number of stars for each setting; default {DEFAULT_STARS}",
    )
    parser.add_argument(
        "--views",
        type=count,
        default=10,
        metavar="N",
        help="views in each zone; default 10",
    )
    parser.add_argument(
        "--stars-per-view",
        type=count,
        default=5,
        metavar="N",
        help="most stars of a view; default 5",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")


def _add_outputs(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--at-most-ambiguous",
        type=_share,
        metavar="SHARE",
        help="name the settings that keep ambiguous stars below this, such as 0.01",
    )
    parser.add_argument("--plot", type=Path, metavar="OUT.svg", help="draw the rates as SVG")
    parser.add_argument(
        "--page", type=Path, metavar="OUT.html", help="write a page with table and picture"
    )
    add_json(parser, "the rates")
    parser.add_argument("--processes", type=count, metavar="N", help="default: one per core")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _run_mission(parsed: Namespace) -> int:
    """Simulate the views of a mission's tracker as Fink & Shoup (1994) do, and print which shares
    of the stars are identified rightly, ambiguous, unmatched or wrong, with confidence
    intervals; tolerances, size of the zone and errors may be swept.

    acquire simulate mission XTE
    acquire simulate mission mine.toml --sweep separation_deg=.01,.02 --sweep magnitude=.3:.9:.2
    acquire simulate mission XTE --identifier starid --sweep psi_deg=0:100:10 --page psi.html
    acquire simulate mission SOHO --sweep separation_deg=.0066,.02 --at-most-ambiguous 0.01
    acquire simulate mission XTE --direction 265.6,-28.9 --within 5 --json
    """
    from service.settings import Settings
    from studies.mission_rates import report
    from studies.mission_rates.report import report_json, report_text
    from studies.mission_rates.simulation import simulate

    plan = _plan(parsed, mission_of_file_or_name(parsed.mission))
    if parsed.plot is not None:
        report.checked_plot(plan, parsed.plot)
    if parsed.page is not None:
        report.checked(plan, "--page", parsed.page, ".html")
    catalog = Settings.from_environment().catalog
    rates = simulate(plan, catalog, parsed.processes, parsed.quiet)
    if parsed.plot is not None:
        report.draw(plan, rates, parsed.plot)
    if parsed.page is not None:
        report.write_page(plan, rates, parsed.at_most_ambiguous, parsed.page)
    if parsed.json:
        print_json(report_json(plan, rates, parsed.at_most_ambiguous))
    else:
        print(report_text(plan, rates, parsed.at_most_ambiguous))
        if parsed.plot is not None:
            print(f"picture: {parsed.plot}")
        if parsed.page is not None:
            print(f"page: {parsed.page}")
    return 0


def _plan(parsed: Namespace, mission: Any) -> Any:
    from studies.mission_rates.simulation import (
        Plan,
        Sweep,
        one_tracker,
        options_of_settings,
        refuse_idle,
        settings_of,
    )

    if parsed.seed < 0:
        raise BadInput(Fault("--seed", "must not be negative", str(parsed.seed)))
    if parsed.within is not None and not (parsed.direction and 0 <= parsed.within <= 180):
        message = "must be from 0 to 180, beside a --direction"
        raise BadInput(Fault("--within", message, shown_value(parsed.within)))
    sweeps = [Sweep.parsed(text) for text in parsed.sweep]
    tests = dict.fromkeys(parsed.without, False) | dict.fromkeys(parsed.with_, True)
    options = options_of_settings(sweeps, tests)
    used = IDENTIFIERS[mission.identifier].uses
    of_votes = used is not None and not options.keys() <= used
    identifier = parsed.identifier or (VOTES if of_votes else mission.identifier)
    if identifier not in IN_ZONES:
        message = f"{mission.name} identifies by {identifier}, which uses no zone; give one of "
        raise BadInput(Fault("--identifier", message + ", ".join(IN_ZONES), identifier))
    switched = {"tests": mission.tests.model_copy(update=tests)}
    single = one_tracker(mission.model_copy(update=switched), parsed.tracker)
    refuse_idle(options, single, identifier)
    return Plan(
        settings=tuple(settings_of(single, sweeps)),
        identifier=identifier,
        tests=tests,
        direction_deg=parsed.direction,
        within_deg=180.0 if parsed.direction is None else (parsed.within or 0.0),
        zones=-(-parsed.stars // (parsed.views * parsed.stars_per_view)),
        views=parsed.views,
        most_stars=parsed.stars_per_view,
        seed=parsed.seed,
    )


def _direction(text: str) -> tuple[float, float]:
    try:
        ra_deg, dec_deg = map(float, text.split(","))
    except ValueError:
        ra_deg, dec_deg = 0.0, 100.0
    if not (-360.0 <= ra_deg <= 360.0 and -90.0 <= dec_deg <= 90.0):
        message = f"must be right ascension and declination in degrees, RA,DEC (got {text!r})"
        raise ArgumentTypeError(message)
    return ra_deg, dec_deg


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0.0 < share < 1.0:
        raise ArgumentTypeError(f"must be a share above 0 and below 1 (got {text!r})")
    return share


PTP_HELP = """\
tables by name, each algorithm on the same fields (10 deg square, stars to V 6):
  ptp-1       projections of the nine printed triangles
  ptp-2       the k-vector of the projections
  ptp-3       the sharing stars of the four printed triangles
  figure-6    triangles on the projection axis
  figure-7    projection and index of the triangles
  ptp-5       slave stars of the guide database: memory, rate, time
  ptp-6       PTP, P-vector, planar triangle, Liebe's triangles, pyramid at 1 px, 0.5 mag
  figure-10   stars in the field of view; the paper's figure cannot be reproduced
  figure-11   rate against the stars in the field
  figure-12   rate against the noise of position
  figure-13   rate against the noise of magnitude
  ptp-false   mirrored skies and random points that PTP accepts
  ptp         all of these
strict: all stars that the algorithm names are correct, at least three; checked: the
same after the attitude check of the identifier `ptp`."""


def _add_paper(group: Any) -> None:
    parser = add_command(
        group, "paper", _run_paper, notes=PTP_HELP, first="--table --stars --seed --report"
    )
    parser.add_argument(
        "--table",
        type=_table,
        metavar="N|NAME",
        help="2 to 14 (default: all of these), or a name",
    )
    parser.add_argument(
        "--stars",
        type=count,
        metavar="N",
        help="minimum number of stars per run; default 20000",
    )
    parser.add_argument(
        "--scenes",
        type=count,
        metavar="N",
        help="named tables: fields per condition; default 10000",
    )
    parser.add_argument("--seed", type=int, nargs="+", metavar="S", help="default 1")
    _add_json_file(parser, "the rates, one row per run,")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="write the figures")
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write everything to a page instead of printing it",
    )
    parser.add_argument(
        "--identifier",
        choices=IN_ZONES,
        nargs="+",
        default=IN_ZONES,
        metavar="NAME",
        help=f"{', '.join(IN_ZONES)}; default all of these",
    )
    parser.add_argument("--processes", type=count, metavar="N", help="default: one per core")


def _run_paper(parsed: Namespace) -> int:
    """Repeat the experiments of a paper and compare its tables with our results: Fink & Shoup 1994
    by table number, Zhou & Ye 2015 (PTP, lost in space) by table name.

    acquire simulate paper --table 3 --stars 2000
    acquire simulate paper --table ptp-6 --scenes 2000 --seed 7
    acquire simulate paper --table ptp --plots docs/plots --report docs/ptp.md
    acquire simulate paper --json rates.json
    acquire simulate paper --table 3 --stars 2000 --json
    acquire simulate paper --identifier starid --seed 1 2 3 --plots docs/plots --report paper.md
    acquire simulate paper --identifier verified --report verified.md
    """
    if isinstance(parsed.table, str):
        return _run_ptp(parsed)
    if parsed.scenes is not None:
        raise BadInput(
            Fault(
                "--scenes", "goes with a table by name, such as --table ptp-6", str(parsed.scenes)
            )
        )
    from studies.paper_1994.command import DEFAULT_STARS, PROPORTIONS, TIMES, run_paper

    if parsed.stars is not None and parsed.table in (*TIMES, *PROPORTIONS):
        message = f"has no effect on table {parsed.table}, whose zones are as many as the paper's"
        raise BadInput(Fault("--stars", message, str(parsed.stars)))
    prints_json = parsed.json == STANDARD_OUTPUT
    rows = run_paper(
        parsed.table,
        parsed.stars or DEFAULT_STARS,
        parsed.seed or [1],
        None if prints_json else parsed.json,
        parsed.identifier,
        processes=parsed.processes,
        plots=parsed.plots,
        report_path=parsed.report,
        out=io.StringIO() if prints_json else None,
    )
    if prints_json:
        print_json(rows)
    return 0


def _run_ptp(parsed: Namespace) -> int:
    from studies.ptp_2015.command import DEFAULT_SCENES, rows_of, run_ptp
    from studies.ptp_2015.tables import OF_PROJECTIONS

    if parsed.stars is not None:
        message = "goes with a table by number; a named one takes --scenes"
        raise BadInput(Fault("--stars", message, str(parsed.stars)))
    if parsed.table in OF_PROJECTIONS:
        message = f"has no effect on {parsed.table}, for which nothing is drawn"
        for option, value in (("--scenes", parsed.scenes), ("--seed", parsed.seed)):
            if value is not None:
                raise BadInput(Fault(option, message, shown_value(value)))
    seeds = parsed.seed or [1]
    if len(seeds) > 1:
        raise BadInput(Fault("--seed", "is one with a table by name", shown_value(seeds)))
    prints_json = parsed.json == STANDARD_OUTPUT
    found = run_ptp(
        parsed.table,
        parsed.scenes or DEFAULT_SCENES,
        seeds[0],
        None if prints_json else parsed.json,
        parsed.processes,
        parsed.plots,
        parsed.report,
        io.StringIO() if prints_json else None,
    )
    if prints_json:
        print_json(rows_of(found))
    return 0


def _table(text: str) -> int | str:
    """Parse the number of a printed table, or a name such as ptp-5."""
    return count(text) if text.lstrip("-").isdigit() else text


def _add_imaging(group: Any) -> None:
    parser = add_command(group, "imaging", _run_imaging)
    parser.add_argument(
        "--row", nargs="+", default=[], metavar="IM-N", help="IM-1 to IM-11; default all"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--quick", action="store_true", help="small samples and coarser grids")
    _add_json_file(parser, "the claims with their figures")
    parser.add_argument(
        "--plots", type=Path, metavar="FOLDER", help="write the figures (needs matplotlib)"
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write everything to a page instead of printing it",
    )


def _run_imaging(parsed: Namespace) -> int:
    """Compare every claim of the star image detection report with a measurement: crosses of wire
    meshes, correlation, estimation, scans and their noise, pattern constants.

    acquire simulate imaging --row IM-4
    acquire simulate imaging --seed 7 --json claims.json
    acquire simulate imaging --plots docs/plots --report docs/imaging.md
    """
    from studies.star_image_report.command import as_json, run_imaging

    prints_json = parsed.json == STANDARD_OUTPUT
    rows = run_imaging(
        parsed.row,
        parsed.seed,
        parsed.quick,
        json_path=None if prints_json else parsed.json,
        plots_folder=parsed.plots,
        report_path=parsed.report,
        out=io.StringIO() if prints_json else None,
    )
    if prints_json:
        print(as_json(rows), end="")
    return 0 if all(row.holds for row in rows) else 1

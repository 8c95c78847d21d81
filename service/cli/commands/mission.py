"""Command `acquire mission`: create, check and show mission files."""

import time
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.errors import BadConfiguration, BadInput, Fault, shown_value

if TYPE_CHECKING:
    from service.mission_checks.zone_estimate import ZoneEstimate
    from service.missions.mission import Mission


SECONDS, LEAST_SECONDS = 7.0, 2.0
"""CPU time in seconds for a check with simulated views, and the least part for the simulation."""
NOTES = """\
The exit code is 1 if the file has an error. Unusual settings are allowed, but rarely intended.
Stars and pairs are counted for zones all over the sky; the map shows the pairs."""


def add(commands: Any) -> None:
    """Declare the command `mission` with its subcommands."""
    group = arguments.add_group(
        commands,
        "mission",
        "Mission files: write one, check what it can expect, show every value.",
        "acquire mission check missions/mine.toml",
    )
    parser = arguments.add_command(group, "check", check, notes=NOTES)
    parser.add_argument("file", type=Path, metavar="FILE.toml", help=arguments.FILE_OR_NAME)
    parser.add_argument(
        "--epoch", type=float, metavar="YEAR", help="of the run catalog; default: this year"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="OUT.svg", help="draw the zones and their pairs, as SVG"
    )
    arguments.add_json(parser, "findings and counts")
    add_estimate(group)
    _add_new(group)
    parser = arguments.add_command(group, "show", show)
    parser.add_argument("mission", metavar="MISSION", help=arguments.FILE_OR_NAME)


def _add_new(group: Any) -> None:
    parser = arguments.add_command(group, "new", new)
    parser.add_argument("name", nargs="?", metavar="NAME", help="name of the spacecraft")
    for flag, metavar, text in (
        ("field", "FIELD", "field of view in degrees: WIDTHxHEIGHT, or the radius of a round one"),
        ("sigma", "ARCSEC", "error of a star's position along each axis, one sigma"),
        ("limit", "MAG", "the faintest star that the tracker sees"),
        ("boresight", "AXIS", "body axis of the boresight: x, -x, ..., or X,Y,Z; default z"),
    ):
        help_text = f"{text}; once for each tracker"
        parser.add_argument(f"--{flag}", action="append", metavar=metavar, help=help_text)
    parser.add_argument(
        "--a-priori-error",
        metavar="DEG",
        help="largest error of the a priori attitude about each axis; without it, and without "
        "--sun-axis, the mission is lost in space",
    )
    parser.add_argument(
        "--sun-axis", metavar="AXIS", help="body axis on the Sun, if only that direction is known"
    )
    parser.add_argument("--identifier", metavar="NAME", help="default: verified")


def new(parsed: Namespace) -> int:
    """Print a short mission file with comments; without a name on a terminal, ask for its values.

    acquire mission new MYCUBE --field 8x8 --sigma 5 --limit 6.5 --a-priori-error 0.5 > my.toml
    acquire mission new > my.toml
    acquire mission new TWO --field 8x8 --sigma 5 --limit 6.5 --boresight z --boresight=-x > 2.toml
    acquire mission new SUNNY --field 4 --sigma 3 --limit 8 --boresight z --sun-axis x > sunny.toml
    """
    import sys

    from service.cli.mission_files import asked, new_text
    from service.missions.mission import parse_mission

    if parsed.name is None and sys.stdin.isatty():
        parsed = asked(parsed)
    text = new_text(parsed)
    mission = parse_mission(text, "the new mission")
    print(text, end="")
    print(
        f"next: acquire mission check FILE.toml (the file of {mission.name}); "
        "missions are looked for in ./missions/*.toml",
        file=sys.stderr,
    )
    return 0


def show(parsed: Namespace) -> int:
    """Print a whole mission as TOML, with the origin of each value: given in the file, derived from
    other values by a rule, or the default.

    acquire mission show mine.toml
    acquire mission show XTE
    """
    from service.cli.mission_files import whole_text

    mission, path = arguments.mission_and_file(parsed.mission)
    print(whole_text(mission, path))
    return 0


def check(parsed: Namespace) -> int:
    """Tell what is wrong with a mission file and what is unusual, what the mission can expect in
    clear and in dense sky, and draw its zones with the number of their stars and pairs.

    acquire mission check mine.toml
    acquire mission check mine.toml --picture zones.svg
    acquire mission check mine.toml --epoch 2030 --json
    """
    from service.cli.charts import zones_picture
    from service.cli.mission_report import (
        examined,
        refusals,
        report_json,
        report_text,
        with_expectation,
    )
    from service.missions.mission import read_mission
    from service.settings import Settings
    from service.sky.catalog.star_catalog import open_catalog

    begun = time.process_time()
    if parsed.file.suffix != ".toml" and not parsed.file.exists():
        parsed.file = arguments.mission_and_file(str(parsed.file))[1]
    # Raise for a missing file, which is no faulty mission file.
    parsed.file.open("rb").close()
    try:
        mission = read_mission(parsed.file)
    except BadConfiguration as error:
        found = refusals(error, parsed.file)
        if parsed.json:
            arguments.print_json({"file": str(parsed.file), "findings": found})
        else:
            for each in found:
                print(f"wrong     {each['key']}: {each['text']}")
        return 1
    catalog = open_catalog(Settings.from_environment().catalog)
    report = examined(mission, catalog, parsed.epoch)
    report = with_expectation(
        report, catalog, max(LEAST_SECONDS, SECONDS - time.process_time() + begun)
    )
    if parsed.picture is not None and report.zones:
        parsed.picture.write_text(zones_picture(report), encoding="utf-8")
    if parsed.json:
        arguments.print_json({"file": str(parsed.file), **report_json(report)})
    else:
        print(report_text(report))
        if parsed.picture is not None and report.zones:
            print(f"picture: {parsed.picture}")
        if report.zones:
            print(
                f"next: acquire simulate telemetry --spacecraft {parsed.file} --batches 100 "
                "--nominal pass.ndjson"
            )
    return 1 if any(each.level == "wrong" for each in report.findings) else 0


ESTIMATE_NOTES = """\
Stars are counted, pairs predicted: all pairs of the zone's stars times the share of them that are
no farther apart than the largest separation, by place and shape of the zone. "counted" is the most
pairs that a zone anywhere in the sky holds. The bound is that of Fink & Shoup (1994), equation 1:
the share of the areas (k_g, equation 2) of all pairs of the most stars that any zone has. It is a
bound for stars spread evenly; the text names the zones that exceed it.
Memory is that of the largest zone as the service caches it, grown by the zone's grid."""


def add_estimate(group: Any) -> None:
    """Declare the command `mission estimate`."""
    parser = arguments.add_command(group, "estimate", estimate, notes=ESTIMATE_NOTES)
    parser.add_argument(
        "mission", metavar="MISSION", help="the name of a spacecraft, or a mission file (.toml)"
    )
    parser.add_argument(
        "--size",
        type=float,
        nargs="+",
        metavar="DEG",
        help="radius of a cap, half width of a band; default: the mission's",
    )
    parser.add_argument(
        "--pair-separation-max",
        type=float,
        nargs="+",
        metavar="DEG",
        help="largest separation of a pair; default: the mission's",
    )
    parser.add_argument(
        "--magnitude-limit",
        type=float,
        nargs="+",
        metavar="MAG",
        help="of the run catalog; default: the mission's",
    )
    parser.add_argument(
        "--epoch", type=float, metavar="YEAR", help="of the run catalog; default: this year"
    )
    arguments.add_json(parser, "the estimates")


def estimate(parsed: Namespace) -> int:
    """Predict the stars, pairs and memory of a mission's zones over the whole sky before one is
    built, for one or more sizes, largest separations and limits of magnitude.

    acquire mission estimate mine.toml
    acquire mission estimate XTE --size 6 8 10.66 15
    acquire mission estimate SOHO --magnitude-limit 7 8 --pair-separation-max 2 4 --json
    """
    from service.cli.mission_report import epoch_of
    from service.mission_checks.zone_estimate import neighbours_of, zone_estimates
    from service.settings import Settings
    from service.sky.catalog.run_catalog import build_run_catalog
    from service.sky.catalog.star_catalog import open_catalog

    mission = arguments.mission_of_file_or_name(parsed.mission)
    epoch_year = mission.catalog.epoch_of(epoch_of(parsed.epoch))
    size_key = "half_width_deg" if mission.zone.kind == "band" else "radius_deg"
    # Check all arguments before the first count.
    limited = [
        _changed(mission, "catalog", "magnitude_limit_mag", each, "--magnitude-limit")
        for each in parsed.magnitude_limit or [mission.catalog.magnitude_limit_mag]
    ]
    separations = parsed.pair_separation_max or [mission.tolerances.pair_separation_max_deg]
    name = "pair_separation_max_deg"
    paired = [
        _changed(mission, "tolerances", name, each, "--pair-separation-max").tolerances
        for each in separations
    ]
    zones = [
        _changed(mission, "zone", size_key, each, "--size").zone
        for each in parsed.size or [getattr(mission.zone, size_key)]
    ]
    catalog = open_catalog(Settings.from_environment().catalog)
    found = []
    for of_catalog in limited:
        run_catalog = build_run_catalog(catalog, of_catalog.catalog, epoch_year)
        if len(run_catalog) == 0:
            message = "leaves no star in the run catalog"
            limit_mag = of_catalog.catalog.magnitude_limit_mag
            raise BadInput(Fault("--magnitude-limit", message, shown_value(limit_mag)))
        for tolerances in paired:
            near = neighbours_of(run_catalog.direction, tolerances.pair_separation_max_deg)
            for zone in zones:
                update = {"tolerances": tolerances, "zone": zone}
                sized = of_catalog.model_copy(update=update)
                found += zone_estimates(sized, run_catalog, near)
    if parsed.json:
        rows = [asdict(each) for each in found]
        arguments.print_json({"mission": mission.name, "epoch_year": epoch_year, "zones": rows})
    else:
        print(_text(mission, epoch_year, found))
    return 0


def _changed(mission: "Mission", table: str, key: str, value: float, option: str) -> "Mission":
    """Mission with one changed setting; raises `BadInput` naming the option of a bad value."""
    from pydantic import ValidationError

    from service.missions.faults import plain_message

    old: Any = getattr(mission, table)
    try:
        new = type(old).model_validate({**old.model_dump(), key: value})
    except ValidationError as error:
        message = plain_message(error.errors()[0])
        raise BadInput(Fault(option, message, shown_value(value))) from None
    return mission.model_copy(update={table: new})


def _text(mission: "Mission", epoch_year: float, found: "list[ZoneEstimate]") -> str:
    from service.cli.markdown import markdown
    from service.sky.geometry.pairs import MAX_PAIRS

    header = (
        *("zone", "separation", "to mag", "stars, least", "median", "most", "pairs, least"),
        *("median", "most", "counted", "share", "of areas", "bound", "memory, most"),
    )
    rows = [tuple(_cells(each).values()) for each in found]
    lines = [
        f"{mission.name}: zones with their axis anywhere in the sky, run catalog of {epoch_year:g}",
        "",
        markdown(header, rows),
    ]
    richest = dict.fromkeys(
        f"{each.of} about RA {each.richest_deg[0]:.2f}, Dec {each.richest_deg[1]:+.2f} deg"
        for each in found
    )
    lines += ["counted: pairs of the richest zone: " + "; ".join(richest)]
    exceeding = dict.fromkeys(each.of for each in found if each.pairs_counted > each.pairs_bound)
    if exceeding:
        lines.append(f"counted exceeds the bound: {'; '.join(exceeding)}")
    if any(each.pairs_counted > MAX_PAIRS for each in found):
        lines.append(f"A zone of more than {MAX_PAIRS:,} pairs is refused.")
    return "\n".join(lines)


def _cells(each: "ZoneEstimate") -> Mapping[str, str]:
    stars, pairs = each.stars, each.pairs
    return {
        "zone": each.of,
        "hmax": f"{each.pair_separation_max_deg:g}",
        "limit": f"{each.magnitude_limit_mag:g}",
        **{f"stars {k}": f"{v:,}" for k, v in asdict(stars).items()},
        **{f"pairs {k}": f"{v:,}" for k, v in asdict(pairs).items()},
        "counted": f"{each.pairs_counted:,}",
        "k_g": f"{each.k_g:.4f}",
        "k_g_areas": f"{each.k_g_areas:.4f}",
        "bound": f"{each.pairs_bound:,}",
        "memory": f"{each.most_bytes / 1e6:.2f} MB",
    }

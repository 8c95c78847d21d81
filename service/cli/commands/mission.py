"""`acquire mission`: mission files, for their authors."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli import mission_estimate
from service.cli.arguments import add_command, add_group, add_json, print_json
from service.errors import BadConfiguration

NOTES = """\
The exit code is 1 if the file has an error. Unusual settings are allowed, but rarely intended.
Stars and pairs are counted for zones all over the sky; the map shows the pairs."""


def add(commands: Any) -> None:
    """Declare the command."""
    group = add_group(
        commands,
        "mission",
        "Mission files: check one before the service uses it, and estimate its zones.",
        "acquire mission check missions/mine.toml",
    )
    parser = add_command(
        group,
        "check",
        "Tell what is wrong with a mission file and what is unusual, and draw its zones with "
        "the number of their stars and pairs.",
        """
        acquire mission check mine.toml
        acquire mission check mine.toml --picture zones.svg
        acquire mission check mine.toml --epoch 2030 --json
        """,
        check,
        NOTES,
    )
    parser.add_argument("file", type=Path, metavar="FILE.toml")
    parser.add_argument(
        "--epoch", type=float, metavar="YEAR", help="of the run catalog; default: this year"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="OUT.svg", help="draw the zones and their pairs, as SVG"
    )
    add_json(parser, "findings and counts")
    mission_estimate.add(group)


def check(parsed: Namespace) -> int:
    """Print what is wrong and unusual, and the zones; 1 where something is wrong."""
    from service.cli.charts import zones_picture
    from service.cli.mission_report import examined, refusals, report_json, report_text
    from service.missions.mission import read_mission
    from service.settings import Settings
    from service.sky.catalog.star_catalog import open_catalog

    # A file that is not there is no mission file at all.
    parsed.file.open("rb").close()
    try:
        mission = read_mission(parsed.file)
    except BadConfiguration as error:
        found = refusals(error, parsed.file)
        if parsed.json:
            print_json({"file": str(parsed.file), "findings": found})
        else:
            for each in found:
                print(f"wrong     {each['key']}: {each['text']}")
        return 1
    catalog = open_catalog(Settings.from_environment().catalog)
    report = examined(mission, catalog, parsed.epoch)
    if parsed.picture is not None and report.zones:
        parsed.picture.write_text(zones_picture(report), encoding="utf-8")
    if parsed.json:
        print_json({"file": str(parsed.file), **report_json(report)})
    else:
        print(report_text(report))
        if parsed.picture is not None and report.zones:
            print(f"picture: {parsed.picture}")
    return 1 if any(each.level == "wrong" for each in report.findings) else 0

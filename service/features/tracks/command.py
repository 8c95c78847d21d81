"""Command `acquire tracks`: moving objects, planets and hot pixels among unmatched stars."""

from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import Any

from service.cli import arguments
from service.errors import BadInput, Fault


def add(commands: Any) -> None:
    """Declare the command `tracks` and its options."""
    parser = arguments.add_command(commands, "tracks", run)
    parser.add_argument("spacecraft", metavar="SPACECRAFT", help=arguments.MISSION)
    arguments.add_period(parser, "the run to use; default live")
    parser.add_argument(
        "--format",
        choices=("text", "json", "tdm"),
        default="text",
        help="text for people (the default), JSON, or the moving tracks as a CCSDS TDM",
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="write the TDM to OUT; default: print it"
    )
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Link the unmatched stars of recorded batches to tracks: objects that move on the sky,
    planets, and hot pixels, which keep their place on the detector.  Changes nothing.

    acquire tracks XTE --start 1999-060T00:00:00Z --end 1999-060T01:00:00Z
    acquire tracks XTE --run night-3 --format tdm --output night-3.tdm
    """
    from service.app.factory import open_app
    from service.features.tracks.part import Tracks
    from service.features.tracks.text import tracks_text

    if parsed.output is not None and parsed.format != "tdm":
        raise BadInput(Fault("--output", "is for --format tdm alone"))
    start, end = arguments.period_of(parsed)
    with closing(open_app(arguments.settings_of_existing(parsed), reads_only=True)) as app:
        tracks = app.part(Tracks)
        found = tracks.of_period(parsed.spacecraft, run=parsed.run, start=start, end=end)
        if parsed.format == "tdm":
            arguments.written_to(parsed.output, tracks.tdm(found))
        elif parsed.format == "json":
            arguments.print_json(found)
        else:
            print(tracks_text(found))
    return 0

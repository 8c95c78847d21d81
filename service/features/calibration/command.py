"""Command `acquire calibrate`: alignment, distortion and clocks from recorded batches."""

from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.cli.arguments import period_of, progress_bar, settings_of_existing
from service.errors import BadInput, Fault, shown_value

if TYPE_CHECKING:
    from service.features.calibration.estimates import CalibrationRun

RECORDED_BY = "acquire calibrate"
"""Author under which the command records a calibration."""


def add(commands: Any) -> None:
    """Declare the command `calibrate` and its options."""
    parser = arguments.add_command(
        commands, "calibrate", run, first="--run --start --end --output --record"
    )
    parser.add_argument("spacecraft", metavar="SPACECRAFT", help=arguments.MISSION)
    arguments.add_period(parser, "the run to use; default live")
    parser.add_argument(
        "--tracker",
        action="append",
        default=[],
        metavar="NAME",
        help="calibrate this tracker; may be repeated; default all of the mission",
    )
    parser.add_argument(
        "--degree",
        type=int,
        metavar="N",
        help="degree of the distortion, 0 for none; default: chosen by cross-validation",
    )
    parser.add_argument(
        "--time-tag",
        action="store_true",
        help="estimate by how much each tracker but the first measured its stars later than the "
        "batch says",
    )
    parser.add_argument(
        "--sample",
        type=arguments.count,
        default=2000,
        metavar="N",
        help="maximum number of batches to use, taken from the whole period; default 2000",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.toml",
        help="write the mission file with alignment, scale, distortion and magnitudes corrected",
    )
    parser.add_argument(
        "--record",
        action="store_true",
        help="record the result as the spacecraft's next version, to be tried and adopted",
    )
    arguments.add_json(parser, "the result")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Estimate, from the identified stars of recorded batches, the alignment between trackers, and
    each tracker's scale, distortion, magnitudes and time tags, with sigmas.  Name the unknowns
    that these stars cannot determine.  Write a mission file with the result, or record it for
    the console, where an operator can adopt it.  Change nothing that is in use.

    acquire calibrate TWOHEADS
    acquire calibrate TWOHEADS --run commissioning --output twoheads-new.toml
    acquire calibrate TWOHEADS --record
    acquire calibrate TWOHEADS --start 1999-060T00:00:00Z --degree 3 --time-tag --json
    """
    from service.app.factory import open_app
    from service.features.calibration.estimates import CalibrationRequest
    from service.features.calibration.part import Calibrations
    from service.features.calibration.text import calibration_json, calibration_text
    from service.missions.mission import mission_named

    start, end = period_of(parsed)
    wanted = CalibrationRequest(
        parsed.spacecraft,
        run=parsed.run,
        start=start,
        end=end,
        trackers=parsed.tracker,
        degree=parsed.degree,
        time_tag=parsed.time_tag,
        sample=parsed.sample,
    )
    recorded = None
    with closing(open_app(settings_of_existing(parsed), reads_only=not parsed.record)) as app:
        wanted.require(mission_named(app.missions, parsed.spacecraft), "--tracker")
        with progress_bar("batches", "running again", parsed.quiet, leave=True) as bar:
            result = app.part(Calibrations).of_spacecraft(
                wanted, lambda done, total: bar(bar.done + 1, total)
            )
        if parsed.record:
            recorded = app.part(Calibrations).record(wanted, result, RECORDED_BY)
    if parsed.json:
        arguments.print_json(calibration_json(result))
    else:
        print(calibration_text(result))
        if recorded is not None:
            print(f"\nRecorded as version {recorded.version}, {recorded.id}")
    if parsed.output is not None:
        _write_mission(parsed, result)
    return 0


def _write_mission(parsed: Namespace, result: "CalibrationRun") -> None:
    from service.features.calibration.mission_file import calibrated_mission_text

    source = _mission_file(parsed)
    if parsed.output.exists() and parsed.output.samefile(source):
        message = "is the mission file in use; name another file, and put it in its place later"
        raise BadInput(Fault("--output", message, shown_value(str(parsed.output))))
    before = source.read_text(encoding="utf-8-sig")
    text = calibrated_mission_text(
        before, str(source), result.found, result.mission, result.calibrated_magnitudes
    )
    parsed.output.write_text(text, encoding="utf-8")
    if not parsed.json:
        print(f"\n{parsed.output}: {source} with what was calibrated")


def _mission_file(parsed: Namespace) -> Path:
    """Path of a spacecraft's mission file; a site's file takes precedence over a shipped one."""
    return arguments.mission_and_file(parsed.spacecraft)[1]

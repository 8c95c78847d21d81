"""`acquire replay`: send files of batches through the service."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import (
    LOCAL,
    add_command,
    add_database,
    add_json,
    count,
    print_json,
    speed,
)
from service.cli.configuration import settings_of
from service.errors import BadInput, Fault, shown_value

DEFAULT_CONCURRENCY = 4
CSV_HELP = """\
CSV files have a header and one star per row; consecutive rows with the same
(spacecraft, run, batch) form a batch.  Cells may be empty.  Columns, as in the JSON:
  spacecraft batch run time frame aberration options
  q1 q2 q3 qc boresight_ra_deg boresight_dec_deg sun_pointed
  rate_x_deg_per_s rate_y_deg_per_s rate_z_deg_per_s
  velocity_x_km_per_s velocity_y_km_per_s velocity_z_km_per_s
  position_x_km position_y_km position_z_km sun_vector_x sun_vector_y sun_vector_z
  tracker x y z h_deg v_deg magnitude time_offset_s sigma_arcsec
spacecraft, batch, time, tracker, and x y z or h_deg v_deg are required."""


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "replay",
        "Send files of batches (NDJSON, or CSV if the name ends in .csv) to the service.  You "
        "can send a file twice: batches that are already recorded are not recorded again.",
        """
        acquire replay pass.ndjson
        acquire replay pass.csv --in-process --run trial --results answers.ndjson
        acquire replay pass.ndjson --alarms            and raise alarms for the run
        acquire replay pass.ndjson --speed 60          one minute of telemetry per second
        acquire replay pass.ndjson --carry-attitude    use each attitude as the next a priori
        acquire replay pass.ndjson --a-priori xte.aem  use the attitudes of a file as a priori
        """,
        run,
        CSV_HELP,
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help=".csv is CSV, else NDJSON"
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--url", default=LOCAL, help=f"the service; default {LOCAL}")
    way.add_argument(
        "--in-process",
        action="store_true",
        help="process the files in this process, without a server",
    )
    parser.add_argument(
        "--run", help="the run for every batch; default: the first file's name without its ending"
    )
    parser.add_argument("--alarms", action="store_true", help="raise alarms for the run")
    parser.add_argument(
        "--results",
        type=Path,
        metavar="OUT.ndjson",
        help="write one answer per line, in input order",
    )
    parser.add_argument(
        "--speed",
        type=speed,
        default=None,
        metavar="FACTOR|max",
        help="multiple of real time, by the batch times; default max",
    )
    parser.add_argument(
        "--concurrency",
        type=count,
        metavar="N",
        help="post batch by batch, N at a time; --results (default 4) and --speed also post "
        "batch by batch. Without these options the service receives whole files, which is "
        "faster",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--a-priori",
        type=Path,
        metavar="FILE",
        help="set each batch's a_priori to the attitude that a file gives for its time: an AEM "
        "(KVN or XML), or a C-kernel; other batches keep their own",
    )
    source.add_argument(
        "--carry-attitude",
        action="store_true",
        help="set each batch's a_priori to the last good attitude of the same spacecraft, "
        "propagated with the body rates; one batch at a time",
    )
    parser.add_argument(
        "--progress", action="store_true", help="show the progress bar even without a terminal"
    )
    add_json(parser, "the counts")
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Send files through the service and print what became of them."""
    from service.observations.readers.telemetry import require_telemetry
    from service.products.reading.files import read_attitudes
    from service.replay.carry_attitude import AttitudeCarrier
    from service.replay.file_prior import FilePrior
    from service.replay.items import Pace, items_of, run_name
    from service.replay.summary import ReplaySummary

    run = run_name(parsed.files, parsed.run)
    for file in parsed.files:
        # A file that is missing or is no telemetry is refused before anything is sent.
        require_telemetry(file)
        if parsed.results is not None and parsed.results.resolve() == file.resolve():
            raise BadInput(Fault("--results", "must not be a file that is replayed", str(file)))
    items, pace = items_of(parsed.files, run), Pace(parsed.speed)
    prior = None
    if parsed.a_priori is not None:
        prior = FilePrior(read_attitudes(parsed.a_priori, "--a-priori"))
        items = map(prior.prepared, items)
    progress = True if parsed.progress else None
    carrier = AttitudeCarrier() if parsed.carry_attitude else None
    if parsed.in_process:
        from service.app.factory import open_app
        from service.replay.in_process import replay_in_process

        app = open_app(settings_of(parsed))
        try:
            app.service.ready()
            if parsed.alarms:
                app.runs.watch(run)
            with ReplaySummary(parsed.files, parsed.results, progress) as summary:
                replay_in_process(app, items, summary.add, pace, carrier)
        finally:
            app.close()
    else:
        from service.replay.bulk_upload import replay_in_bulk
        from service.replay.over_http import replay_over_http

        if parsed.database is not None:
            message = "goes with --in-process; a running service has its own"
            raise BadInput(Fault("--database", message, shown_value(parsed.database)))
        token = settings_of(parsed).token
        with ReplaySummary(parsed.files, parsed.results, progress) as summary:
            watched = run if parsed.alarms else None
            if carrier or prior or parsed.results or parsed.speed or parsed.concurrency:
                # Each batch needs an answer of its own, or is sent at its own time.
                many = parsed.concurrency or DEFAULT_CONCURRENCY
                replay_over_http(
                    parsed.url,
                    items,
                    summary.add,
                    pace,
                    many,
                    token=token,
                    watched_run=watched,
                    carrier=carrier,
                )
            else:
                replay_in_bulk(
                    parsed.url,
                    parsed.files,
                    run,
                    summary.add,
                    summary.follow,
                    token=token,
                    query={"alarms": "true"} if parsed.alarms else None,
                )
    if parsed.json:
        given = {} if prior is None else {"a_priori_from_file": prior.given}
        print_json({"run": run, **summary.counts(), **given})
    else:
        print(f"{'run':<20}{run}")
        print(summary.table())
        if prior is not None:
            print(f"{'a priori of file':<20}{prior.given:,} batches")
    return 1 if summary.refused else 0

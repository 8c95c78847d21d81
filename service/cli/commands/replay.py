"""Command `acquire replay`: send files of telemetry to the service."""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.cli.arguments import service_url, settings_of
from service.errors import BadFile, BadInput, Fault, shown_value
from service.feature import feature_modules

if TYPE_CHECKING:
    from service.replay.items import AttitudeCarrier, FromFile, Item, OtherFiles, Pace
    from service.replay.summary import ReplaySummary

DEFAULT_CONCURRENCY = 4


def add(commands: Any) -> None:
    """Declare the command `replay`."""
    parser = arguments.add_command(
        commands, "replay", run, first="--run --url --in-process --results --formats"
    )
    parser.add_argument(
        "files", nargs="*", type=Path, metavar="FILE", help=".csv and .tsv are CSV, else NDJSON"
    )
    parser.add_argument(
        "--formats",
        nargs="?",
        const="",
        metavar="NAME",
        help="print the list of input formats; with NAME its fields, and an example",
    )
    arguments.add_url_or_in_process(parser)
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
        type=arguments.speed,
        default=None,
        metavar="FACTOR|max",
        help="multiple of real time, by the batch times; default max",
    )
    parser.add_argument(
        "--concurrency",
        type=arguments.count,
        metavar="N",
        help="post batch by batch, N at a time; --results (default 4) and --speed also post "
        "batch by batch. Without these options the service receives whole files, which is "
        "faster",
    )
    _add_knowledge(parser)
    parser.add_argument(
        "--progress", action="store_true", help="show the progress bar even without a terminal"
    )
    arguments.add_json(parser, "the counts")
    arguments.add_database(parser)


def _add_knowledge(parser: ArgumentParser) -> None:
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--a-priori",
        type=Path,
        metavar="FILE",
        help="set each batch's a_priori to the attitude that a file gives for its time: an AEM "
        "or ACM (KVN or XML), a C-kernel, or CSV as `acquire export` writes; batches without one "
        "in the file keep their own",
    )
    arguments.add_object(parser)
    source.add_argument(
        "--carry-attitude",
        action="store_true",
        help="set each batch's a_priori to the last good attitude of the same spacecraft, "
        "propagated with the body rates; one batch at a time",
    )
    parser.add_argument(
        "--ephemeris",
        type=Path,
        metavar="FILE",
        help="set velocity_km_per_s and position_km of batches that lack them to those that a file "
        "gives for their time: an OEM (KVN or XML), an OMM, or two-line element sets (TLE)",
    )


def run(parsed: Namespace) -> int:
    """Send files of batches and gyro blocks (NDJSON, or CSV if the name ends in .csv or .tsv) to
    the service.  You can send a file twice: nothing is recorded twice.

    acquire replay pass.ndjson
    acquire replay pass.csv --in-process --run trial --results answers.ndjson
    acquire replay pass.ndjson --alarms            and raise alarms for the run
    acquire replay pass.ndjson --speed 60          one minute of telemetry per second
    acquire replay pass.ndjson --carry-attitude    use each attitude as the next a priori
    acquire replay pass.ndjson --a-priori xte.aem  use the attitudes of a file as a priori
    acquire replay pass.ndjson --ephemeris xte.oem  use the velocities of a file
    acquire replay --packets pass.dat --xtce mission.xml     CCSDS space packets
    acquire replay --formats csv                   the columns of CSV files, and an example
    """
    if parsed.formats is not None:
        print(_formats_text(parsed.formats))
        return 0
    from service.replay.items import AttitudeCarrier, Pace, items_of, run_name
    from service.replay.summary import ReplaySummary

    other = _other_files(parsed)
    files = _checked_files(parsed, other)
    run = run_name(files, parsed.run)
    pace = Pace(parsed.speed)
    in_bulk = _is_in_bulk(parsed)
    items = items_of(files, run) if other is None or in_bulk else other.items(run)
    sources = _sources(parsed)
    for source in sources:
        items = map(source.prepared, items)
    sized = files if other is None else []
    progress = True if parsed.progress else None
    carrier = AttitudeCarrier() if parsed.carry_attitude else None
    if parsed.in_process:
        from service.app.factory import open_app
        from service.replay.in_process import replay_in_process

        with closing(open_app(settings_of(parsed))) as app:
            app.service.ready()
            if parsed.alarms:
                app.runs.watch(run)
            with ReplaySummary(sized, parsed.results, progress) as summary:
                replay_in_process(app, items, summary.add, pace, carrier)
    else:
        if parsed.database is not None:
            message = "goes with --in-process; a running service has its own"
            raise BadInput(Fault("--database", message, shown_value(parsed.database)))
        with ReplaySummary(sized, parsed.results, progress) as summary:
            if in_bulk:
                _send_files(parsed, files if other is None else other, run, summary)
            else:
                _send_batches(parsed, items, run, summary, pace, carrier)
    if other is not None and not in_bulk:
        summary.packets = other.counts()
    _print_counts(run, summary, sources, parsed.json)
    if not parsed.json and summary.batches:
        print(f"{'next':<20}{_next_step(parsed, run)}")
    return 1 if summary.refused else 0


def _send_files(
    parsed: Namespace, files: "Sequence[Path] | OtherFiles", run: str, summary: "ReplaySummary"
) -> None:
    from service.replay.over_http import replay_in_bulk

    replay_in_bulk(
        service_url(parsed),
        files,
        run,
        summary.add,
        summary.follow,
        token=settings_of(parsed).token,
        alarms=parsed.alarms,
    )


def _send_batches(
    parsed: Namespace,
    items: "Iterable[Item]",
    run: str,
    summary: "ReplaySummary",
    pace: "Pace",
    carrier: "AttitudeCarrier | None",
) -> None:
    from service.replay.over_http import replay_over_http

    replay_over_http(
        service_url(parsed),
        items,
        summary.add,
        pace,
        parsed.concurrency or DEFAULT_CONCURRENCY,
        token=settings_of(parsed).token,
        watched_run=run if parsed.alarms else None,
        carrier=carrier,
    )


def _formats_text(name: str) -> str:
    """List of the input formats, or the description of one with an example."""
    from service.observations.input_formats import input_format, input_formats

    if name:
        shown = input_format(name)
        parts = f"{shown.title}: {shown.holds}", f"acquire replay {shown.given}", shown.notes
        return "\n\n".join((*parts, f"Example:\n\n{shown.example}") if shown.example else parts)
    rows = [
        f"{key:<14}{each.given:<28}{each.title}: {each.holds}"
        for key, each in input_formats().items()
    ]
    return "\n".join((*rows, "", "acquire replay --formats NAME prints its fields, and an example"))


def _next_step(parsed: Namespace, run: str) -> str:
    """Next step after a replay: the address of the run in the console, and how to serve it."""
    page = f"{service_url(parsed)}/?run={run}"
    if not parsed.in_process:
        return page
    return f"acquire serve --database {settings_of(parsed).database}, then open {page}"


def _print_counts(
    run: str, summary: "ReplaySummary", sources: Sequence["FromFile"], as_json: bool
) -> None:
    if as_json:
        supplied = {source.key: source.supplied for source in sources}
        arguments.print_json({"run": run, **summary.counts(), **supplied})
        return
    print(f"{'run':<20}{run}")
    print(summary.table())
    for source in sources:
        print(f"{source.title:<20}{source.supplied:,} batches")


def _sources(parsed: Namespace) -> list["FromFile"]:
    from service.ephemerides.files import read_attitudes, read_ephemeris
    from service.replay.items import FileEphemeris, FilePrior

    sources: list[FromFile] = []
    if parsed.object is not None and parsed.a_priori is None:
        message = "names the object of --a-priori FILE, which is missing"
        raise BadInput(Fault("--object", message, shown_value(parsed.object)))
    if parsed.a_priori is not None:
        sources.append(FilePrior(read_attitudes(parsed.a_priori, "--a-priori", parsed.object)))
    if parsed.ephemeris is not None:
        sources.append(FileEphemeris(read_ephemeris(parsed.ephemeris, "--ephemeris")))
    return sources


def _is_in_bulk(parsed: Namespace) -> bool:
    """True if files can be uploaded whole, as no option requires answers or timing by batch."""
    return not (
        parsed.in_process
        or parsed.carry_attitude
        or parsed.a_priori
        or parsed.ephemeris
        or parsed.results
        or parsed.speed
        or parsed.concurrency
    )


def _other_files(parsed: Namespace) -> "OtherFiles | None":
    """Telemetry files in another format than lines, if options name any; otherwise None.

    Raises `BadInput` unless files of exactly one format are given.
    """
    from service.observations.input_formats import input_formats

    off = settings_of(parsed).features_off
    modules, formats = feature_modules("telemetry", off), input_formats(off)
    found = [each for each in (module.files_of(parsed) for module in modules) if each is not None]
    if len(found) + bool(parsed.files) != 1:
        hints = "".join(f", or else {formats[module.FORMAT].given}" for module in modules)
        message = f"is required{hints} (see `acquire replay --help`)"
        raise BadInput(Fault("FILE", message))
    return found[0] if found else None


def _checked_files(parsed: Namespace, other: "OtherFiles | None") -> Sequence[Path]:
    """Check the files to send; raises for a missing file and for one without telemetry."""
    from service.observations.telemetry import require_telemetry

    files: Sequence[Path] = parsed.files if other is None else other.files
    for file in files:
        if other is None:
            require_telemetry(file)
        elif not file.is_file():
            raise BadFile(Fault(str(file), "is not there, or is no file"))
        if parsed.results is not None and parsed.results.resolve() == file.resolve():
            raise BadInput(Fault("--results", "must not be a file that is replayed", str(file)))
    return files

"""One function a command: what it imports, does, prints, and its exit code."""

import dataclasses
import gc
import sys
from argparse import Namespace
from contextlib import ExitStack
from typing import TYPE_CHECKING

from service import __version__
from service.cli.passes import pass_of
from service.errors import BadInput, Fault, NotAvailable, shown_value
from service.settings import Settings

MAX_PROBLEMS = 100

if TYPE_CHECKING:
    from service.missions.mission import Mission
    from service.sky.catalog import Catalog
    from service.sky.run_catalog import RunCatalog
    from service.times import Utc


DEFAULT_CONCURRENCY = 4


def settings_of(parsed: Namespace) -> Settings:
    """The environment's settings with the command's own in their place."""
    given = {
        name: value
        for name in ("database", "host", "port")
        if (value := getattr(parsed, name, None)) is not None
    }
    return dataclasses.replace(Settings.from_environment(), **given)


def _settings_of_existing(parsed: Namespace) -> Settings:
    """`settings_of` a command that needs records; raises `BadConfiguration` where there are none.

    To open a SQLite file that is not there would create it.
    """
    from service.records.database import require_records

    settings = settings_of(parsed)
    require_records(settings.database)
    return settings


def version(parsed: Namespace) -> int:
    """Print the version."""
    print(f"acquire {__version__}")
    return 0


def serve(parsed: Namespace) -> int:
    """Serve until told to stop."""
    # What is loaded on the way stays: to look through it for what does not, again and again,
    # takes a sixth of the start.  Once it is ready the service looks again.
    gc.disable()
    settings = settings_of(parsed)
    from service import logs
    from service.backend.start import start_backend
    from service.web.ports import require_free

    require_free(settings.host, settings.port)
    logs.configure(settings.logs, "front")

    # It loads its part while this process loads the server.
    started = start_backend(settings)
    from service.web.server import serve as serve_forever

    serve_forever(settings, started)
    return 0


def demo(parsed: Namespace) -> int:
    """Serve and replay sample passes."""
    from service.demo import run_demo

    return run_demo(
        folder=parsed.folder,
        settings=settings_of(parsed),
        batches=parsed.batches,
        seed=parsed.seed,
        once=parsed.once,
    )


def replay(parsed: Namespace) -> int:
    """Send files through the service and print what became of them."""
    from service.observe.formats import require_telemetry
    from service.replay.carrying import Carrier
    from service.replay.items import Pace, items_of, run_name
    from service.replay.tally import Tally

    run = run_name(parsed.files, parsed.run)
    for file in parsed.files:
        # A file that is missing or is no telemetry is refused before anything is sent.
        require_telemetry(file)
        if parsed.results is not None and parsed.results.resolve() == file.resolve():
            raise BadInput(Fault("--results", "must not be a file that is replayed", str(file)))
    items, pace = items_of(parsed.files, run), Pace(parsed.speed)
    progress = True if parsed.progress else None
    carrier = Carrier() if parsed.carry_attitude else None
    if parsed.in_process:
        from service.operations import Operations
        from service.replay.in_process import replay_in_process

        operations = Operations.open(settings_of(parsed))
        try:
            operations.ready()
            if parsed.alarms:
                operations.watch_run(run)
            with Tally(parsed.files, parsed.results, progress) as tally:
                replay_in_process(operations, items, tally.add, pace, carrier)
        finally:
            operations.close()
    else:
        from service.replay.in_bulk import replay_in_bulk
        from service.replay.over_http import replay_over_http

        if parsed.database is not None:
            message = "goes with --in-process; a running service has its own"
            raise BadInput(Fault("--database", message, shown_value(parsed.database)))
        token = settings_of(parsed).token
        with Tally(parsed.files, parsed.results, progress) as tally:
            watched = run if parsed.alarms else None
            if carrier or parsed.results or parsed.speed or parsed.concurrency:
                # Single answers are asked for, one by one or at their time.
                many = parsed.concurrency or DEFAULT_CONCURRENCY
                replay_over_http(
                    parsed.url,
                    items,
                    tally.add,
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
                    tally.add,
                    tally.follow,
                    token=token,
                    query={"alarms": "true"} if parsed.alarms else None,
                )
    print(f"{'run':<20}{run}")
    print(tally.table())
    return 1 if tally.refused else 0


def advise(parsed: Namespace) -> int:
    """Print what recorded batches say of a mission's settings."""
    import json

    from tqdm import tqdm

    from service.advice.report import as_text
    from service.missions.mission import load_missions, mission_named
    from service.observe.wire import tolerances_from_text
    from service.operations import Operations

    start, end = _stretch_of(parsed)
    tolerances = tolerances_from_text(parsed.tolerance, "--try")
    mission_named(load_missions(settings_of(parsed).missions), parsed.spacecraft)
    operations = Operations.open(_settings_of_existing(parsed))
    try:
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:
            row = operations.advise(
                parsed.spacecraft,
                run=parsed.run,
                start=start,
                end=end,
                sample=parsed.sample,
                tolerances=tolerances,
                step=bar.update,
            )
    finally:
        operations.close()
    print(json.dumps(row, ensure_ascii=False, indent=1) if parsed.json else as_text(row))
    return 0


def reprocess(parsed: Namespace) -> int:
    """Run recorded batches again into another run, and print how both compare."""
    import json

    from tqdm import tqdm

    from service.cli.compared import comparison_text
    from service.missions.mission import load_missions, mission_named, read_mission
    from service.operations import Operations, checked_run_name
    from service.records.reprocess import Progress, require_other_run
    from service.records.served import unserved

    start, end = _stretch_of(parsed)
    mission = None if parsed.mission is None else read_mission(parsed.mission)
    spacecraft = parsed.spacecraft
    if mission is not None:
        spacecraft = spacecraft or mission.name
        if spacecraft != mission.name:
            message = f"is of {mission.name}, and only batches of {spacecraft} are asked for"
            raise BadInput(Fault("--mission", message, str(parsed.mission)))
    elif spacecraft is not None:
        mission_named(load_missions(settings_of(parsed).missions), spacecraft)
    if parsed.run is not None:
        require_other_run(checked_run_name(parsed.run), parsed.source)
    settings = _settings_of_existing(parsed)
    with ExitStack() as held:
        held.enter_context(unserved(settings.database))
        operations = Operations.open(settings, mission)
        held.callback(operations.close)
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:

            def step(progress: Progress) -> None:
                bar.total = progress.total
                bar.update(progress.before + progress.recorded + progress.refused - bar.n)

            progress, compared = operations.reprocess(
                parsed.run,
                source=parsed.source,
                spacecraft=spacecraft,
                start=start,
                end=end,
                processes=parsed.processes or 0,
                step=step,
            )
    for refusal in progress.refusals:
        print(f"refused: {refusal}", file=sys.stderr)
    if parsed.json:
        counts = {
            name: getattr(progress, name) for name in ("total", "before", "recorded", "refused")
        }
        print(json.dumps(counts | compared, indent=1))
    else:
        print(comparison_text(progress, compared))
    return 1 if progress.refused else 0


def catalog_build(parsed: Namespace) -> int:
    """Build the embedded catalog, where its build is at hand."""
    try:
        from catalogs.build import HERE, build
    except ModuleNotFoundError as missing:
        if missing.name == "pyarrow":
            message = "needs the packages of `pip install 'attitude-acquisition[catalog-build]'`"
        else:
            message = (
                "works in a checkout only: an installed service has the catalog, not its build"
            )
        raise NotAvailable(Fault("catalog build", message)) from None
    output = parsed.output or HERE / "stars.npz"
    print(build(parsed.packages, output, lambda text: print(text, file=sys.stderr)))
    return 0


def catalog_import(parsed: Namespace) -> int:
    """Check a site's catalog and store it."""
    from tqdm import tqdm

    from service.sky.catalog import form_of, import_csv, import_sky2000, save

    # Of night.dat.gz the name is night.
    name = parsed.file.name.removesuffix(".gz").rpartition(".")[0] or parsed.file.name
    output = parsed.output or parsed.file.with_name(f"{name}.npz")
    left_out: tuple[str, ...] = ()
    if (parsed.format or form_of(parsed.file)) == "sky2000":
        with tqdm(unit=" stars", desc="reading", disable=None, leave=False) as bar:
            catalog, left_out = import_sky2000(parsed.file, bar.update)
    else:
        catalog = import_csv(parsed.file)
    save(catalog, output)
    print(f"{output}: {len(catalog)} stars")
    if left_out:
        shown = ", ".join(left_out[:5]) + (", ..." if len(left_out) > 5 else "")
        print(f"left out: {len(left_out)} stars that have no visual magnitude ({shown})")
    print(f"use it with ACQUIRE_CATALOG={output}")
    return 0


def catalog_export(parsed: Namespace) -> int:
    """Write a run catalog."""
    from service.sky.run_catalog import export_csv

    run_catalog = _run_catalog(parsed)
    export_csv(run_catalog, parsed.output)
    print(f"{parsed.output}: {len(run_catalog)} stars, epoch {run_catalog.epoch_year:g}")
    return 0


def catalog_rejected(parsed: Namespace) -> int:
    """Write what a run catalog leaves out."""
    from service.sky.run_catalog import export_rejected_csv

    run_catalog = _run_catalog(parsed)
    export_rejected_csv(run_catalog, parsed.output)
    rejected = len(run_catalog.rejected)
    print(f"{parsed.output}: {rejected} stars left out, epoch {run_catalog.epoch_year:g}")
    return 0


def simulate_telemetry(parsed: Namespace) -> int:
    """Draw a pass and write it with its truth."""
    from service.simulate.files import truth_path, write_pass
    from service.simulate.telemetry import draw_pass
    from service.sky.shelf import Shelf
    from service.sky.view import Sky

    wanted = pass_of(parsed)
    mission, catalog = _mission_and_catalog(parsed.spacecraft)
    count = write_pass(draw_pass(mission, Sky(catalog, Shelf(64 << 20)), wanted), parsed.output)
    print(f"{parsed.output}: {count} batches of {mission.name}; truth: {truth_path(parsed.output)}")
    return 0


def frame(parsed: Namespace) -> int:
    """Send frames and print what was made of them."""
    from service.cli.frames import send_frames

    return send_frames(parsed, settings_of(parsed))


def simulate_frames(parsed: Namespace) -> int:
    """Draw frames and write them with what is known and what is true of them."""
    from service.cli.frames import write_drawn

    return write_drawn(parsed, *_mission_and_catalog(parsed.spacecraft))


def simulate_paper(parsed: Namespace) -> int:
    """Fly the experiments of a paper and print its tables."""
    if isinstance(parsed.table, str):
        return _simulate_ptp(parsed)
    if parsed.scenes is not None:
        raise BadInput(
            Fault(
                "--scenes", "goes with a table by name, such as --table ptp-6", str(parsed.scenes)
            )
        )
    from service.simulate.paper.command import DEFAULT_STARS, run_paper

    run_paper(
        parsed.table,
        parsed.stars or DEFAULT_STARS,
        parsed.seed,
        parsed.json,
        parsed.identifier,
        processes=parsed.processes,
        plots=parsed.plots,
        report_path=parsed.report,
    )
    return 0


def simulate_imaging(parsed: Namespace) -> int:
    """Hold the star image detection report beside what is measured; 1 where a claim is off."""
    from service.simulate.imaging.command import run_imaging

    rows = run_imaging(
        parsed.row,
        parsed.seed,
        parsed.quick,
        json_path=parsed.json,
        plots_folder=parsed.plots,
        report_path=parsed.report,
    )
    return 0 if all(row.holds for row in rows) else 1


def _simulate_ptp(parsed: Namespace) -> int:
    from service.simulate.ptp.command import DEFAULT_SCENES, run_ptp

    if parsed.stars is not None:
        message = "goes with a table by number; a named one takes --scenes"
        raise BadInput(Fault("--stars", message, str(parsed.stars)))
    if len(parsed.seed) > 1:
        raise BadInput(Fault("--seed", "is one with a table by name", shown_value(parsed.seed)))
    run_ptp(
        parsed.table,
        parsed.scenes or DEFAULT_SCENES,
        parsed.seed[0],
        parsed.json,
        parsed.processes,
        parsed.plots,
        parsed.report,
    )
    return 0


def database_upgrade(parsed: Namespace) -> int:
    """Bring the schema up to date."""
    from service.records.database import upgrade

    upgrade(settings_of(parsed).database)
    print("the schema is up to date")
    return 0


def database_check(parsed: Namespace) -> int:
    """Tell how the schema differs from the code."""
    from service.records.database import check, check_fresh

    differences = check_fresh() if parsed.fresh else check(settings_of(parsed).database)
    for difference in differences:
        print(difference if len(difference) <= 120 else difference[:119] + "…")
    if not differences:
        print("the schema is that of the code")
    return 1 if differences else 0


def token_create(parsed: Namespace) -> int:
    """Make a token and print it."""
    from service.cli.tokens import create

    return create(
        settings_of(parsed), parsed.name, parsed.scope, parsed.spacecraft, parsed.days, parsed.rate
    )


def token_list(parsed: Namespace) -> int:
    """Print every token."""
    from service.cli.tokens import show

    return show(_settings_of_existing(parsed))


def token_revoke(parsed: Namespace) -> int:
    """End a token."""
    from service.cli.tokens import revoke

    return revoke(_settings_of_existing(parsed), parsed.name)


def database_backup(parsed: Namespace) -> int:
    """Copy the database."""
    from tqdm import tqdm

    from service.records.backup import back_up

    with tqdm(total=None, unit=" pages", desc="copying", disable=None, leave=False) as bar:

        def step(left: int, total: int) -> None:
            bar.total = total
            bar.update(total - left - bar.n)

        back_up(settings_of(parsed).database, parsed.output, step)
    print(f"{parsed.output}: {parsed.output.stat().st_size} bytes")
    return 0


def database_verify(parsed: Namespace) -> int:
    """Tell what is wrong with the database."""
    from tqdm import tqdm

    from service.records.verify import verify

    seen = 0
    with tqdm(total=None, unit=" batches", desc="reading", disable=None, leave=False) as bar:

        def step(done: int, total: int) -> None:
            nonlocal seen
            bar.total = total
            bar.update(done - seen)
            seen = done

        problems = verify(settings_of(parsed).database, step)
    for problem in problems[:MAX_PROBLEMS]:
        print(problem)
    if len(problems) > MAX_PROBLEMS:
        print(f"and {len(problems) - MAX_PROBLEMS} more")
    if not problems:
        print(f"nothing is wrong with {seen} batches")
    return 1 if problems else 0


def database_prune(parsed: Namespace) -> int:
    """Delete old batches."""
    from tqdm import tqdm

    from service.records.prune import Pruned, prune
    from service.records.store import Store
    from service.times import parse_utc

    before = parse_utc(parsed.before, "--before")
    store = Store(_settings_of_existing(parsed).database, create=False)
    try:
        with tqdm(total=None, unit=" batches", desc="deleting", disable=None, leave=False) as bar:

            def step(pruned: Pruned) -> None:
                bar.total = pruned.total
                bar.update(pruned.batches - bar.n)

            pruned = prune(store, before, parsed.run, dry_run=parsed.dry_run, step=step)
    finally:
        store.close()
    if parsed.dry_run:
        print(f"{pruned.total} batches are before {before.text}; nothing was deleted")
    else:
        print(f"{pruned.batches} batches before {before.text} were deleted")
    return 0


def openapi(parsed: Namespace) -> int:
    """Print, write or check the API's description."""
    from service.web.openapi import openapi_yaml

    text = openapi_yaml()
    if parsed.output is not None:
        parsed.output.write_text(text, encoding="utf-8")
    elif parsed.check is None:
        print(text, end="")
    elif parsed.check.read_text(encoding="utf-8") != text:
        print(f"{parsed.check} is not what the service describes: run `make openapi`")
        return 1
    return 0


def _stretch_of(parsed: Namespace) -> "tuple[Utc | None, Utc | None]":
    """The times that --from and --to name; raises `BadInput` where they cross."""
    from service.times import parse_utc

    start = None if parsed.start is None else parse_utc(parsed.start, "--from")
    end = None if parsed.end is None else parse_utc(parsed.end, "--to")
    if start is not None and end is not None and start.tai_ns > end.tai_ns:
        raise BadInput(Fault("--to", "must not be before --from", shown_value(parsed.end)))
    return start, end


def _mission_and_catalog(name: str) -> "tuple[Mission, Catalog]":
    from service.missions.mission import load_missions, mission_named
    from service.sky.catalog import open_catalog

    settings = Settings.from_environment()
    mission = mission_named(load_missions(settings.missions), name)
    return mission, open_catalog(settings.catalog)


def _run_catalog(parsed: Namespace) -> "RunCatalog":
    from service.sky.run_catalog import build_run_catalog
    from service.times import FIRST_YEAR, LAST_YEAR

    if not FIRST_YEAR <= parsed.epoch <= LAST_YEAR + 1:
        message = f"must be from {FIRST_YEAR} to {LAST_YEAR + 1}, as the time of a batch"
        raise BadInput(Fault("--epoch", message, shown_value(parsed.epoch)))
    mission, catalog = _mission_and_catalog(parsed.spacecraft)
    epoch_year = mission.catalog.epoch_of(parsed.epoch)
    return build_run_catalog(catalog, mission.catalog, epoch_year)

"""One function a command: what it imports, does, prints, and its exit code."""

import dataclasses
import sys
from argparse import Namespace
from typing import TYPE_CHECKING

from service import __version__
from service.cli.passes import pass_of
from service.errors import BadInput, Fault, NotAvailable, shown_value
from service.settings import Settings

if TYPE_CHECKING:
    from service.missions.mission import Mission
    from service.sky.catalog import Catalog
    from service.sky.run_catalog import RunCatalog


def settings_of(parsed: Namespace) -> Settings:
    """The environment's settings with the command's own in their place."""
    given = {
        name: value
        for name in ("database", "host", "port")
        if (value := getattr(parsed, name, None)) is not None
    }
    return dataclasses.replace(Settings.from_environment(), **given)


def version(parsed: Namespace) -> int:
    """Print the version."""
    print(f"acquire {__version__}")
    return 0


def serve(parsed: Namespace) -> int:
    """Serve until told to stop."""
    from service.web.server import serve as serve_forever

    serve_forever(settings_of(parsed))
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
    from service.observe.formats import read_lines
    from service.replay.items import Pace, items_of, run_name
    from service.replay.tally import Tally

    run = run_name(parsed.files, parsed.run)
    for file in parsed.files:
        # A file that is missing or has a bad header is refused before anything is sent.
        next(iter(read_lines(file)), None)
        if parsed.results is not None and parsed.results.resolve() == file.resolve():
            raise BadInput(Fault("--results", "must not be a file that is replayed", str(file)))
    items, pace = items_of(parsed.files, run), Pace(parsed.speed)
    progress = True if parsed.progress else None
    if parsed.in_process:
        from service.operations import Operations
        from service.replay.in_process import replay_in_process

        operations = Operations.open(settings_of(parsed))
        try:
            operations.ready()
            with Tally(parsed.files, parsed.results, progress) as tally:
                replay_in_process(operations, items, tally.add, pace)
        finally:
            operations.close()
    else:
        from service.replay.over_http import replay_over_http

        if parsed.database is not None:
            message = "goes with --in-process; a running service has its own"
            raise BadInput(Fault("--database", message, shown_value(parsed.database)))
        with Tally(parsed.files, parsed.results, progress) as tally:
            replay_over_http(parsed.url, items, tally.add, pace, parsed.concurrency)
    print(f"{'run':<20}{run}")
    print(tally.table())
    return 1 if tally.refused else 0


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
    from service.sky.catalog import import_csv, save

    output = parsed.output or parsed.file.with_suffix(".npz")
    catalog = import_csv(parsed.file)
    save(catalog, output)
    print(f"{output}: {len(catalog)} stars")
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


def simulate_paper(parsed: Namespace) -> int:
    """Fly the paper's experiments and print its tables."""
    from service.simulate.paper.command import DEFAULT_STARS, run_paper

    run_paper(
        parsed.table,
        parsed.stars or DEFAULT_STARS,
        parsed.seed,
        parsed.json,
        processes=parsed.processes,
        plots=parsed.plots,
        report_path=parsed.report,
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

"""Command `acquire catalog`: build, import and export star catalogs."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.arguments import MISSION, add_command, add_group, mission_and_catalog
from service.errors import BadInput, Fault, NotAvailable, shown_value

if TYPE_CHECKING:
    from service.sky.catalog.run_catalog import RunCatalog


def add(commands: Any) -> None:
    """Declare the command `catalog` with its subcommands."""
    group = add_group(
        commands,
        "catalog",
        "Star catalogs: build the embedded one, import your own, export run catalogs.",
        """
        acquire catalog import skymap.csv skymap.npz
        acquire catalog export --spacecraft XTE --epoch 1996 xte-1996.csv
        """,
    )
    parser = add_command(group, "build", build)
    parser.add_argument(
        "packages",
        type=Path,
        nargs="?",
        default=Path("packages"),
        help="folder with the source packages; default: ./packages",
    )
    parser.add_argument("output", type=Path, nargs="?", help="default: the file in the checkout")
    parser = add_command(group, "import", import_catalog)
    parser.add_argument("file", type=Path, metavar="FILE", help="SKY2000 may be compressed by gzip")
    parser.add_argument(
        "output", type=Path, nargs="?", metavar="OUT.npz", help="default: FILE's name with .npz"
    )
    parser.add_argument(
        "--format", choices=("csv", "sky2000"), help="default: recognised from the first bytes"
    )
    parser.add_argument(
        "--epoch",
        type=float,
        metavar="YEAR",
        help="Julian year of the positions of a CSV file without a column epoch, such as 2016.0 "
        "(Gaia) or 1991.25 (Hipparcos); default 2000.0",
    )
    for function in (export, rejected):
        parser = add_command(group, function.__name__, function)
        parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
        parser.add_argument(
            "--epoch",
            required=True,
            type=float,
            metavar="YEAR",
            help="rounded like the time of a batch: to a whole year for the shipped missions",
        )
        parser.add_argument("output", type=Path, metavar="OUT.csv")


def build(parsed: Namespace) -> int:
    """Build the embedded catalog from its source packages (only in a checkout).

    acquire catalog build
    acquire catalog build downloads/ stars.npz
    """
    try:
        from catalogs.build import HERE
        from catalogs.build import build as build_catalog
    except ModuleNotFoundError as missing:
        if missing.name == "pyarrow":
            message = "needs the packages of `pip install 'attitude-acquisition[catalog-build]'`"
        else:
            message = (
                "works in a checkout only: an installed service has the catalog, not its build"
            )
        raise NotAvailable(Fault("catalog build", message)) from None
    output = parsed.output or HERE / "stars.npz"
    print(build_catalog(parsed.packages, output, lambda text: print(text, file=sys.stderr)))
    return 0


def import_catalog(parsed: Namespace) -> int:
    """Check your own catalog and convert it for the service: CSV (id, ra_deg, dec_deg, magnitude),
    or fixed-width records of SKYMAP's SKY2000 (CDS V/109), whose numbers become the stars' ids.

    acquire catalog import skymap.csv
    acquire catalog import gaia.csv --epoch 2016.0
    acquire catalog import sky2kv4.dat.gz skymap.npz
    ACQUIRE_CATALOG=skymap.npz acquire serve
    """
    from tqdm import tqdm

    from service.sky.catalog.csv_file import FIRST_EPOCH, LAST_EPOCH
    from service.sky.catalog.star_catalog import catalog_format, import_csv, import_sky2000, save

    # The name of night.dat.gz is night.
    name = parsed.file.name.removesuffix(".gz").rpartition(".")[0] or parsed.file.name
    output = parsed.output or parsed.file.with_name(f"{name}.npz")
    left_out: tuple[str, ...] = ()
    if parsed.epoch is not None and not FIRST_EPOCH <= parsed.epoch <= LAST_EPOCH:
        message = f"must be from {FIRST_EPOCH:g} to {LAST_EPOCH:g}, such as 2016.0"
        raise BadInput(Fault("--epoch", message, shown_value(parsed.epoch)))
    if (parsed.format or catalog_format(parsed.file)) == "sky2000":
        with tqdm(unit=" stars", desc="reading", disable=None, leave=False) as bar:
            catalog, left_out = import_sky2000(parsed.file, bar.update)
    else:
        epoch_year = 2000.0 if parsed.epoch is None else parsed.epoch
        catalog = import_csv(parsed.file, epoch_year)
        print(f"epoch of positions: {epoch_year}, unless a column epoch says another")
    save(catalog, output)
    print(f"{output}: {len(catalog)} stars")
    if left_out:
        shown = ", ".join(left_out[:5]) + (", ..." if len(left_out) > 5 else "")
        print(f"left out: {len(left_out)} stars that have no visual magnitude ({shown})")
    print(f"use it with ACQUIRE_CATALOG={output}")
    return 0


def export(parsed: Namespace) -> int:
    """Write the run catalog of an epoch: exactly the stars that the identifier uses.

    acquire catalog export --spacecraft SOHO --epoch 1996 used.csv
    """
    from service.sky.catalog.run_catalog import export_csv

    run_catalog = _run_catalog(parsed)
    export_csv(run_catalog, parsed.output)
    print(f"{parsed.output}: {len(run_catalog)} stars, epoch {run_catalog.epoch_year:g}")
    return 0


def rejected(parsed: Namespace) -> int:
    """Write the stars that a run catalog rejects, with the reasons.

    acquire catalog rejected --spacecraft SOHO --epoch 1996 rejected.csv
    """
    from service.sky.catalog.run_catalog import export_rejected_csv

    run_catalog = _run_catalog(parsed)
    export_rejected_csv(run_catalog, parsed.output)
    count = len(run_catalog.rejected)
    print(f"{parsed.output}: {count} stars left out, epoch {run_catalog.epoch_year:g}")
    return 0


def _run_catalog(parsed: Namespace) -> "RunCatalog":
    from service.sky.catalog.run_catalog import build_run_catalog
    from service.times import FIRST_YEAR, LAST_YEAR

    if not FIRST_YEAR <= parsed.epoch <= LAST_YEAR + 1:
        message = f"must be from {FIRST_YEAR} to {LAST_YEAR + 1}, as the time of a batch"
        raise BadInput(Fault("--epoch", message, shown_value(parsed.epoch)))
    mission, catalog = mission_and_catalog(parsed.spacecraft)
    epoch_year = mission.catalog.epoch_of(parsed.epoch)
    return build_run_catalog(catalog, mission.run_catalog_settings, epoch_year)

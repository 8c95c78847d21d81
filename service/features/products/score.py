"""Command `acquire score`: compare recorded attitudes with true ones from a file."""

from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import Any

from service.cli import arguments
from service.cli.arguments import period_of, settings_of_existing, written_to
from service.errors import BadInput, Fault, shown_value

_BAR = 48


def add(commands: Any) -> None:
    """Declare the command `score` and its options."""
    parser = arguments.add_command(
        commands,
        "score",
        run,
        first="--run --plot",
        notes="Between two records of the truth the body is taken to turn at a constant rate. "
        "Attitudes\noutside its segments are counted and left out.",
    )
    parser.add_argument("truth", type=Path, metavar="FILE", help="the true attitudes")
    arguments.add_object(parser)
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    arguments.add_period(parser, "the run that is read; default live")
    parser.add_argument(
        "--status", choices=("good", "suspect", "all"), default="good", help="default good"
    )
    parser.add_argument("--plot", type=Path, metavar="OUT.svg", help="draw the errors as SVG")
    arguments.add_json(parser, "the statistics and the histogram")
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Compare recorded attitudes with true ones: an AEM or ACM, a C-kernel, or CSV. Prints the
    errors about each body axis, and whether the covariances fit them.

    acquire score truth.aem --spacecraft XTE --run pass-7
    acquire score truth.bc --spacecraft XTE --plot errors.svg --json
    """
    from service.app.factory import open_app
    from service.ephemerides.acm import TRUE_BASES
    from service.ephemerides.files import read_attitudes
    from service.features.products.error_chart import errors_picture
    from service.features.products.part import Products
    from service.features.products.scoring import errors_of, statistics

    start, end = period_of(parsed)
    truth = read_attitudes(parsed.truth, "FILE", parsed.object).of_basis(TRUE_BASES)
    if not truth.segments:
        message = f"must be of attitudes with ATT_BASIS {', '.join(filter(None, TRUE_BASES))}"
        raise BadInput(Fault("FILE", message, shown_value(str(parsed.truth))))
    with closing(open_app(settings_of_existing(parsed), reads_only=True)) as app:
        series = app.part(Products).attitudes(
            parsed.spacecraft, run=parsed.run, start=start, end=end, status=parsed.status
        )
        errors = errors_of(series.blocks, truth)
    if not len(errors.time_ns):
        asked = f"{errors.outside} {series.about.described()}"
        message = f"has no attitude for the time of any of {asked}"
        raise BadInput(Fault("FILE", message, shown_value(str(parsed.truth))))
    found = statistics(errors)
    if parsed.plot is not None:
        written_to(parsed.plot, iter([errors_picture(errors, series.about.described()).encode()]))
    if parsed.json:
        arguments.print_json({"truth": str(parsed.truth), "spacecraft": parsed.spacecraft, **found})
    else:
        print(_table(found))
    return 0


def _table(found: dict[str, Any]) -> str:
    names = ("mean", "std", "rms", "predicted_rms", "median", "p95", "p99", "max")
    rows = {**{f"about {axis}": each for axis, each in found["axes"].items()}}
    rows["total"] = found["total"]
    head = "arcsec".ljust(10) + "".join(name.replace("_", " ").rjust(15) for name in names)
    lines = [
        f"{found['attitudes']:,} attitudes; {found['outside_truth']:,} outside the truth",
        head,
    ]
    for title, each in rows.items():
        cells = (each.get(f"{name}_arcsec") for name in names)
        shown = ("" if value is None else f"{value:.4g}" for value in cells)
        lines.append(title.ljust(10) + "".join(cell.rjust(15) for cell in shown))
    mean = found["normalized"]["mean"]
    lines.append(f"normalized error (e^T P^-1 e): mean {mean:.3g}; 3 if the covariances are right")
    lines += _bars(found["histogram"])
    return "\n".join(lines)


def _bars(histogram: dict[str, Any]) -> list[str]:
    """Histogram of errors about each axis as rows of characters, four bins per row."""
    edges = histogram["edges_arcsec"]
    lines = []
    for axis in ("x", "y", "z"):
        counts = histogram[axis]
        rows = [(edges[k], sum(counts[k : k + 4])) for k in range(0, len(counts), 4)]
        most = max(count for _, count in rows)
        lines.append(f"errors about {axis}, arcsec")
        lines += [
            f"{edge:>12.4g}  {'#' * round(_BAR * count / most):<{_BAR}} {count:,}"
            for edge, count in rows
        ]
    return lines

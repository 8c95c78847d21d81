"""Command `acquire smooth`: filter and smooth recorded attitudes, and record the results."""

from argparse import Namespace
from contextlib import closing
from typing import Any

from service.cli import arguments
from service.cli.arguments import period_of, progress_bar, settings_of_existing


def add(commands: Any) -> None:
    """Declare the command `smooth` and its options."""
    parser = arguments.add_command(commands, "smooth", run)
    parser.add_argument("spacecraft", metavar="SPACECRAFT", help=arguments.MISSION)
    arguments.add_period(parser, "the run that is read; default live")
    arguments.add_json(parser, "the days")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Filter and smooth the recorded attitudes of a spacecraft with its gyro, or with a
    constant-rate model where no gyro runs, and record both grades, UTC day by UTC day.  A day
    whose record has not changed is left as it is; one with later batches gets a new
    revision.  With SQLite, stop the service first.

    acquire smooth XTE
    acquire smooth XTE --start 1999-060T00:00:00Z --end 1999-067T00:00:00Z
    acquire smooth XTE --run pass-7 --json
    """
    import msgspec

    from service.app.factory import open_app
    from service.features.definitive.part import Definitive

    start, end = period_of(parsed)
    with (
        closing(open_app(settings_of_existing(parsed))) as app,
        progress_bar("days", "smoothing", parsed.quiet, leave=True) as bar,
    ):
        progress = app.part(Definitive).days.smooth(
            parsed.spacecraft,
            run=parsed.run,
            start=start,
            end=end,
            step=lambda progress: bar(progress.done, progress.total),
        )
    if parsed.json:
        days = [
            {**msgspec.to_builtins(day), "new": day.id in progress.new} for day in progress.days
        ]
        counts = {"empty": progress.empty, "archived": progress.archived}
        arguments.print_json({"days_with_batches": progress.total, **counts, "days": days})
    else:
        print(_text(progress))
    return 0


def _text(progress: Any) -> str:
    new, total = len(progress.new), len(progress.days)
    outcome = f"{new} recorded, {total - new} unchanged, {progress.empty} without an attitude"
    lines = [f"days with batches: {progress.total} ({outcome} to start from)"]
    if progress.archived:
        lines.append(
            f"left as they are: {progress.archived}, for batches about them are archived; "
            "`acquire archive restore` brings them back"
        )
    for day in progress.days:
        found, mark = day.summary, "new" if day.id in progress.new else "unchanged"
        measured = ", ".join(f"{n} {word}" for word, n in found.measurements.items() if n)
        lines.append(f"{day.day} revision {day.revision} ({mark}): {measured}")
        if any(found.gyro.values()):
            words = (f"{word.replace('_', ' ')} {n}" for word, n in found.gyro.items() if n)
            lines.append(f"  gyro: {', '.join(words)}")
        if found.nis_per_degree is not None:
            lines.append(
                f"  innovations: chi-square {found.nis_per_degree:.2f} per degree, about 1"
            )
        for each in found.stretches:
            good = ", ".join(f"{n} good {grade}" for grade, n in each.good.items())
            lines.append(
                f"  {each.start} to {each.end}: {each.model.replace('_', ' ')}, "
                f"{each.samples} samples, {good}"
            )
    return "\n".join(lines)

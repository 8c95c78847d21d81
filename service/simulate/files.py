"""Telemetry files of drawn passes, and the truth beside them."""

import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

from service.errors import BadFile, Fault
from service.observations.readers.csv_rows import write_batches_csv
from service.observations.readers.telemetry import telemetry_format
from service.observations.schema import BatchIn
from service.simulate.telemetry import DrawnBatch


def truth_path(telemetry: Path) -> Path:
    """Where the truth of a telemetry file stands: OUT.truth.ndjson beside OUT.ndjson."""
    return telemetry.with_name(f"{telemetry.stem}.truth.ndjson")


def write_pass(drawn: Iterable[DrawnBatch], telemetry: Path) -> int:
    """Write batches (NDJSON, or CSV by the name) and their truth; how many there were.

    NDJSON also gets the gyro blocks, each after its batch.
    Both files appear when they are whole: a pass cut short leaves the old ones.
    """
    count = 0

    def told() -> Iterator[DrawnBatch]:
        nonlocal count
        for each in drawn:
            truth.write(_line(each.truth))
            count += 1
            yield each

    with ExitStack() as stack:
        truth = stack.enter_context(_appearing(truth_path(telemetry)))
        out = stack.enter_context(_appearing(telemetry))
        if telemetry_format(telemetry) == "csv":
            write_batches_csv(
                (BatchIn.model_validate_json(json.dumps(each.batch)) for each in told()), out
            )
        else:
            out.writelines(_line(line) for each in told() for line in (each.batch, *each.gyro))
    return count


def read_objects(path: Path) -> Iterator[dict[str, Any]]:
    """The JSON objects of a file of the service's own making, one a line."""
    with path.open("rb") as file:
        for line in file:
            yield json.loads(line)


def _line(thing: dict[str, Any]) -> str:
    return json.dumps(thing, separators=(",", ":")) + "\n"


@contextmanager
def _appearing(path: Path) -> Iterator[TextIO]:
    part = path.with_name(path.name + ".part")
    try:
        with part.open("w", encoding="utf-8", newline="") as file:
            yield file
        part.replace(path)
    except OSError as error:
        raise BadFile(Fault(str(path), f"cannot be written: {error.strerror}")) from None
    finally:
        part.unlink(missing_ok=True)

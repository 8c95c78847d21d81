"""A year of a spacecraft is copied from SQLite to PostgreSQL and back, and is the same.

    TEST_POSTGRESQL_URL=... python -m benchmarks.speed.copying                    a batch a minute
    TEST_POSTGRESQL_URL=... python -m benchmarks.speed.copying --batches 131400   a quarter of it
    python -m benchmarks.speed.copying --record FILE ...    a record that was made before

Both copies are made by `acquire database copy`, which compares every row and verifies the copy.
`acquire export` then writes the same bytes of all three.  Seconds and memory are those of each
command; TEST_POSTGRESQL_URL names a scratch database.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.bounds import Bound, at_most
from benchmarks.report import Report
from benchmarks.speed.scale import SPACECRAFT, emptied, filled, same

BATCHES, EVERY_S = 525_600, 60.0
EXPORTED = ("batches", "stars", "attitude")
MOST_MB = 350.0
"""Greatest memory of each command in MB, independent of the length of the record."""


def measured(record: Path, postgresql: str, folder: Path) -> Report:
    """Copy a record to PostgreSQL and back, verify both copies, and export from all three."""
    urls = {
        "SQLite": f"sqlite:///{record}",
        "PostgreSQL": postgresql,
        "SQLite again": f"sqlite:///{folder / 'back.db'}",
    }
    figures: dict[str, Any] = {}
    bounds: list[Bound] = []

    def timed(what: str, *arguments: str) -> None:
        # It fails where a copy is not equal to its source, and where verifying finds a fault.
        command = [sys.executable, "-m", "benchmarks.speed.command_memory", *arguments]
        ran = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        seconds, peak_mb = ran.stdout.splitlines()[-1].split()
        figures[f"{what}, s"] = float(seconds)
        bounds.append(at_most(f"{what}: memory", float(peak_mb), MOST_MB, "MB"))

    emptied(postgresql)
    (one, *copies) = urls.items()
    for name, url in copies:
        timed(f"copy to {name}", "database", "copy", one[1], url)
        timed(f"verify {name}", "database", "verify", "--database", url)
        one = name, url
    for what in EXPORTED:
        digests = {}
        for name, url in urls.items():
            file = folder / "exported"
            wanted = ("--spacecraft", SPACECRAFT, "--database", url, "--output", str(file))
            timed(f"export {what} from {name}", "export", what, *wanted)
            with file.open("rb") as read:
                digests[name] = hashlib.file_digest(read, "sha256").hexdigest()[:16]
            figures[f"{what}: bytes"] = file.stat().st_size
            file.unlink()
        for name, digest in digests.items():
            bounds.append(same(f"{what} of {name}", digest, digests["SQLite"]))
    emptied(postgresql)
    return Report("copying", figures, bounds)


def main() -> int:
    """Command that records, copies and prints; returns 1 if a figure is out of bounds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batches", type=int, default=BATCHES)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--record", type=Path, help="made if it is not there, and kept")
    parsed = parser.parse_args()
    postgresql = os.environ["TEST_POSTGRESQL_URL"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record = parsed.record or folder / "record.db"
        figures: dict[str, Any] = {}
        if not record.exists():
            figures = filled(f"sqlite:///{record}", parsed.batches, parsed.seed, EVERY_S)
        report = measured(record, postgresql, folder)
    print(Report(report.name, figures | dict(report.figures), report.bounds).text())
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())

"""Speed of file output, compared with other programs that write the same files.

    python -m benchmarks exports           a day at 1 Hz as text; 1,000,000 batches as Parquet
    python -m benchmarks exports --quick   an hour; 20,000 batches

Text is held against brahe writing an AEM of the same attitudes, and Parquet against pyarrow
writing the same columns, both from Python's values in memory.  The export of a database is
`acquire export batches`: all of its memory counts; most of its time is that of reading the rows.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import brahe.ccsds
import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from benchmarks.bounds import Bound, at_least, at_most, equal
from benchmarks.report import Report
from benchmarks.speed.fill_database import fill
from service.ephemerides.rows import AttitudeRows
from service.features.products.attitude_formats import write_attitudes
from service.features.products.attitudes import SeriesInfo, series_of
from service.features.products.result_tables import BATCH_COLUMNS
from service.features.products.result_tables import BATCHES as BATCHES_READ
from service.table_files.formats import write_table
from service.table_files.table import Table
from service.times import parse_utc, shifted

DAY, QUICK_DAY = 86_400, 3_600
BATCHES, QUICK_BATCHES = 1_000_000, 20_000
PAGE = 2_000
ROUNDS, QUICK_ROUNDS = 3, 1
TEXTS, MOST_OF_BRAHE = ("aem", "aem-xml", "acm", "csv", "json"), 3.0
"""Text formats, and their longest time as a multiple of brahe's, which writes fewer values."""
LEAST_OF_PYARROW, MOST_MB = 0.5, 300.0
START = parse_utc("1996-01-10T00:00:00Z")


def run(quick: bool, seed: int) -> Report:
    figures: dict[str, Any] = {}
    bounds = [*_text(quick, figures), *_parquet(quick, seed, figures)]
    return Report("exports", figures, bounds)


def _text(quick: bool, figures: dict[str, Any]) -> Iterator[Bound]:
    rows = _attitudes(QUICK_DAY if quick else DAY)
    pages = [rows.taken(slice(first, first + PAGE)) for first in range(0, len(rows), PAGE)]
    about = SeriesInfo("XTE", "live", START.text, "0")

    def written(name: str) -> bytes:
        return b"".join(write_attitudes(name, series_of(about, iter(pages))))

    message = brahe.ccsds.AEM.from_str(written("aem").decode())
    ways: dict[str, Callable[[], object]] = {"brahe": lambda: message.to_string("KVN")}
    ways |= {name: lambda name=name: written(name) for name in TEXTS}  # type: ignore[misc]
    best = dict.fromkeys(ways, np.inf)
    # In rotation, so that all meet an equal load.
    for _ in range(QUICK_ROUNDS if quick else ROUNDS):
        for name, way in ways.items():
            best[name] = min(best[name], _seconds(way))
    figures["attitudes at 1 Hz"] = len(rows)
    for name, seconds in best.items():
        figures[f"{name}, s"] = seconds
    for name in TEXTS:
        yield at_most(f"{name} beside brahe", best[name] / best["brahe"], MOST_OF_BRAHE, "times")


def _parquet(quick: bool, seed: int, figures: dict[str, Any]) -> Iterator[Bound]:
    count = QUICK_BATCHES if quick else BATCHES
    with tempfile.TemporaryDirectory() as folder:
        database, file = Path(folder) / "filled.db", Path(folder) / "batches.parquet"
        # Half of the batches belong to the exported spacecraft and run.
        fill(database, 2 * count, seed, 0)
        command = [sys.executable, "-m", "benchmarks.speed.command_memory", "export", "batches"]
        command += ["--spacecraft", "XTE", "--format", "parquet", "--output", str(file)]
        command += ["--database", f"sqlite:///{database}"]
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        seconds, peak_mb = map(float, told.split())
        table = parquet.read_table(file)
        ours_s, theirs_s = _written_from_memory(table, Path(folder), quick)
        differing = _differing(file, table)
    figures["batches as Parquet"] = table.num_rows
    figures["export from the database, s"] = seconds
    figures["the same from memory, s"] = ours_s
    figures["pyarrow from memory, s"] = theirs_s
    yield equal("batches in the file", table.num_rows, count)
    yield equal("columns of float64 that DuckDB reads otherwise", differing, 0)
    yield at_least("rate beside pyarrow, from memory", theirs_s / ours_s, LEAST_OF_PYARROW, "times")
    yield at_most("memory of the command at its peak", peak_mb, MOST_MB, "MB")


def _written_from_memory(table: Any, folder: Path, quick: bool) -> tuple[float, float]:
    """Seconds that the service and pyarrow take to write the same Python values."""
    values = [table[name].to_pylist() for name in table.column_names]
    pages = [
        [column[first : first + BATCHES_READ] for column in values]
        for first in range(0, table.num_rows, BATCHES_READ)
    ]

    def ours() -> None:
        with (folder / "ours.parquet").open("wb") as file:
            for piece in write_table("parquet", Table(BATCH_COLUMNS, pages)):
                file.write(piece)

    def theirs() -> None:
        arrays = [
            pa.array(column, field.type) for column, field in zip(values, table.schema, strict=True)
        ]
        made = pa.Table.from_arrays(arrays, schema=table.schema)
        parquet.write_table(made, folder / "theirs.parquet")

    best = [np.inf, np.inf]
    for _ in range(QUICK_ROUNDS if quick else ROUNDS):
        best = [min(one, _seconds(way)) for one, way in zip(best, (ours, theirs), strict=True)]
    return best[0], best[1]


def _differing(file: Path, table: Any) -> int:
    """Number of numeric columns that DuckDB reads with differing bits."""
    import duckdb

    names = [each.name for each in table.schema if each.type == pa.float64()]
    with duckdb.connect() as connection:
        connection.execute("SET preserve_insertion_order = true")
        quoted = ", ".join(f'"{name}"' for name in names)
        theirs = connection.execute(f"SELECT {quoted} FROM '{file}'").fetchnumpy()
    return sum(
        _bits(np.ma.filled(theirs[name], np.nan)) != _bits(table[name].to_numpy()) for name in names
    )


def _bits(values: npt.NDArray[Any]) -> bytes:
    # The file holds null where the table holds NaN.
    is_null = np.isnan(values)
    return bytes(np.where(is_null, 0.0, values).tobytes() + is_null.tobytes())


def _attitudes(count: int) -> AttitudeRows:
    """Attitudes one second apart of a body rotating at 1 deg/s."""
    turn = Rotation.from_rotvec(np.radians([0.3, -0.5, 0.8]) * np.arange(count)[:, None])
    times = [shifted(START, float(second)) for second in range(count)]

    def column(values: Sequence[str | None]) -> npt.NDArray[np.object_]:
        filled = np.empty(len(values), dtype=object)
        filled[:] = values
        return filled

    return AttitudeRows(
        time_ns=np.array([each.tai_ns for each in times], dtype=np.int64),
        time=column([each.text for each in times]),
        id=column([f"{each.tai_ns:026d}" for each in times]),
        batch=column([f"1996-010-{number:06d}" for number in range(count)]),
        status=column(["good"] * count),
        method=column(["quest"] * count),
        quaternion=turn.as_quat(),
        covariance_arcsec2=np.tile([1.5, 0.1, 0.2, 2.5, 0.3, 30.0], (count, 1)),
        rate_deg_per_s=np.full((count, 3), np.nan),
        residual_rms_arcsec=np.full(count, 1.25),
        predicted_rms_arcsec=np.full(count, 1.5),
        stars=np.tile([9, 6, 2, 1], (count, 1)),
        model=column([None] * count),
        revision=np.zeros(count, dtype=np.int64),
        bias_deg_per_h=np.full((count, 3), np.nan),
        bias_sigma_deg_per_h=np.full((count, 3), np.nan),
    )


def _seconds(way: Callable[[], object]) -> float:
    started = time.perf_counter()
    way()
    return time.perf_counter() - started

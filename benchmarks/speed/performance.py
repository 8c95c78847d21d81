"""docs/performance.md and its pictures, from benchmarks/speed/results.json.

    python -m benchmarks.speed.performance

Nothing is measured here: `make bench` measures, and then writes this.
"""

import json
import os
import platform
import sqlite3
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.bounds import Bound, shown
from benchmarks.record import ROOT, SERVICE, digest_of, read_record
from benchmarks.sections import bounds_table, table
from benchmarks.speed.posts import LEAST_OF_CEILING, LEAST_OF_NO_OP, MOST_READY_S, MOST_WAIT
from service import __version__
from studies.documents import Folder, pictures_in

RESULTS = Path(__file__).parent / "results.json"
TARGET = ROOT / "docs" / "performance.md"
PLOTS = TARGET.parent / "plots"
PACKAGES = ("fastapi", "uvicorn", "pydantic", "msgspec", "sqlalchemy", "numpy", "numba", "scipy")

INTRODUCTION = (
    "Written by `make bench`, for engineers who size a machine for the service, or who change its "
    "code. Times move with the machine and with what else runs on it; the ratios are of things "
    "measured in turn in one run, and the answers of every one are checked. Figures are not edited "
    "by hand. `make stale` names the parts that were measured with other code than today's."
)
IN_SHORT = (
    ("a batch in a small zone, without recording, median", "pipeline",
     "random cap: whole pipeline, median us", "µs"),
    ("a batch in the zone with most stars, median", "pipeline",
     "band forest: whole pipeline, median us", "µs"),
    ("a post over one connection, recorded, median", "posts",
     "single: p50 over one connection, ms", "ms"),
    ("posts over 16 connections, recorded", "posts", "single: service posts a second",
     "a second"),
    ("batches in bulk, recorded", "posts", "bulk: batches a second", "a second"),
    ("a post beside bulk, 99th percentile", "posts", "beside bulk: p99 of single posts, ms",
     "ms"),
    ("from the start of the process until ready", "posts", "start: seconds until ready", "s"),
    ("memory when ready", "posts", "memory: at ready, MB", "MB"),
    ("a month's trend by the hour, of five million batches", "stored", "a month by hour, ms",
     "ms"),
    ("recorded batches processed again by two processes", "reprocessing",
     "run again by two processes, batches/s", "a second"),
)  # fmt: skip
"""What most readers look for: its name, the benchmark, the figure, the unit."""
TITLES = {
    "kernels": "Kernels: votes, TRIAD and QUEST; pairs of stars",
    "pipeline": "The whole way of a batch, zones cold and cached",
    "verified_cost": "Verified identification beside the votes",
    "compiling": "Compiling the kernels",
    "posts": "Single posts, bulk, both at once, start, memory",
    "live_filter": "Posts with a gyro and the live filter beside posts without",
    "stored": "As the database fills",
    "reprocessing": "Reprocessing into an archive, and single posts beside it",
    "soak": "An hour at 70 % load",
}
ABOUT = {
    "pipeline": "Single calls of the core without records; see `benchmarks/speed/pipeline.py`.",
    "compiling": (
        "Processor time and machine code of each kernel, beside an earlier commit, each compiled "
        "into an empty folder. The time of a kernel includes what is compiled for it first."
    ),
    "posts": (
        "The service as it is served, over SQLite with synchronous=FULL, beside a no-op of the "
        "same server and framework whose route declares the same body, so that the framework "
        "checks it, and answers a small JSON. "
        "Each batch is dated a second after the one before. Bounds: 0.3 of the no-op's rate at 16 "
        "connections; bulk 0.5 of parsing and inserting "
        "alone; p99 of single posts beside bulk under 3 times its idle value; ready within 3 s of "
        "the start of the process, the first request longer than later ones after the "
        "same pause by no more than 1.5 posts in a row take (medians of some starts). "
        "Processor time and memory are those of all processes of the service, what they share "
        "counted each time."
    ),
    "live_filter": (
        "Two services in one run, each over a SQLite file of its own: one whose mission has a live "
        "filter that looks as often as a mission may ask for, one without it. "
        "In turns both get the same batches of a nominal pass, one a second of the pass, the first "
        "with the gyro blocks of 1,000 samples among them, which count as no posts but take their "
        "time. Bound: a post takes at most 1.1 times as long at 16 connections and over one, and "
        "1.1 times as much processor time."
    ),
    "stored": (
        "A database filled by `benchmarks.speed.fill_database`, then batches recorded in earnest "
        "and trends read; counted one by one, the results give the same numbers."
    ),
    "reprocessing": (
        "A simulated pass of some weeks is recorded in bulk by two processes, archived with every "
        "verification, and processed again into the archive by two processes and by one; the time "
        "until the processes are ready does not count. Then single posts go to a service over the "
        "scratch database of PostgreSQL that TEST_POSTGRESQL_URL names while the command runs "
        "beside it, also while its processes start; without one that part is left out. Bounds: at "
        "least the rate of recording in bulk; two processes at least 1.6 times one; p99 of single "
        "posts under 3 times its idle value."
    ),
    "soak": (
        "What the service can do at 16 connections is measured, then batches come for an hour at "
        "70 % of that, each at its time, while a page is read every second. Each was observed a "
        "second after the one before. Bounds: the memory of all its processes in the last sixth at "
        "most 5 % above that in the second, the write-ahead log under 64 MB, every batch recorded."
    ),
}


OF_CODE = ("kernels", "verified_cost")
"""Benchmarks for those who change the kernels; they are printed and not on the page."""
PLACES = ("random cap", "cap forest", "random band", "band forest")
LEFT_OUT = {
    "pipeline": tuple(
        f"{place}: {name}"
        for place in PLACES
        for name in ("zones built", "identify and solve in", "stars held")
    ),
    "posts": (
        *(
            "start: first",
            "start: hundredth",
            "start: later",
            "single: stars",
            "beside bulk: posts",
        ),
        *("single: service over no-op,", "single: service over a route", "single: cpu of no-op"),
        *("single: cpu of the service, us a post, connections: 8", "bulk: parsing"),
    ),
    "live_filter": ("the same", "cpu with, us", "cpu without", "answers compared", "p50 with over"),
    "stored": ("filled over", "a month by hour, buckets", "a year by day, buckets"),
    "soak": (
        *("log: largest in the first", "overviews", "minutes", "posts in all", "memory: drift"),
        *("p50 of the first", "p99 of the first"),
    ),
}
"""The beginnings of figures that the command prints and the page leaves out."""


def record(seed: int, quick: bool) -> dict[str, Any]:
    """What the figures were measured on."""
    model = next(
        (
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "seed": seed,
        "samples": "small" if quick else "full",
        "service": __version__,
        "processor": f"{model}, {os.cpu_count()} cores",
        "memory": f"{memory:.0f} GiB",
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "python": platform.python_version(),
        "sqlite": sqlite3.sqlite_version,
        **{name: version(name) for name in PACKAGES},
    }


def stale() -> list[str]:
    """The benchmarks of speed that were measured with other code than today's."""
    kept = json.loads(RESULTS.read_text("utf-8"))["benchmarks"] if RESULTS.exists() else {}
    today, old = digest_of(SERVICE), []
    for name in TITLES:
        record = read_record(kept.get(name, {}).get("code", ""))
        if record is None:
            old.append(f"{name}: no record of the code that it was measured with")
        elif record.sources != today:
            old.append(f"{name}: measured at commit {record.commit}; its sources have changed")
    return old


def write() -> None:
    """Write the page and its pictures."""
    kept = json.loads(RESULTS.read_text("utf-8"))
    machine = kept["record"]
    parts = [
        "# Performance",
        "",
        INTRODUCTION,
        "",
        table(["figure", "measured"], _in_short(kept["benchmarks"]), 1),
        "",
        f"Measured on: {', '.join(f'{name} {value}' for name, value in machine.items())}.",
    ]
    with pictures_in(PLOTS, "performance") as folder:
        for name, title in TITLES.items():
            if name not in kept["benchmarks"] or name in OF_CODE:
                continue
            found = kept["benchmarks"][name]
            figures = {
                key: value
                for key, value in found["figures"].items()
                if not key.startswith(LEFT_OUT.get(name, ()))
            }
            parts += ["", f"## {title}", "", ABOUT[name], ""]
            apart = [f"{each} {value}" for each, value in found["record"].items() - machine.items()]
            parts += [f"Measured apart: {', '.join(sorted(apart))}.", ""] if apart else []
            if name == "pipeline":
                parts += [_by_place(figures), ""]
            else:
                parts += [table(["", "figure"], figures.items(), 1), ""]
            if name == "posts":
                _posts_picture(found["figures"], folder)
                parts += ["![Rates and ratios](plots/performance-posts.svg)", ""]
            if name == "soak":
                _soak_picture(found["curves"], folder)
                parts += ["![An hour](plots/performance-soak.svg)", ""]
            bounds = [Bound(**each) for each in found.get("bounds", [])]
            broken = _broken(bounds)
            parts += [bounds_table(broken), ""] if broken else []
            record = read_record(found.get("code", ""))
            measured = f"{record.sentence} " if record else ""
            parts.append(
                f"{len(bounds) - len(broken)} of {len(bounds)} bounds hold. {measured}"
                f"`python -m benchmarks {name}` measures again and prints each figure and bound."
            )
    TARGET.write_text("\n".join(parts) + "\n", "utf-8")


def _in_short(benchmarks: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (name, f"{shown(benchmarks[benchmark]['figures'][figure])} {unit}")
        for name, benchmark, figure, unit in IN_SHORT
        if benchmark in benchmarks
    ]


def _broken(bounds: Iterable[Bound]) -> list[Bound]:
    return [bound for bound in bounds if not bound.holds]


def _by_place(figures: Mapping[str, Any]) -> str:
    """Figures named `place: figure`, a row for each figure and a column for each place."""
    rows: dict[str, dict[str, Any]] = {}
    for key, value in figures.items():
        place, _, name = key.partition(": ")
        rows.setdefault(name, {})[place] = value
    places = list(dict.fromkeys(place for row in rows.values() for place in row))
    return table(
        ["", *places],
        [[name, *(row.get(place, "") for place in places)] for name, row in rows.items()],
        len(places),
    )


def _posts_picture(figures: Mapping[str, Any], folder: Folder) -> None:
    bounds = {
        "single posts /\nno-op": (figures["single: service over no-op"], LEAST_OF_NO_OP),
        "bulk / parse\nand insert": (
            figures["bulk: bulk over parsing and inserting alone"],
            LEAST_OF_CEILING,
        ),
        "p99 beside\nbulk / idle": (figures.get("beside bulk: p99 over idle", 0.0), MOST_WAIT),
        "seconds\nto ready": (figures["start: seconds until ready"], MOST_READY_S),
    }
    figure = folder.figure(7.0, 2.4)
    for place, (name, (value, bound)) in zip(
        figure.subplots(1, len(bounds)), bounds.items(), strict=True
    ):
        place.bar([0], [value], width=0.5)
        place.axhline(bound, color="0.3", linestyle=":")
        place.set(xlim=(-0.6, 0.6), xticks=[], title=name, ylim=(0, 1.2 * max(value, bound)))
    folder.save(figure, "performance-posts")


def _soak_picture(curves: Mapping[str, list[float]], folder: Folder) -> None:
    figure = folder.figure(7.0, 2.6)
    for place, (name, values) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        place.plot(range(1, len(values) + 1), values)
        place.set(xlabel="minute", title=name, ylim=(0, 1.2 * max(values)))
    folder.save(figure, "performance-soak")


if __name__ == "__main__":
    write()

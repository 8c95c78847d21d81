"""Gives the service single faults, one at a time, and says which of them the tests miss.

    make mutants                                       60 faults of seed 1
    make mutants MUTANTS_ARGS="--seed 2 --suite sitting"
    python -m tests.mutants --list                     the faults alone, nothing is run
    python -m tests.mutants --area alarms --count 10 tests/features/alarms

It decides whether `make test` became weaker than `make full`:

1. It copies the tree to a folder of its own under the folder for temporary files, and compiles the
   kernels there.  Every place that a fault may have asks there whether the fault is on.
2. One run of the suite with no fault on notes which test reaches which place, in all processes that
   the tests start.  It takes as long as the suite.
3. With each fault on, the tests that reached its place run, quick ones first, then the others of
   their files, until one of them fails or hangs: that test kills the fault.  A fault with which the
   tests cannot be imported is replaced by another one.
4. After every ten faults the tests that killed them run with no fault on.  A test that fails there,
   or in the first run, kills nothing: it is named, and left out from then on.
5. What the sitting (`make test`) did not kill is tried with everything (`make full`), after a run
   of that suite as in 2.  Exit status 1 if a test kills one: it has to come back into the sitting.

Places are within functions, and not where kernels are compiled.  Faults that change nothing stand
in tests/mutants/equivalent.toml with the reason.  The second run of `make` over PostgreSQL is not
part of either suite; tests over both databases are, if TEST_POSTGRESQL_URL is set.
Results are in .mutants as JSON lines.  A run that was stopped goes on where it was, if nothing in
service/ and tests/ changed since; remove .mutants for a new one.
"""

import argparse
import json
import os
import signal
import sys
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tests.mutants.faults import Fault, draw
from tests.mutants.tree import Reached, Tree, lines_of
from tests.torture import digest_of

ROOT = Path(__file__).parents[2]
AREAS = {
    "alarms": ("service/features/alarms", "service/trends"),
    "access": ("service/access.py",),
    "webhooks": ("service/features/webhooks",),
    "recording": ("service/storage/recording",),
    "ingest": ("service/ingest",),
    "packets": ("service/features/packets",),
    "products": ("service/features/products", "service/ephemerides", "service/table_files"),
    "requests": (
        "service/web/requests",
        "service/observations/csv_rows.py",
        "service/observations/csv_table.py",
        "service/observations/decode.py",
        "service/observations/decompress.py",
        "service/observations/schema.py",
        "service/observations/telemetry.py",
    ),
}
SUITES: dict[str, list[str]] = {"sitting": [], "full": ["--full"]}
LEFT_OUT = "left out, because it fails without a fault"
ROUND = 10
"""How many faults are tried before the tests that killed them run without a fault."""
RESERVE = 1.3
"""Faults drawn for each that is wanted: some of them are invalid."""


class Results:
    """What earlier runs found: what became of faults, and which tests reached which place."""

    def __init__(self, folder: Path, given: Mapping[str, Any]) -> None:
        self._folder, self._given = folder, given
        self._file = folder / "results.jsonl"
        folder.mkdir(exist_ok=True)
        known = [each for each in lines_of(self._file) if each["given"] == given]
        self.of = {(each["number"], each["suite"]): each for each in known}

    def add(self, suite: str, number: int, fault: Fault, result: dict[str, Any]) -> None:
        record = {"number": number, "suite": suite, "fault": str(fault)} | result
        self.of[number, suite] = record
        with self._file.open("a") as file:
            file.write(json.dumps(record | {"given": self._given}) + "\n")
        killer = f": {result['test']}" if result["test"] else ""
        print(f"{fault}\n    {result['outcome']}{killer} ({result['seconds']:.0f} s)", flush=True)

    def reached(self, suite: str, tree: Tree, jobs: int, tests: Sequence[str]) -> Reached:
        """Which tests reach which place: of an earlier run, or of one that is made now."""
        file = self._folder / f"reached-{suite}.json"
        known = json.loads(file.read_text("utf-8")) if file.exists() else {}
        if known.get("given") != self._given:
            print(f"== {suite}: all tests with no fault on, which notes the places that they reach")
            workers = ["--numprocesses", str(jobs), "--dist", "loadfile"] if jobs > 1 else []
            places, outcomes = tree.run_suite([*SUITES[suite], *workers, *tests])
            known = {"given": self._given, "places": places, "outcomes": outcomes}
            file.write_text(json.dumps(known), "utf-8")
        found = Reached.read(known["places"], known["outcomes"])
        for test in sorted(found.left_out):
            print(f"{LEFT_OUT}: {test}")
        return found


def judge_all(
    tree: Tree, faults: Sequence[Fault], suites: Sequence[str], parsed: Any, results: Results
) -> None:
    """Try in the last suite what those before did not kill, and others for invalid faults."""
    *before, suite = suites
    reached = None
    while waiting := [
        number
        for number in chosen(faults, parsed.count, results)
        if (number, suite) not in results.of and not is_killed(results, number, before)
    ]:
        reached = reached or results.reached(suite, tree, parsed.jobs, parsed.tests)
        print(f"== {suite}: {len(waiting)} faults to try", flush=True)
        found = judge_some(tree, waiting[:ROUND], suite, parsed.jobs, reached)
        killers = sorted({result["test"] for result in found.values()} - {None})
        failing = tree.failing(killers, SUITES[suite], reached) if killers else set()
        reached.left_out |= failing
        for test in failing:
            print(f"{LEFT_OUT}: {test}")
        for number, result in found.items():
            if result["test"] not in failing:
                results.add(suite, number, faults[number], result)


def judge_some(
    tree: Tree, numbers: Sequence[int], suite: str, jobs: int, reached: Reached
) -> dict[int, dict[str, Any]]:
    """What becomes of some faults, several at a time."""
    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(tree.judge, n, SUITES[suite], reached): n for n in numbers}
        try:
            done = tqdm(as_completed(futures), total=len(futures), unit="fault", disable=None)
            return {futures[future]: future.result() for future in done}
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            tree.end_processes()
            raise


def chosen(faults: Sequence[Fault], count: int, results: Results) -> list[int]:
    """The numbers of the first faults that are valid."""
    invalid = {number for (number, _), each in results.of.items() if each["outcome"] == "invalid"}
    return [number for number in range(len(faults)) if number not in invalid][:count]


def is_killed(results: Results, number: int, suites: Sequence[str]) -> bool:
    return any(results.of[n, s]["test"] for n, s in results.of if n == number and s in suites)


def main(
    arguments: Sequence[str] | None = None,
    root: Path = ROOT,
    areas: Mapping[str, Sequence[str]] = AREAS,
) -> int:
    parsed = _parser(areas).parse_args(arguments)
    areas = {name: paths for name, paths in areas.items() if name in (parsed.area or areas)}
    equivalent = root / "tests" / "mutants" / "equivalent.toml"
    listed = tomllib.loads(equivalent.read_text("utf-8"))["fault"] if equivalent.exists() else []
    left_out = {tuple(each[name] for name in ("file", "function", "old", "new")) for each in listed}
    faults = draw(root, areas, parsed.seed, int(parsed.count * RESERVE) + 1, left_out)
    if parsed.list:
        print(*faults[: parsed.count], sep="\n")
        return 0
    given = {
        "service": digest_of(root / "service"),
        "tests": digest_of(root / "tests"),
        "seed": parsed.seed,
        "count": parsed.count,
        "areas": list(areas),
        "selected": parsed.tests,
        "postgresql": "TEST_POSTGRESQL_URL" in os.environ,
    }
    results = Results(root / ".mutants", given)
    suites = list(SUITES) if parsed.suite == "both" else [parsed.suite]
    with closing(Tree(root, faults)) as tree:
        tree.compile_kernels()
        for number in range(len(suites)):
            judge_all(tree, faults, suites[: number + 1], parsed, results)
    return report(faults, chosen(faults, parsed.count, results), suites, results)


def report(
    faults: Sequence[Fault], numbers: Sequence[int], suites: Sequence[str], results: Results
) -> int:
    """Print what came of the faults; 1 if the last suite kills one that the first does not."""
    survived = [number for number in numbers if not is_killed(results, number, suites)]
    later = [n for n in numbers if n not in survived and not is_killed(results, n, suites[:1])]
    sooner = len(numbers) - len(survived) - len(later)
    print(f"\n{len(numbers)} faults: {sooner} killed by {suites[0]}")
    if suites[1:]:
        print(f"{len(later)} killed only by {suites[1]}, by tests that belong into the sitting:")
        for number in later:
            print(f"  {faults[number]}\n      {results.of[number, suites[1]]['test']}")
    print(f"{len(survived)} survived:")
    for number in survived:
        print(f"  {faults[number]}\n      {results.of[number, suites[-1]]['outcome']}")
    return 1 if later else 0


def _parser(areas: Mapping[str, Sequence[str]]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutants",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seed", type=int, default=1, help="which faults are drawn (1)")
    parser.add_argument("--count", type=int, default=60, help="how many faults (60)")
    parser.add_argument("--suite", choices=[*SUITES, "both"], default="both")
    parser.add_argument(
        "--area", action="append", choices=list(areas), help="only these; repeatable"
    )
    parser.add_argument(
        "--jobs", type=lambda text: max(1, int(text)), default=2, help="faults at a time (2)"
    )
    parser.add_argument("--list", action="store_true", help="print the faults and run nothing")
    parser.add_argument("tests", nargs="*", help="files and folders of tests instead of all")
    return parser


if __name__ == "__main__":
    # So that an end by a signal ends the processes of the tests, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    sys.exit(main())

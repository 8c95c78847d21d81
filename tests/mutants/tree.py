"""A copy of the tree with all the faults, none of them on, and runs of its tests."""

import fcntl
import hashlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.mutants import probe
from tests.mutants.faults import Fault, replaced

WRAPPED = "(({new}) if __import__('service.fault_probe').fault_probe.is_on({number}) else ({old}))"
PYTEST = ("-m", "pytest", "-p", "service.fault_probe", "-p", "no:cacheprovider")
PYTEST_STOPPED = (2, 3, 4, 5)
"""Exit codes of pytest if collection failed, pytest itself, its options, or no test was found."""
NO_FAULT = -1
LEAST_HANG_S, HANG_FACTOR, START_S = 120, 5, 300
DEAR_S = 1.0
"""A test that takes longer comes after all that take less."""


@dataclass
class Reached:
    """Which tests reached which place in a suite, what they cost, and those that do not count."""

    by_place: dict[int, set[str]]
    outcomes: dict[str, dict[str, Any]]
    left_out: set[str] = field(default_factory=set)

    @classmethod
    def read(cls, places: Sequence[Any], outcomes: Sequence[dict[str, Any]]) -> "Reached":
        """From pairs of a place and a test, and outcomes of tests; leaves out those that fail."""
        of = {outcome["test"]: outcome for outcome in outcomes}
        by_place: dict[int, set[str]] = {}
        for place, test in places:
            if test in of or not test:
                by_place.setdefault(place, set()).add(test)
        return cls(by_place, of, {test for test, outcome in of.items() if outcome["failed"]})

    def tests(self, place: int) -> list[str]:
        """The tests to run for a place in their order."""
        direct = self.by_place.get(place, set())
        # What runs while pytest imports may matter to every test.
        files = {file_of(test) for test in direct} if "" not in direct else None
        chosen = [t for t in self.outcomes if files is None or file_of(t) in files]
        cost: dict[str, float] = {}
        for test in chosen:
            cost[file_of(test)] = cost.get(file_of(test), 0.0) + self.outcomes[test]["seconds"]

        def rank(test: str) -> tuple[bool, bool, float, str]:
            is_dear = self.outcomes[test]["call_s"] > DEAR_S
            return test not in direct, is_dear, cost[file_of(test)], file_of(test)

        return sorted((test for test in chosen if test not in self.left_out), key=rank)


def file_of(test: str) -> str:
    return test.partition("::")[0]


class Tree:
    """The copy of a tree with all the faults, none of them on."""

    def __init__(self, root: Path, faults: Sequence[Fault]) -> None:
        name = hashlib.sha256(str(root).encode()).hexdigest()[:12]
        self._place = Path(tempfile.gettempdir()) / f"mutants-{name}"
        self._place.mkdir(exist_ok=True)
        self._lock = (self._place / "lock").open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # closing the file unlocks it
        self._folder, self._runs = self._place / "tree", self._place / "runs"
        self._run_numbers = itertools.count(1)
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._copy(root)
        shutil.copy2(probe.__file__, self._folder / "service" / "fault_probe.py")
        for file in {fault.file for fault in faults}:
            of_file = {number: each for number, each in enumerate(faults) if each.file == file}
            text = replaced((self._folder / file).read_bytes(), of_file, WRAPPED)
            (self._folder / file).write_bytes(text)
        # Tests ask which files belong to the project.
        for command in (["init", "-q"], ["add", "--all"]):
            subprocess.run(["git", *command], cwd=self._folder, check=True)

    def _copy(self, root: Path) -> None:
        """Copy all files of the project; compiled kernels of an earlier copy stay."""
        kernels, aside = self._folder / "service" / "__pycache__", self._place / "kernels"
        if kernels.exists():
            kernels.replace(aside)
        for folder in (self._folder, self._runs):
            shutil.rmtree(folder, ignore_errors=True)
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
        for file in filter(None, listed.stdout.split("\0")):
            if (root / file).is_file():
                (self._folder / file).parent.mkdir(parents=True, exist_ok=True)
                # With its time of change: numba compiles a file again whose time is another.
                shutil.copy2(root / file, self._folder / file)
        if aside.exists():
            aside.replace(kernels)

    def compile_kernels(self) -> None:
        """Compile them before the tests, which would wait for them; minutes, if they changed."""
        if (self._folder / "service" / "sky" / "files.py").exists():
            print("== compiling the kernels of the copy", flush=True)
            self._python("-m", "service.cli", "prepare")

    def run_suite(self, arguments: Sequence[str]) -> tuple[list[Any], list[dict[str, Any]]]:
        """Run tests with no fault on; pairs of a place and a test that reaches it, and outcomes."""
        folder = self._new_folder()
        code = self._python(*PYTEST, f"--basetemp={folder / 'tmp'}", *arguments, folder=folder)
        outcomes = lines_of(folder / probe.OUTCOMES)
        if code not in (0, 1) or not outcomes:
            raise SystemExit(f"the tests cannot be run: pytest ended with {code}")
        return lines_of(folder / probe.NOTES), outcomes

    def judge(self, place: int, options: Sequence[str], reached: Reached) -> dict[str, Any]:
        """Run the tests that may kill a fault until one does; what came of it."""
        begun = time.monotonic()
        outcome, test = "not reached", None
        if tests := reached.tests(place):
            code, failed, last = self._run(place, ["-x", *options], tests, reached)
            if failed:
                outcome, test = "killed", failed[0]
            elif code == 0:
                outcome = "survived"
            elif code in PYTEST_STOPPED or not last:
                outcome = "invalid"
            else:
                outcome, test = "killed by a hang or a crash", last
        return {"outcome": outcome, "test": test, "seconds": round(time.monotonic() - begun, 1)}

    def failing(self, tests: Sequence[str], options: Sequence[str], reached: Reached) -> set[str]:
        """Those of some tests that fail with no fault on."""
        code, failed, last = self._run(NO_FAULT, options, tests, reached)
        return {*failed, last} if code not in (0, 1) else set(failed)

    def _run(
        self, place: int, options: Sequence[str], tests: Sequence[str], reached: Reached
    ) -> tuple[int, list[str], str]:
        """Run tests with a fault on: exit code, tests that failed, the last that began."""
        folder = self._new_folder()
        (folder / probe.CHOSEN).write_text(json.dumps(tests), "utf-8")
        seconds = [reached.outcomes[test]["seconds"] for test in tests]
        limit = f"faulthandler_timeout={max(LEAST_HANG_S, HANG_FACTOR * max(seconds)):.0f}"
        code = self._python(
            *PYTEST, "-o", limit, f"--basetemp={folder / 'tmp'}", *options,
            *dict.fromkeys(file_of(test) for test in tests),
            folder=folder, place=place, timeout_s=START_S + HANG_FACTOR * sum(seconds),
        )  # fmt: skip
        shutil.rmtree(folder / "tmp", ignore_errors=True)
        failed = [each["test"] for each in lines_of(folder / probe.OUTCOMES) if each["failed"]]
        running = [file.read_text("utf-8") for file in folder.glob("running-*")]
        return code, failed, "".join(running).partition("\0")[0]

    def _new_folder(self) -> Path:
        folder = self._runs / str(next(self._run_numbers))
        folder.mkdir(parents=True)
        return folder

    def _python(
        self,
        *arguments: str,
        folder: Path | None = None,
        place: int | None = None,
        timeout_s: float | None = None,
    ) -> int:
        """Run Python in the copy and end every process that it leaves; its exit code."""
        environment = os.environ | {"PYTHONPATH": str(self._folder)}
        if folder is not None:
            environment[probe.FOLDER] = str(folder)
        if place is not None:
            environment[probe.ACTIVE] = str(place)
        with ExitStack() as files:
            # What is printed about a fault can be read until the next run of this program.
            quiet = folder is not None and place is not None
            printed = files.enter_context((folder / "printed").open("wb")) if quiet else None
            process = subprocess.Popen(
                [sys.executable, *arguments], cwd=self._folder, env=environment,
                stdout=printed, stderr=printed, start_new_session=True,
            )  # fmt: skip
        self._processes.add(process)
        try:
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return -signal.SIGALRM
        finally:
            _end(process)
            self._processes.discard(process)

    def end_processes(self) -> None:
        for process in list(self._processes):
            _end(process)

    def close(self) -> None:
        self._lock.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and all that it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
            time.sleep(0.1)
    process.wait()


def lines_of(file: Path) -> list[Any]:
    if not file.exists():
        return []
    return [json.loads(line) for line in file.read_text("utf-8").splitlines()]

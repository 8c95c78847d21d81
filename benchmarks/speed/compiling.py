"""Compiling the kernels: processor time and machine code of each, beside a commit before.

    python -m benchmarks compiling

`acquire prepare` with nothing compiled, of this tree and of the tree of `BASE`, one after the
other.  The time of a kernel includes what is compiled for it alone, and for it first.  Processor
time moves less with other work on the machine than the clock does; an empty loop is timed beside
it.  A small sample leaves out the commit before.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.bounds import at_most
from benchmarks.compare.servers import HERE, checked_out, commit_of
from benchmarks.report import Report

BASE = "fb44b6f7"
"""The commit that this one is held against: that before the first start was made shorter."""
MOST_SHARE = 0.2
"""Largest share of one kernel in the processor time of all."""
MOST_OF_BASE = 0.6
"""Largest ratio of the processor time of all kernels to that of `BASE`."""
ROUNDS = 10_000_000
TIMES = "times.txt"
HOOK = f"""
import os, time
from pathlib import Path
from service.compiled.jit import Kernel

compile_kernel = Kernel.compile
def measured(kernel, signature):
    started = time.process_time()
    try:
        return compile_kernel(kernel, signature)
    finally:
        seconds = time.process_time() - started
        # As numba names its files, and the same where a folder was renamed.
        module = kernel.py_func.__module__.rpartition(".")[2]
        name = f"{{module}}.{{kernel.py_func.__qualname__}}"
        with (Path(os.environ["NUMBA_CACHE_DIR"]) / "{TIMES}").open("a") as file:
            file.write(f"{{name}} {{seconds}}\\n")
Kernel.compile = measured
"""
"""What each process of the command imports at its start."""


class Compiled(NamedTuple):
    """Kernels by name: processor time and size of machine code; processor time of everything."""

    seconds: dict[str, float]
    size_kb: dict[str, float]
    whole_s: float

    def of_kernel(self, name: str) -> str:
        """Both figures of a kernel as text."""
        if name not in self.seconds:
            return "none"
        return f"{self.seconds[name]:.2f} s, {self.size_kb[name]:.0f} kB"


def run(quick: bool, seed: int) -> Report:
    """The benchmark; there is nothing random in it."""
    now = _compiled(HERE)
    all_s = sum(now.seconds.values())
    figures: dict[str, Any] = {
        "kernels": len(now.seconds),
        "all kernels, s of processor time": all_s,
        "with the batches that they are compiled for, s": now.whole_s,
        "all kernels, kB": sum(now.size_kb.values()),
    }
    bounds = [at_most("share of the longest", max(now.seconds.values()) / all_s, MOST_SHARE)]
    before = None if quick else _compiled(checked_out(commit_of(BASE)))
    if before is not None:
        figures |= {
            f"{BASE}: kernels": len(before.seconds),
            f"{BASE}: all kernels, s of processor time": sum(before.seconds.values()),
            f"{BASE}: with the batches that they are compiled for, s": before.whole_s,
            f"{BASE}: all kernels, kB": sum(before.size_kb.values()),
        }
        ratio = all_s / sum(before.seconds.values())
        bounds.append(at_most(f"all kernels over {BASE}", ratio, MOST_OF_BASE))
    figures["empty loop of ten million rounds, s"] = empty_loop_s()
    named = (before.seconds if before else {}) | now.seconds
    for name in sorted(named, key=lambda name: -named[name]):
        text = now.of_kernel(name)
        figures[name] = text if before is None else f"{text}; {BASE}: {before.of_kernel(name)}"
    return Report("compiling", figures, bounds)


def empty_loop_s() -> float:
    """Processor time of ten million rounds of nothing, by which machines are compared."""
    started = time.process_time()
    for _ in range(ROUNDS):
        pass
    return time.process_time() - started


def _compiled(tree: Path) -> Compiled:
    """Compile all kernels of a tree into an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sitecustomize.py").write_text(HOOK, "utf-8")
        environment = {"NUMBA_CACHE_DIR": name, "PYTHONPATH": f"{name}{os.pathsep}{tree}"}
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [sys.executable, "-m", "service.cli", "prepare"],
            cwd=tree,
            env=os.environ | environment,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds, size_kb = defaultdict[str, float](float), defaultdict[str, float](float)
        for line in (folder / TIMES).read_text("utf-8").splitlines():
            kernel, compiled_s = line.split()
            seconds[kernel] += float(compiled_s)
        for path in folder.rglob("*.nbc"):
            size_kb[path.name.split("-")[0]] += path.stat().st_size / 1e3
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Compiled(dict(seconds), size_kb, spent_s)

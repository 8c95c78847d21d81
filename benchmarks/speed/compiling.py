"""Compiling the kernels: processor time and machine code of each, in one process.

    python -m benchmarks compiling

Everything is compiled into an empty folder, in the order of a first start with one processor.
The time of a kernel includes what is compiled for it alone, and for it first.  Processor time
moves less with other work on the machine than the clock does; an empty loop is timed beside it.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.bounds import at_most
from benchmarks.report import Report

MOST_SHARE = 0.2
"""Largest share of one kernel in the processor time of all."""
ROUNDS = 10_000_000
CHILD = """
import gc, json, os, sys, time
from pathlib import Path
from service.acquire.kernel_build import COLLECT_EVERY
from service.acquire.prewarm import compile_beside_batches, prewarm_kernels
from service.compiled.jit import Kernel
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

found, compile_kernel = {}, Kernel.compile
def measured(kernel, signature):
    started = time.process_time()
    try:
        return compile_kernel(kernel, signature)
    finally:
        name = f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"
        found[name] = found.get(name, 0.0) + time.process_time() - started
Kernel.compile = measured
gc.freeze()
gc.set_threshold(COLLECT_EVERY)
sky, missions = SkyModel(load_embedded(), LruCache(64 << 20), opens_files=False), load_missions()
zones = [name for name, entry in IDENTIFIERS.items() if entry.searches_zone]
started = time.process_time()
prewarm_kernels(sky, missions, zones, seldom=True)
in_zones = time.process_time() - started
prewarm_kernels(sky, missions, [name for name in IDENTIFIERS if name not in zones])
compile_beside_batches()
json.dump([found, in_zones, time.process_time() - started], sys.stdout)
"""


def run(quick: bool, seed: int) -> Report:
    """The benchmark; there is no smaller one, and nothing random in it."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", CHILD],
            env=os.environ | {"NUMBA_CACHE_DIR": folder},
            stdout=subprocess.PIPE,
            check=True,
        )
        seconds, in_zones_s, whole_s = msgspec.json.decode(
            done.stdout, type=tuple[dict[str, float], float, float]
        )
        size_kb = _sizes_kb(Path(folder))
    longest = max(seconds, key=lambda name: seconds[name])
    figures: dict[str, Any] = {
        "kernels": len(seconds),
        "all kernels, s of processor time": sum(seconds.values()),
        "with the batches that they are compiled for, s": whole_s,
        "of batches with a zone, s": in_zones_s,
        "all kernels, kB": sum(size_kb.values()),
        "empty loop of ten million rounds, s": empty_loop_s(),
    }
    for name in sorted(seconds, key=lambda name: -seconds[name]):
        short = name.removeprefix("service.")
        kept_kb = size_kb.get(".".join(name.split(".")[-2:]), 0.0)
        figures[short] = f"{seconds[name]:.2f} s, {kept_kb:.0f} kB"
    share = seconds[longest] / sum(seconds.values())
    return Report("compiling", figures, [at_most("share of the longest", share, MOST_SHARE)])


def empty_loop_s() -> float:
    """Processor time of ten million rounds of nothing, by which machines are compared."""
    started = time.process_time()
    for _ in range(ROUNDS):
        pass
    return time.process_time() - started


def _sizes_kb(folder: Path) -> dict[str, float]:
    """The machine code of each kernel by module and name, as numba names its files."""
    sizes: dict[str, float] = {}
    for path in folder.rglob("*.nbc"):
        name = path.name.split("-")[0]
        sizes[name] = sizes.get(name, 0.0) + path.stat().st_size / 1e3
    return sizes

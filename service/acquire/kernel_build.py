"""Compilation of kernels in child processes before the first batch, with progress.

Compiling takes a minute, holds the interpreter's lock and cannot be interrupted. Child processes
can be killed, and the parent answers probes meanwhile; it then loads the kernels from the cache on
disk.
"""

import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from logging import Logger
from multiprocessing import connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

import llvmlite.binding  # type: ignore[import-untyped]
import numba

from service.acquire.prewarm import compile_beside_batches, prewarm_kernels
from service.child_processes import Source, own_source, require_source, safe_path
from service.compiled.checked_file import count_whole
from service.errors import Busy, Stopping
from service.feature import SETTING, features_on
from service.missions.identifiers import IDENTIFIERS, IdentifierEntry
from service.missions.mission import Mission
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

RETRY_S = 10
WHOLE_SKY_RETRY_S = 2
"""Seconds after which a client may retry during the compilation of whole-sky kernels.

It is shorter than for the other kernels, for a demonstration that sends batches meanwhile.
"""
COLLECT_EVERY = 100_000
"""Number of new objects between garbage collections during compilation. Few objects are garbage,
and with Python's default of 700 an eighth of the time is spent on collections.
"""

_CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Stop signals of the service, which may reach its whole process group."""


class _Share(NamedTuple):
    """The kernels that one child process compiles, in order; see `prewarm_kernels`."""

    zones: list[str]
    """Names of the identifiers with a zone whose kernels the child compiles."""
    whole_sky: list[str]
    """Names of the identifiers of the whole sky whose kernels the child compiles."""
    beside_batches: bool
    """True if the child also compiles the kernels of features."""


def do_nothing() -> None:
    """Do nothing: the default of a function that child processes receive by its name."""


class KernelBuild:
    """Build of the compiled kernels that this machine's cache lacks, with its state."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._children: list[SpawnProcess] = []
        self._cancelled = False
        self.is_needed = not _is_complete()
        """True until every kernel is compiled, since answers must not depend on what is."""
        self.zones_needed = self.is_needed
        """True until the kernels for batches with a zone are compiled."""
        self.whole_sky_needed = self.is_needed
        """True until the kernels for whole-sky searches are compiled, too."""

    @property
    def being_compiled(self) -> list[str]:
        """The kinds of work that are refused until their kernels are compiled."""
        kinds = {
            "batches with an a priori attitude": self.zones_needed,
            "searches of the whole sky": self.whole_sky_needed,
            "what-ifs, replays and what features compute": self.is_needed,
        }
        return [kind for kind, needed in kinds.items() if needed]

    def require_built(self) -> None:
        """Raise `Busy` until all kernels are compiled."""
        if self.is_needed:
            raise Busy("the service is compiling its kernels", RETRY_S)

    def require_whole_sky(self) -> None:
        """Raise `Busy` until the kernels for whole-sky searches are compiled."""
        if self.whole_sky_needed:
            raise Busy(
                "the service is compiling the kernels that search the whole sky", WHOLE_SKY_RETRY_S
            )

    def run(
        self,
        missions: Mapping[str, Mission],
        zones_built: Callable[[], None] = lambda: None,
        whole_sky_built: Callable[[], None] = lambda: None,
        build_files: Callable[[], None] = do_nothing,
    ) -> None:
        """Compile the missing kernels in two child processes, or in one on a single processor.

        Both begin with the kernels for batches with a zone, then those for whole-sky searches.
        `zones_built` and `whole_sky_built` are called when these are ready, while the rest is
        compiled. A child calls `build_files` between its kernels for the whole sky and
        `whole_sky_built`: building the files here would hold the interpreter's lock, and batches
        would wait. Raises `Busy` if a child fails, `Stopping` if cancelled.
        """
        if not self.is_needed:
            return
        receivers = []
        with self._lock:
            if self._cancelled:
                raise Stopping("the service is stopping")
            for share in _shares(_processors()):
                receiver, sender = _CONTEXT.Pipe(duplex=False)
                child = _CONTEXT.Process(
                    target=_compile,
                    args=(dict(missions), share, build_files, sender, own_source()),
                    daemon=True,
                )
                self._children.append(child)
                with safe_path():
                    child.start()
                # Only the child may hold this end, so that its end closes the pipe.
                sender.close()
                receivers.append(receiver)
        with ExitStack() as ends:
            for receiver in receivers:
                ends.enter_context(receiver)
            if all(_has_reported(each) for each in receivers):
                self.zones_needed = False
                zones_built()
            if all(_has_reported(each) for each in receivers):
                whole_sky_built()
                self.whole_sky_needed = False
        for child in self._children:
            child.join()
        if self._cancelled:
            raise Stopping("the service is stopping")
        failed = any(child.exitcode != 0 for child in self._children)
        self._children.clear()
        if failed:
            raise Busy("the kernels could not be compiled; the log says why", RETRY_S)
        mark_built()
        self.is_needed = self.whole_sky_needed = False

    def cancel(self) -> None:
        """Kill a running build, and prevent further ones."""
        with self._lock:
            self._cancelled = True
            for child in self._children:
                child.kill()


def mark_built() -> None:
    """Record in the cache folder that every kernel is there."""
    marker = _marker()
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.write_text(str(count_whole(marker.parent)), encoding="ascii")


def _is_complete() -> bool:
    """True if numba's cache holds every compiled kernel undamaged; damaged files are removed."""
    marker = _marker()
    try:
        expected = int(marker.read_text(encoding="ascii"))
        return count_whole(marker.parent) >= expected
    except (OSError, ValueError):
        return False


def end_with_parent() -> None:
    """In a child process, ignore the signals that stop the parent, and exit after the parent."""
    for each in SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    exit_after_parent()


def exit_after_parent() -> None:
    """Let a child process exit as soon as its parent has ended."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _marker() -> Path:
    # numba compiles for one processor type, and its cache key includes that and its version.
    config: Any = numba.config
    processor = config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    # A feature that is enabled later has its kernels compiled then.
    features = features_on(os.environ.get(SETTING, ""))
    named = (each.name for each in features if "kernels" in each.brings)
    return Path(config.CACHE_DIR) / "-".join(["complete", numba.__version__, processor, *named])


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _shares(processors: int) -> list[_Share]:
    """The kernels for each child process to compile, by the number of processors.

    The kernel that weighs hypotheses takes as long as most others together, and the whole sky needs
    it, too: the first child has saved it by then.
    """

    def named(is_meant: Callable[[IdentifierEntry], bool]) -> list[str]:
        return [name for name, entry in IDENTIFIERS.items() if is_meant(entry)]

    whole_sky = named(lambda entry: not entry.searches_zone)
    if processors < 2:
        return [_Share(named(lambda entry: entry.searches_zone), whole_sky, True)]
    weighing = named(lambda entry: entry.searches_zone and entry.weighs_hypotheses)
    counting = named(lambda entry: entry.searches_zone and not entry.weighs_hypotheses)
    return [_Share(weighing, [], True), _Share(counting, whole_sky, False)]


def _has_reported(child: connection.Connection) -> bool:
    """Wait until a child has compiled its next share; false if the child ends before that."""
    try:
        child.recv_bytes()
    except EOFError:
        return False
    return True


def _compile(
    missions: Mapping[str, Mission],
    share: _Share,
    build_files: Callable[[], None],
    compiled: connection.Connection,
    parent: Source,
) -> None:
    end_with_parent()
    require_source(parent)
    gc.freeze()
    gc.set_threshold(COLLECT_EVERY)
    sky = SkyModel(load_embedded(), LruCache(64 << 20), opens_files=False)
    prewarm_kernels(sky, missions, share.zones, seldom=True)
    compiled.send_bytes(b"zones")
    if share.whole_sky:
        prewarm_kernels(sky, missions, share.whole_sky)
        build_files()
    compiled.send_bytes(b"whole sky")
    if share.beside_batches:
        compile_beside_batches()


# Progress of kernel compilation, estimated from the files in the cache: the size of machine code is
# nearly proportional to its compile time.

KERNEL_BYTES = 2_830_000
"""Approximate size of all kernels' machine code in bytes; other processors differ by a tenth."""
MOST_SHARE = 0.99
"""Largest share shown during compilation, since the exact total size is unknown."""
LEAST_SHARE = 0.02
"""Least share from which the remaining time is estimated."""
STEPS = {
    "geometry": "zones and pairs",
    "sky": "zones and pairs",
    "observations": "reading batches",
    "voting": "votes",
    "hypotheses": "verified identification",
    "identify": "verified identification",
    "attitude": "attitude",
    "whole_sky": "index of the whole sky",
    "lost_in_space": "search of the whole sky",
    "triangles": "triangles",
    "kernels": "features",
}
"""Purpose of the kernels in each subfolder of the cache, for progress messages."""
EVERY_S = 10.0


@dataclass(frozen=True)
class KernelProgress:
    """Progress of compilation: what is compiled now, and the completed share (0 to 1)."""

    step: str
    share: float

    def line(self, passed_s: float) -> str:
        """A progress message with step, share and remaining time, after `passed_s` seconds."""
        text = f"compiling kernels, {self.step}: {100.0 * self.share:.0f} %"
        if self.share < LEAST_SHARE:
            return text
        return f"{text}, about {passed_s * (1.0 / self.share - 1.0):.0f} s left"


def kernel_progress() -> KernelProgress:
    """Progress of compilation, from the files in this process's kernel cache."""
    config: Any = numba.config
    files = []
    for path in Path(config.CACHE_DIR).glob("*/*.nbc"):
        try:
            state = path.stat()
        except FileNotFoundError:
            continue  # numba writes beside and renames
        files.append((state.st_mtime, state.st_size, path.parent.name))
    if not files:
        return KernelProgress(next(iter(STEPS.values())), 0.0)
    folder = max(files)[2].rpartition("_")[0]
    share = sum(size for _, size, _ in files) / KERNEL_BYTES
    return KernelProgress(STEPS.get(folder, folder), min(share, MOST_SHARE))


@contextmanager
def progress_logged(log: Logger) -> Iterator[None]:
    """A context manager that logs the progress of compilation every ten seconds."""
    ended, start = Event(), time.monotonic()

    def tell() -> None:
        while not ended.wait(EVERY_S):
            log.info("%s", kernel_progress().line(time.monotonic() - start))

    teller = Thread(target=tell, name="kernel-progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()

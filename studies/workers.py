"""Worker processes for the tasks of a study, on all cores."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from service.acquire.kernel_build import exit_after_parent
from service.child_processes import Source, own_source, require_source, safe_path


def number_of(processes: int | None) -> int:
    """Number of workers; None: one per core."""
    return processes or len(os.sched_getaffinity(0))


@contextmanager
def mapping(processes: int | None) -> Iterator[Callable[..., Iterator[Any]]]:
    """A `map` whose calls run in worker processes; with one worker they run in this process."""
    count = number_of(processes)
    if count == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")
    with (
        safe_path(),
        ProcessPoolExecutor(count, context, _begin, (own_source(),)) as workers,
    ):
        yield workers.map


def _begin(parent: Source) -> None:
    require_source(parent)
    exit_after_parent()

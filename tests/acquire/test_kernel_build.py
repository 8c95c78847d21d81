"""The processes that compile kernels: side by side, there while the build runs, and no longer."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba
import pytest

from service.acquire import kernel_build
from service.acquire.kernel_build import KernelBuild
from service.acquire.prewarm import build_sky_files, prewarm_kernels, prewarm_sky
from service.errors import Busy, Stopping
from service.missions.identifiers import IDENTIFIERS
from service.sky import model
from service.sky.cache import LruCache
from service.sky.model import SkyModel
from service.times import parse_utc


@pytest.fixture
def nothing_compiled(monkeypatch, tmp_path):
    """An empty cache, for this process and its children."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))


@pytest.fixture
def building(missions, nothing_compiled):
    """A build in a thread; the processes that it started, once there are so many."""
    others = multiprocessing.active_children()
    build, stopped = KernelBuild(), []

    def run():
        try:
            build.run(missions)
        except Stopping as error:
            stopped.append(error)

    thread = threading.Thread(target=run)

    def started(count):
        thread.start()
        for _ in range(300):
            children = [each for each in multiprocessing.active_children() if each not in others]
            if len(children) >= count:
                return children
            time.sleep(0.01)
        raise AssertionError(f"{children} were started")

    yield started, build
    build.cancel()
    thread.join()
    assert len(stopped) == 1


def test_two_compile_side_by_side_and_end_when_it_is_cancelled(building, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    started, build = building
    children = started(2)
    assert len(children) == 2
    build.cancel()
    for child in children:
        # The build's own thread may be the one that hears of the end first.
        deadline = time.monotonic() + 10
        while child.exitcode is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert child.exitcode == -signal.SIGKILL
    assert build.is_needed


def test_without_a_second_processor_one_compiles_all(building, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    started, _ = building
    assert len(started(1)) == 1


@pytest.mark.slow
def test_they_end_with_a_parent_that_is_killed(nothing_compiled):
    code = (
        "import multiprocessing, threading, time\n"
        "from service.acquire.kernel_build import KernelBuild\n"
        "if __name__ == '__main__':\n"
        "    threading.Thread(target=KernelBuild().run, args=({},), daemon=True).start()\n"
        "    while not (children := multiprocessing.active_children()):\n"
        "        time.sleep(0.01)\n"
        "    print(children[0].pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.send_signal(signal.SIGKILL)
    for _ in range(300):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError(f"the process {pid} is still there")


@pytest.mark.parametrize("processors", [1, 2])
def test_every_kernel_is_compiled_by_one_child(processors):
    shares = kernel_build._shares(processors)
    assert len(shares) == processors
    named = [name for share in shares for name in (*share.zones, *share.whole_sky)]
    assert sorted(named) == sorted(IDENTIFIERS)
    assert all(IDENTIFIERS[name].searches_zone for share in shares for name in share.zones)
    assert [share.beside_batches for share in shares].count(True) == 1


def test_what_batches_with_a_zone_need_is_compiled_without_the_whole_sky(
    missions, sky, monkeypatch
):
    monkeypatch.setattr(SkyModel, "index", lambda *_: pytest.fail("the whole sky is searched"))
    zones = [name for share in kernel_build._shares(2) for name in share.zones]
    prewarm_kernels(SkyModel(sky.catalog, LruCache(64 << 20)), missions, zones)


SELDOM = """
from service.acquire.prewarm import build_sky_files, prewarm_kernels, prewarm_sky
from service.attitude.kernels import fit_attitude
from service.identify.attitude_from_matches import _matched_vectors
from service.identify.hypotheses.groups import _log_weight_of
from service.identify.voting.match_groups import _largest
from service.identify.voting.pair_tests import cast_votes, count_votes, name_rivals
from service.missions.mission import load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

zones = ["verified", "starid"]
prewarm_kernels(SkyModel(load_embedded(), LruCache(64 << 20)), load_missions(), zones, seldom=True)
of_votes = _largest, cast_votes, count_votes, name_rivals
others = fit_attitude, _matched_vectors, _log_weight_of
print(*(len(each.signatures) for each in (*others, *of_votes)))
"""


def test_what_few_batches_need_is_compiled_before_one_comes():
    """Two groups of stars, a misaligned tracker, match groups: each is once in its kernel."""
    done = subprocess.run([sys.executable, "-c", SELDOM], capture_output=True, check=True)
    assert done.stdout.split() == [b"1"] * 7


def _wait_between(missions, share, build_files, compiled, parent):
    """Instead of compiling: a child that goes on, or fails, when files in the folder say so."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    for stage in ("zones", "whole sky", "the rest"):
        while not (folder / f"go-on {stage}").exists():
            if (folder / "fail").exists():
                raise SystemExit(1)
            time.sleep(0.01)
        if stage != "the rest":
            compiled.send_bytes(stage.encode())


def _fail(missions, share, build_files, compiled, parent):
    raise SystemExit(1)


@pytest.mark.parametrize(
    "fails_after", [None, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))]
)
@pytest.mark.slow("None")
def test_each_kind_of_work_is_open_while_the_rest_is_compiled(
    nothing_compiled, monkeypatch, tmp_path, fails_after
):
    monkeypatch.setattr(kernel_build, "_compile", _wait_between)
    build, opened = KernelBuild(), []

    def go_on(stage):
        (tmp_path / ("fail" if len(opened) == fails_after else f"go-on {stage}")).touch()

    def zones_built():
        assert not build.zones_needed
        with pytest.raises(Busy, match="whole sky"):
            build.require_whole_sky()
        opened.append("zones")
        go_on("whole sky")

    def whole_sky_built():
        with pytest.raises(Busy, match="compiling"):
            build.require_built()
        opened.append("whole sky")
        go_on("the rest")

    assert build.zones_needed
    go_on("zones")
    if fails_after is None:
        build.run({}, zones_built, whole_sky_built)
        build.require_whole_sky()
        build.require_built()
        assert not KernelBuild().is_needed
    else:
        with pytest.raises(Busy, match="could not be compiled"):
            build.run({}, zones_built, whole_sky_built)
        assert build.is_needed
    assert opened == ["zones", "whole sky"][:fails_after]


def test_a_child_that_fails_before_its_zones_opens_nothing(nothing_compiled, monkeypatch):
    monkeypatch.setattr(kernel_build, "_compile", _fail)
    build = KernelBuild()
    with pytest.raises(Busy, match="could not be compiled"):
        build.run({}, lambda: pytest.fail("zones are not compiled"))
    assert build.zones_needed


def test_files_of_the_whole_sky_are_built_apart_and_opened_by_the_service(
    missions, sky, nothing_compiled, monkeypatch
):
    """In the service the building would hold the interpreter's lock, and batches would wait."""
    xte, now = missions["XTE"], parse_utc("2026-11-30T00:00:00Z")
    build_sky_files(None, [(xte, [now])])
    monkeypatch.setattr(model, "build_sky_index", lambda *_: pytest.fail("built again"))
    monkeypatch.setattr(model, "build_run_catalog", lambda *_: pytest.fail("built again"))
    prewarm_sky(SkyModel(sky.catalog, LruCache(64 << 20)), [xte], now)

"""How far the compiling of kernels is, from what it leaves in the cache."""

import logging
import os
import time
from pathlib import Path

import numba

from service.acquire import kernel_build as progress
from tests.waiting import wait_until


def test_what_this_machine_has_compiled_is_about_the_whole():
    folder = Path(numba.config.CACHE_DIR)
    assert {each.name.rpartition("_")[0] for each in folder.glob("*_*")} & set(progress.STEPS)
    # Tests compile for further kinds of arrays: never much less than what a first start does.
    assert progress.kernel_progress().share > 0.8


def test_with_nothing_compiled_no_time_is_foretold(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "none"))
    found = progress.kernel_progress()
    assert found.share == 0.0
    assert found.line(12.0) == "compiling kernels, zones and pairs: 0 %"


def test_the_step_is_that_of_the_newest_file(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    for second, name in enumerate(("sky_1", "lost_in_space_2")):
        (tmp_path / name).mkdir()
        file = tmp_path / name / "kernel.nbc"
        file.write_bytes(bytes(progress.KERNEL_BYTES // 4))
        os.utime(file, (second, second))
    (tmp_path / "complete").touch()
    found = progress.kernel_progress()
    assert (found.step, found.share) == ("search of the whole sky", 0.5)
    assert found.line(30.0).endswith("search of the whole sky: 50 %, about 30 s left")


def test_a_long_compiling_is_logged_and_ends_with_its_block(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(progress, "EVERY_S", 0.02)
    log = logging.getLogger("test")
    with caplog.at_level(logging.INFO, "test"), progress.progress_logged(log):
        wait_until(lambda: len(caplog.records) >= 2, why="nothing is logged")
    lines = len(caplog.records)
    assert caplog.records[0].getMessage().startswith("compiling kernels, ")
    time.sleep(0.1)
    assert len(caplog.records) == lines

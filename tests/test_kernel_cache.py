"""Compiled kernels are never older than the source."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import service

PACKAGE = Path(service.__file__).parent


def cache_of(package):
    """Where a process that imports this copy of the package keeps its kernels."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    asked = "import service, os; print(os.environ['NUMBA_CACHE_DIR'])"
    told = subprocess.run(
        [sys.executable, "-c", asked],
        cwd=package.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return Path(told.stdout.strip())


def test_an_edit_of_any_kernel_s_file_starts_a_new_cache(tmp_path):
    """numba alone would go on with what it compiled from the old file."""
    copy = tmp_path / "service"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    before = cache_of(copy)
    assert cache_of(copy) == before
    edited = copy / "identify" / "scene.py"
    edited.write_text(edited.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    assert cache_of(copy) != before


def test_every_kernel_lies_in_a_room_whose_files_are_watched():
    kernel = re.compile(r"^@(njit|borrowing|owning)\b", re.MULTILINE)
    holders = {path for path in PACKAGE.rglob("*.py") if kernel.search(path.read_text())}
    assert len(holders) > 20
    watched = [PACKAGE / place for place in service.KERNELS]
    assert all(any(path.is_relative_to(place) for place in watched) for path in holders)

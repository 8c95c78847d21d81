"""Compiled kernels are never older than the source."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import service
from service.compiled.cache import SOURCES

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
    edited = copy / "identify" / "hypotheses" / "scene.py"
    edited.write_text(edited.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    assert cache_of(copy) != before


def module_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_by(path, modules):
    """The modules of the service that a module imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = (f"{node.module}.{each.name}" for each in node.names)
            found |= {name if name in modules else node.module for name in names}
    return found & modules.keys()


def test_all_that_compiled_code_takes_in_is_part_of_the_state_of_the_source():
    """A constant or a function of any module that a kernel's module imports is compiled in."""
    modules = {module_of(path): path for path in PACKAGE.rglob("*.py")}
    kernel = re.compile(r"^@(njit|njit_no_refcount|njit_allocating)\b|= intrinsic\(", re.MULTILINE)
    waiting = [name for name, path in modules.items() if kernel.search(path.read_text())]
    assert len(waiting) > 20
    taken_in = set()
    while waiting:
        name = waiting.pop()
        if name not in taken_in:
            taken_in.add(name)
            waiting += imported_by(modules[name], modules)
    watched = [PACKAGE / source for source in SOURCES]
    outside = {
        name
        for name in taken_in
        if not any(modules[name].is_relative_to(place) for place in watched)
    }
    assert not outside
    assert all(place.exists() for place in watched)


def test_the_cache_is_set_too_where_numba_was_imported_first():
    told = subprocess.run(
        [sys.executable, "-c", "import numba, service; print(numba.config.CACHE_DIR)"],
        cwd=PACKAGE.parent,
        env={k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(told.stdout.strip()) == cache_of(PACKAGE)

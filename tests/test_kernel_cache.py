"""Compiled kernels are never older than the source."""

import ast
import hashlib
import os
import pickle
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core import caching

import service
from service.acquire.kernel_build import KernelBuild, mark_built
from service.compiled.cache import SOURCES, source_files
from service.compiled.checked_file import content_of
from service.compiled.jit import Kernel
from tests.scale import size

PACKAGE = Path(service.__file__).parent
DIGEST_BYTES = 32
"""Before the content of a file."""


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
    for name in ("service", "studies"):
        without = shutil.ignore_patterns("__pycache__")
        shutil.copytree(PACKAGE.parent / name, tmp_path / name, ignore=without)
    copy = tmp_path / "service"
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
    folders = (PACKAGE, PACKAGE.parent / "studies")
    modules = {module_of(path): path for each in folders for path in each.rglob("*.py")}
    kernel = re.compile(r"^@(njit|njit_no_refcount|njit_allocating)\b|= intrinsic\(", re.MULTILINE)
    waiting = [name for name, path in modules.items() if kernel.search(path.read_text())]
    assert len(waiting) > 20
    taken_in = set()
    while waiting:
        name = waiting.pop()
        if name not in taken_in:
            taken_in.add(name)
            waiting += imported_by(modules[name], modules)
    watched = [set(source_files(source)) for source in SOURCES]
    assert not {name for name in taken_in if modules[name] not in set().union(*watched)}
    assert all(watched)


def doubled(value):
    return 2 * value


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty folder of compiled kernels, and a function that calls one through it."""
    # numba reads a changed environment again when it first compiles something.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path, lambda: Kernel(doubled)(21)


def cut(content):
    return content[: len(content) // 2]


def flipped(content):
    place = len(content) // 2
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


@pytest.mark.parametrize("damaged", [cut, flipped, lambda _: b"", lambda each: bytes(len(each))])
@pytest.mark.parametrize("suffix", [".nbc", ".nbi"])
def test_a_damaged_kernel_is_removed_and_compiled_again(cache, caplog, suffix, damaged):
    folder, call = cache
    assert call() == 42
    mark_built()
    assert not KernelBuild().is_needed
    (file,) = folder.rglob(f"*{suffix}")
    whole = file.read_bytes()
    file.write_bytes(damaged(whole))
    assert call() == 42
    assert f"{file} is damaged" in caplog.text
    # numba numbers each function that it compiles; a number of more digits makes a longer file.
    assert content_of(file)
    caplog.clear()
    assert call() == 42
    assert not caplog.text
    # The build notices it too, before a service calls itself ready.
    file.write_bytes(damaged(whole))
    assert KernelBuild().is_needed
    assert not file.exists()


def test_whatever_is_damaged_in_a_cache_the_answer_is_right_and_the_cache_heals(
    cache, seed, figures
):
    """Cut, zeroed or flipped anywhere, or written by another version of numba."""
    rng, (folder, call) = random.Random(seed), cache
    assert call() == 42
    whole = {path: path.read_bytes() for path in folder.rglob("*.nb[ci]")}
    assert len(whole) == 2
    tries = size(200, 12)

    def other_version(content):
        version, *rest = pickle.loads(content[DIGEST_BYTES:])
        content = pickle.dumps((f"{version}.1", *rest))
        return hashlib.sha256(content).digest() + content

    for number in range(tries):
        path = rng.choice(sorted(whole))
        content = bytearray(whole[path])
        place = rng.randrange(len(content))
        match number % 4:
            case 0:
                del content[place:]
            case 1:
                content[place:] = bytes(len(content) - place)
            case 2:
                for _ in range(rng.randrange(1, 9)):
                    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
            case 3:
                path = next(each for each in whole if each.suffix == ".nbi")
                content = other_version(whole[path])
        path.write_bytes(content)
        assert call() == 42, (path, number)
        # What was compiled anew is kept: the next process loads it.
        assert {each: bool(content_of(each)) for each in folder.rglob("*.nb[ci]")} == (
            dict.fromkeys(whole, True)
        )
    figures(damaged=tries)


def test_a_cache_that_cannot_be_written_is_an_error_that_names_the_setting(monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/dev/null/kernels")
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [caching.UserProvidedCacheLocator])
    with pytest.raises(OSError, match="name a folder that this user can write in NUMBA_CACHE_DIR"):
        Kernel(doubled)


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

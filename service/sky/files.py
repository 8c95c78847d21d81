"""Memory-mapped files of run catalogs and whole-sky indexes, built by one process for all.

Files are in the folder of compiled kernels, named by the digest of all inputs. A file begins with
the digest of its content; a truncated or changed file is removed and built again. It is written
under another name and then renamed, so that a file that can be opened is complete.
"""

import fcntl
import hashlib
import json
import logging
import os
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.compiled.cache import source_digest

MOST_BYTES = 1 << 30
"""Largest total size of the folder; beyond it the least recently opened files are removed."""
LINE = 64
"""Alignment of arrays in a file, the size of a processor's cache line."""
_START = 2 * LINE
"""Offset of a file's head, after the digest of the rest and the length of the head."""
_DIGEST = hashlib.sha256

log = logging.getLogger(__name__)


class Content(NamedTuple):
    """The content of a sky file: JSON facts, and arrays by name."""

    facts: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]


def folder() -> Path:
    """The folder for the sky files that the present state of the source code makes."""
    return Path(os.environ["NUMBA_CACHE_DIR"]) / f"sky-{source_digest()[:16]}"


def is_kept(kind: str, key: Hashable) -> bool:
    """True if the sky file of some kind and key exists."""
    return _path(kind, key).exists()


def kept(kind: str, key: Hashable, build: Callable[[], Content]) -> Content:
    """The content of the sky file of some kind and key, mapped; built if it does not exist.

    One of several processes builds the file, and the others wait. If no file can be written, each
    process uses its own content as built.
    """
    path = _path(kind, key)
    content = _opened(path)
    if content is None:
        with _alone(path) as is_alone:
            content = _opened(path)
            if content is None:
                content = build()
                if is_alone and _write(path, content):
                    content = _opened(path) or content
    return content


def _path(kind: str, key: Hashable) -> Path:
    return folder() / f"{kind}-{_DIGEST(repr(key).encode()).hexdigest()[:24]}.npy"


def _opened(path: Path) -> Content | None:
    """The content of a sky file; None if it is missing or unreadable, or damaged and removed."""
    try:
        with path.open("rb") as file:
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
            digest = file.read(LINE)[: _DIGEST().digest_size]
            # Read instead of mapped: mapped pages would count as the process's own memory from then
            # on.
            is_whole = hashlib.file_digest(file, _DIGEST).digest() == digest
        if is_whole:
            with suppress(OSError):  # of another user, or not to be written
                os.utime(path)
            return _content(np.asarray(np.load(path, mmap_mode="r")))
    except OSError:
        return None  # not there, or not to be read now
    except ValueError:
        pass  # the header is damaged
    log.warning("%s is damaged: it is removed, and built again", path)
    with suppress(OSError):
        path.unlink()
    return None


def _content(block: npt.NDArray[np.uint8]) -> Content:
    head_bytes = int(block[LINE : LINE + 8].view(np.int64)[0])
    head = json.loads(block[_START : _START + head_bytes].tobytes())
    arrays = {}
    for name, (dtype, shape, first, last) in head["arrays"].items():
        arrays[name] = block[first:last].view(dtype).reshape(shape)
    return Content(head["facts"], arrays)


def _block(content: Content) -> npt.NDArray[np.uint8]:
    """The bytes of a sky file: digest, length of the head, head, and the arrays one by one."""
    arrays = {name: np.ascontiguousarray(array) for name, array in content.arrays.items()}
    # The head's length depends on the offsets of the arrays that follow, so space is reserved.
    at = _aligned(_START + len(json.dumps(content.facts)) + 200 * (1 + len(arrays)))
    places = {}
    for name, array in arrays.items():
        places[name] = (array.dtype.str, array.shape, at, at + array.nbytes)
        at = _aligned(at + array.nbytes)
    block = np.zeros(at, np.uint8)
    for name, array in arrays.items():
        _, _, first, last = places[name]
        block[first:last] = array.reshape(-1).view(np.uint8)
    head = np.frombuffer(
        json.dumps({"facts": content.facts, "arrays": places}).encode("ascii"), np.uint8
    )
    block[_START : _START + len(head)] = head
    block[LINE : LINE + 8].view(np.int64)[0] = len(head)
    digest = np.frombuffer(_DIGEST(block[LINE:].data).digest(), np.uint8)
    block[: len(digest)] = digest
    return block


def _aligned(at: int) -> int:
    return -(-at // LINE) * LINE


def _write(path: Path, content: Content) -> bool:
    """Write a sky file under another name and rename it; false if that fails."""
    beside = path.with_suffix(".new")
    try:
        block = _block(content)
        _make_room(path.parent, block.nbytes)
        with beside.open("wb") as file:
            header = {"descr": block.dtype.str, "fortran_order": False, "shape": block.shape}
            np.lib.format.write_array_header_1_0(file, header)
            file.write(block.data)
        beside.replace(path)
        return True
    except OSError as error:
        with suppress(OSError):
            beside.unlink()
        _warn(path.parent, error.strerror or str(error))
        return False


def _make_room(place: Path, nbytes: int) -> None:
    """Remove the least recently opened sky files until new bytes fit below the limit."""
    files = []
    for path in place.glob("*.npy"):
        with suppress(FileNotFoundError):  # removed by another process
            state = path.stat()
            files.append((state.st_mtime, state.st_size, path))
    excess = nbytes + sum(size for _, size, _ in files) - MOST_BYTES
    for _, size, path in sorted(files):
        if excess <= 0:
            break
        path.unlink(missing_ok=True)
        excess -= size


@contextmanager
def _alone(path: Path) -> Iterator[bool]:
    """Context manager that locks the build of a file for this process; yields false if it fails."""
    with ExitStack() as stack:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context(path.with_suffix(".lock").open("wb"))
            fcntl.flock(lock, fcntl.LOCK_EX)
            is_alone = True
        except OSError as error:
            _warn(path.parent, error.strerror or str(error))
            is_alone = False
        yield is_alone


@cache
def _warn(place: Path, reason: str) -> None:
    """Log a warning, once, that files cannot be stored."""
    log.warning(
        "the sky cannot be kept in %s (%s): each process builds its own, which takes seconds "
        "of its start and more memory",
        *(place, reason),
    )

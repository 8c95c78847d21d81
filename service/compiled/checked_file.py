"""numba's cache files of compiled kernels, protected by digests of their content.

A truncated or changed file would cause a traceback at each start, or wrong machine code. Such a
file is removed, and its kernel compiled again.
"""

import hashlib
import logging
import pickle
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile
from numba.core.serialize import dumps

SUFFIXES = (".nbi", ".nbc")
_DIGEST = hashlib.sha256
_BYTES = _DIGEST().digest_size

log = logging.getLogger(__name__)


class CheckedFile(IndexDataCacheFile):
    """The cache files of one kernel, its index and its data, with checked digests."""

    def _load_index(self) -> Any:
        try:
            content = content_of(Path(self._index_path))
        except FileNotFoundError:
            return {}
        version, stamp, overloads = pickle.loads(content)
        return overloads if (version, stamp) == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: Any) -> None:
        self._write(self._index_path, (self._version, self._source_stamp, overloads))

    def _load_data(self, name: str) -> Any:
        return pickle.loads(content_of(self._path(name)))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._path(name), data)

    def _path(self, name: str) -> Path:
        return Path(self._cache_path, name)

    def _write(self, path: str | Path, value: Any) -> None:
        content = dumps(value)  # type: ignore[no-untyped-call]
        with self._open_for_write(str(path)) as file:
            file.write(_DIGEST(content).digest() + content)


def content_of(path: Path) -> bytes:
    """Content of a cache file; raises `FileNotFoundError` for a damaged one, which is removed."""
    written = path.read_bytes()
    digest, content = written[:_BYTES], written[_BYTES:]
    if _DIGEST(content).digest() == digest:
        return content
    log.warning("%s is damaged: it is removed, and its kernel compiled again", path)
    path.unlink(missing_ok=True)
    raise FileNotFoundError(path)


def count_whole(folder: Path) -> int:
    """The number of intact kernel files in a folder; damaged ones are removed."""
    count = 0
    for path in folder.rglob("*"):
        if path.suffix in SUFFIXES:
            try:
                content_of(path)
                count += 1
            except FileNotFoundError:
                pass
    return count

"""Start of child processes with the code of this process, never code in the current folder.

Python puts the current folder first on the module search path of `python -c` and `python -m`, with
which the standard library starts its fork server and its spawned processes.
"""

import hashlib
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from service import __version__
from service.errors import BadConfiguration

_PACKAGE = Path(__file__).resolve().parent
_SAFE_PATH = "PYTHONSAFEPATH"
_lock = threading.RLock()


@contextmanager
def safe_path() -> Iterator[None]:
    """Keep the current folder off the search path of Python processes started in a `with` block.

    The environment of this process carries the setting; other threads may see it meanwhile.
    """
    with _lock:
        before = os.environ.get(_SAFE_PATH)
        os.environ[_SAFE_PATH] = "1"
        try:
            yield
        finally:
            if before is None:
                del os.environ[_SAFE_PATH]
            else:
                os.environ[_SAFE_PATH] = before


def command_of(module: str) -> list[str]:
    """Command line that runs a module as `python -m` does, with this process's search path."""
    paths = [os.path.abspath(path) for path in sys.path]
    code = f"import sys; sys.path[:] = {paths!r}; import runpy; "
    code += f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    return [sys.executable, "-P", "-c", code]


@dataclass(frozen=True)
class Source:
    """Identity of a process's code: version, digest and folder; equal for equal code."""

    version: str
    sha256: str
    folder: str = field(compare=False)

    def __str__(self) -> str:
        return f"service {self.version} of {self.folder} (source {self.sha256[:16]})"


@cache
def own_source() -> Source:
    """Identity of the code that this process runs, from its files at the first call."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return Source(__version__, digest.hexdigest(), str(_PACKAGE))


def require_source(parent: Source) -> None:
    """Raise `BadConfiguration` if this worker process runs other code than its parent."""
    if own_source() != parent:
        raise BadConfiguration(
            f"a worker process runs {own_source()}, and its parent {parent}: restart the parent, "
            "and install the same version wherever workers run"
        )

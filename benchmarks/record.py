"""Which code a figure was measured with, and whether that is today's code.

A record holds the commit, a digest of the source files that the figures depend
on, and the versions of the libraries that compute them.  A section is stale when
the digest of the same files is another one today.
"""

import ast
import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("numpy", "numba", "scipy")

CORE = (
    "catalogs/stars.npz",
    "service/acquire",
    "service/attitude",
    "service/identify",
    "service/missions",
    "service/observations",
    "service/sky",
    "service/times.py",
    "service/compiled",
    "service/vectors.py",
)
"""What the answer to a batch depends on.  `:!` leaves out a file or a folder, as in git."""
SIMULATOR = ("service/simulate", "tests/reference")
IMAGING = (
    "service/features/pictures/centroids",
    "service/features/pictures/detection",
    "service/features/pictures/frames",
    "service/features/pictures/kernels.py",
    "service/features/pictures/tracker/overlay.py",
    "service/features/pictures/tracker/submit.py",
    "studies/star_image_report",
    "studies/documents.py",
    "service/observations/scans/lines.py",
)
SERVICE = ("service", "catalogs/stars.npz")

_RECORD = re.compile(
    r"commit (?P<commit>[\w-]+); sources (?P<sources>[0-9a-f]{16}); (?P<versions>[^;]+)"
)


@dataclass(frozen=True)
class Record:
    """The code that a figure was measured with.  `sources` is a digest."""

    commit: str
    sources: str
    versions: str

    def __str__(self) -> str:
        return f"commit {self.commit}; sources {self.sources}; {self.versions}"

    @property
    def sentence(self) -> str:
        """The record as a page shows it."""
        return f"Measured at commit {self.commit} with {self.versions}."


def record_of(sources: Iterable[str]) -> Record:
    """The record of figures that are measured now and depend on these files."""
    used = tuple(sources)
    versions = [f"Python {platform.python_version()}", *(f"{p} {version(p)}" for p in PACKAGES)]
    return Record(commit_of(used), digest_of(used), ", ".join(versions))


def read_record(text: str) -> Record | None:
    """The first record that a text holds; None where it holds none."""
    found = _RECORD.search(text)
    return Record(found["commit"], found["sources"], found["versions"]) if found else None


def commit_of(sources: Sequence[str]) -> str:
    """The commit that is checked out, with `-dirty` where these files differ from it.

    `unknown` where there is no repository, as in an unpacked archive.
    """
    try:
        commit = _git("rev-parse", "--short=12", "HEAD").strip()
        changed = _git("status", "--porcelain", "--", *sources)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}-dirty" if changed else commit


def digest_of(sources: Iterable[str]) -> str:
    """A digest of files and of all files in folders, by their paths and their contents.

    The content of a Python file is its syntax: other comments, docstrings or lines measure nothing
    else.
    """
    digest, used = hashlib.sha256(), list(sources)
    left_out = [ROOT / each.removeprefix(":!") for each in used if each.startswith(":!")]
    found = {path for each in used if not each.startswith(":!") for path in _files(ROOT / each)}
    for path in sorted(found):
        if any(path.is_relative_to(each) for each in left_out):
            continue
        digest.update(f"{os.path.relpath(path, ROOT)}\0".encode())
        digest.update(_content_digest(path.read_bytes(), path.suffix))
    return digest.hexdigest()[:16]


@cache
def _content_digest(content: bytes, suffix: str) -> bytes:
    if suffix == ".py":
        content = repr(_syntax(ast.parse(content))).encode()
    return hashlib.sha256(content).digest()


def _syntax(node: object) -> object:
    """Syntax without texts that stand alone, and without empty fields.

    `ast.dump` shows empty fields or leaves them out, which depends on the version of Python.
    """
    if isinstance(node, list):
        return [_syntax(each) for each in node if not _is_lone_text(each)]
    if not isinstance(node, ast.AST):
        return node
    fields = [(name, _syntax(value)) for name, value in ast.iter_fields(node)]
    return type(node).__name__, [each for each in fields if each[1] not in (None, [])]


def _is_lone_text(node: object) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _files(source: Path) -> Iterator[Path]:
    if source.is_file():
        yield source
    elif source.is_dir():
        # Compiled code and what the system leaves behind are no sources.
        for path in source.rglob("*"):
            if path.suffix in {".py", ".toml", ".json", ".npz", ".csv"} and path.is_file():
                yield path
    else:
        raise FileNotFoundError(f"no such source: {source}")


def _git(*arguments: str) -> str:
    ran = subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True, timeout=30
    )
    return ran.stdout

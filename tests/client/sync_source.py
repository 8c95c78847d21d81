"""Writes the synchronous client from the asynchronous one: python -m tests.client.sync_source

As httpcore does it: the words of asyncio are replaced, and ruff formats what is left.  Only
`backend.py` is written by hand for both.
"""

import re
import subprocess
import sys
from pathlib import Path

CLIENT = Path(__file__).parents[2] / "client" / "acquire_client"
BY_HAND = ("__init__.py", "backend.py")
WORDS = [
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        (r"\basync (def|for|with)\b", r"\1"),
        (r"\bawait ", ""),
        (r"\bAsyncGenerator\[(.*), None\]", r"Generator[\1, None, None]"),
        (r"\bAsync([A-Z]\w*)", r"\1"),
        (r"\basynccontextmanager\b", "contextmanager"),
        (r"\b__a(enter|exit|iter|next)__\b", r"__\1__"),
        (r"\ba(close|closing|read|iter_bytes)\b", r"\1"),
    )
]
LOOPS_THAT_ARE_ONE_CALL = [
    "check",
    "--quiet",
    "--fix-only",
    "--unsafe-fixes",
    "--select=C4,I,UP028",
]


def sources():
    """The modules that are written for asyncio."""
    return [path for path in sorted((CLIENT / "_async").glob("*.py")) if path.name not in BY_HAND]


def synchronous(path):
    """The synchronous form of a module."""
    text = path.read_text(encoding="utf-8")
    for pattern, replacement in WORDS:
        text = pattern.sub(replacement, text)
    for step in (LOOPS_THAT_ARE_ONE_CALL, ["format"]):
        command = [sys.executable, "-m", "ruff", *step, "--stdin-filename", target(path), "-"]
        ran = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
        text = ran.stdout
    return text


def target(path):
    return CLIENT / "_sync" / path.name


if __name__ == "__main__":
    for each in sources():
        target(each).write_text(synchronous(each), encoding="utf-8")

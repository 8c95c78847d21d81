"""Servers of two versions, each from its own source tree and with its own database."""

import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

HERE = Path(__file__).resolve().parents[2]
"""Root folder of the present source tree."""
KEPT = HERE / ".compare"
"""Folder of reports and of other versions by commit, with their compiled kernels."""
START_S = 300.0
STOP_S = 60.0
ANSWER_S = 300.0
"""Time limit in seconds of an answer, enough for a busy machine."""


def commit_of(name: str) -> str:
    """Full id of a commit; raises `SystemExit` if it does not exist."""
    command = ["git", "rev-parse", "--verify", "--quiet", f"{name}^{{commit}}"]
    found = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    if found.returncode:
        raise SystemExit(f"{name}: no such commit")
    return found.stdout.strip()


def checked_out(commit: str) -> Path:
    """Source tree of a commit under `KEPT`; an existing one is used again."""
    tree = KEPT / commit
    if not tree.is_dir():
        partial = KEPT / f"{commit}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        archive = subprocess.run(
            ["git", "archive", commit], cwd=HERE, capture_output=True, check=True
        )
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
            files.extractall(partial, filter="data")
        partial.rename(tree)
    return tree


def compile_kernels(tree: Path) -> None:
    """Compile the kernels of a source tree: minutes the first time, seconds later."""
    command = ["service.cli", "prepare"]
    if not (tree / "service" / "sky" / "files.py").exists():
        command = ["service.acquire.prewarm"]  # as it was called before
    subprocess.run([sys.executable, "-m", *command], cwd=tree, env=_environment(), check=True)


@contextmanager
def served(tree: Path, folder: Path, missions: Path) -> Iterator[httpx.Client]:
    """Client of `acquire serve` from a source tree, with a new database in `folder`."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    command += ["--database", f"sqlite:///{folder / 'compared.db'}"]
    log = folder / "serve.log"
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            command,
            cwd=tree,
            env=_environment(ACQUIRE_MISSIONS=str(missions)),
            stdout=stderr,
            stderr=stderr,
        )
    limits = httpx.Limits(max_connections=32)
    try:
        with httpx.Client(
            base_url=f"http://127.0.0.1:{port}", timeout=ANSWER_S, limits=limits
        ) as client:
            _await_ready(client, process, log)
            yield client
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _environment(**more: str) -> dict[str, str]:
    """Environment of this process without settings of the service, module paths and kernel folder.

    Each version has its own kernels.
    """
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("ACQUIRE_") and name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")
    }
    return kept | more


def _await_ready(client: httpx.Client, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            if client.get("/readyz").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise SystemExit(f"the server did not become ready:\n{log.read_text(errors='replace')}")

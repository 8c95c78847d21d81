"""Two versions of the service, each served from its own tree over a database of its own."""

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
"""This tree."""
KEPT = HERE / ".compare"
"""Other versions by commit, with the kernels that were compiled for them, and reports."""
START_S = 300.0
STOP_S = 60.0
ANSWER_S = 300.0
"""Long enough on a machine that does much else."""


def commit_of(name: str) -> str:
    """The full name of a commit; raises `SystemExit` where there is none."""
    command = ["git", "rev-parse", "--verify", "--quiet", f"{name}^{{commit}}"]
    found = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    if found.returncode:
        raise SystemExit(f"{name}: no such commit")
    return found.stdout.strip()


def checked_out(commit: str) -> Path:
    """The tree of a commit, under `KEPT`; what is there already is used again."""
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
    """Compile what the first requests would wait for: minutes, or seconds when it was done."""
    command = ["service.cli", "prepare"]
    if not (tree / "service" / "sky" / "files.py").exists():
        command = ["service.acquire.prewarm"]  # as it was called before
    subprocess.run([sys.executable, "-m", *command], cwd=tree, env=_environment(), check=True)


@contextmanager
def served(tree: Path, folder: Path, missions: Path) -> Iterator[httpx.Client]:
    """`acquire serve` of a tree over a new database in `folder`; a client that talks to it."""
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
    """This process's own, without settings of the service and without other places of modules.

    Nor of kernels: each version has its own.
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

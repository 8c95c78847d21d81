"""Installs the wheel in an empty environment of each supported Python, and runs it there.

    python -m tests.pythons                  every supported version that this machine has
    python -m tests.pythons 3.12 3.13        these
    python -m tests.pythons /opt/python3.13  an interpreter
    python -m tests.pythons --require 3.13   fails where one of them is not there

For each: the packages of requirements.lock with their hashes, the wheel, `pip check`, the
migrations on an empty database, the demo, which compiles the kernels, serves, replays three
missions over HTTP and prints their rates, and a worker that is killed over a chunk, since the
standard executors of the versions differ in what they lock then.  Three to six minutes a version,
nearly all of it compiling.  It needs the package index.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from tqdm import tqdm

CHECKOUT = Path(__file__).parents[1]
UV = Path(sys.executable).parent / "uv"
BATCHES = 20
KILLED_WORKER = """
import os
import signal
import time

from service.ingest.local_workers import LocalWorkers
from service.ingest.worker_process import WorkerConfig
from service.missions.mission import load_missions
from service.sky.catalog.star_catalog import load_embedded

GIVE_UP_S = 120.0


def half_a_second(solver, number):
    time.sleep(0.5)
    return [number]


if __name__ == "__main__":
    config = WorkerConfig(load_missions(), None, load_embedded().digest, 1 << 20)
    workers = LocalWorkers(config, half_a_second, 2)
    assert workers.submit(0).result(GIVE_UP_S) == [0]
    futures = [workers.submit(number) for number in range(4)]
    os.kill(min(workers.pids), signal.SIGKILL)
    assert [each.result(GIVE_UP_S) for each in futures] == [[0], [1], [2], [3]]
    workers.close()
"""
PREFIX = "Programming Language :: Python :: 3."


def supported() -> list[str]:
    """The versions that pyproject.toml names."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))["project"]
    return [
        "3." + name.removeprefix(PREFIX)
        for name in project["classifiers"]
        if name.startswith(PREFIX)
    ]


def is_there(version: str) -> bool:
    """Whether this machine has a Python of the version."""
    command = [UV, "python", "find", "--quiet", "--no-python-downloads", version]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def try_version(version: str, folder: Path) -> dict[str, object]:
    """Install and run in a folder that is empty; the demo's figures."""
    home = folder / Path(version).name
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("ACQUIRE_", "PYTHON"))}
    python = str(home / "env" / "bin" / "python")

    def run(*command: object) -> str:
        done = subprocess.run(
            [str(part) for part in command],
            cwd=home,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{command[0]} {command[1]}: {(done.stderr or done.stdout)[-2000:]}")
        return done.stdout

    begun = time.monotonic()
    run(UV, "venv", "--quiet", "--no-python-downloads", "--python", version, home / "env")
    lock = CHECKOUT / "requirements.lock"
    pip = (UV, "pip", "install", "--quiet", "--python", python)
    run(*pip, "--require-hashes", "--requirement", lock)
    run(*pip, "--no-deps", *(folder.glob("*.whl")))
    run(UV, "pip", "check", "--quiet", "--python", python)
    acquire = home / "env" / "bin" / "acquire"
    run(acquire, "database", "check", "--fresh")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    demo = run(acquire, "demo", "--once", "--json", "--batches", BATCHES, "--port", port)
    script = home / "killed_worker.py"
    script.write_text(KILLED_WORKER, "utf-8")
    run("timeout", "600", python, script)
    return {"seconds": round(time.monotonic() - begun), "demo": json.loads(demo)}


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.pythons",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "version",
        nargs="*",
        help="versions, or paths of interpreters; default: what pyproject.toml names",
    )
    parser.add_argument("--require", action="store_true", help="fail where a version is missing")
    parsed = parser.parse_args()
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        build = [UV, "build", "--wheel", "--no-build-isolation", "--quiet", "--offline"]
        named = os.environ | {"UV_PYTHON": sys.executable}
        subprocess.run([*build, f"--out-dir={folder}", CHECKOUT], check=True, env=named)
        for version in tqdm(parsed.version or supported(), unit="version", disable=None):
            if not is_there(version):
                tqdm.write(f"Python {version}: not on this machine")
                failed += [version] * parsed.require
                continue
            try:
                found = try_version(version, Path(folder))
            except RuntimeError as error:
                tqdm.write(f"Python {version}: FAILED: {error}")
                failed.append(version)
            else:
                tqdm.write(f"Python {version}: {json.dumps(found)[:1500]}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

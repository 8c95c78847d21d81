"""No command runs code of the folder that it is started in, in whatever process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from service import child_processes
from service.errors import BadConfiguration
from service.ingest.worker_process import WorkerConfig
from tests.fresh_databases import sqlite_at
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.serving import free_port

ACQUIRE = Path(sys.executable).with_name("acquire")
TRAP = """
import pathlib
pathlib.Path(__file__).with_name("imported-" + __name__.partition(".")[0]).touch()
raise RuntimeError("code of the current folder runs")
"""
PACKAGES = ("service", "numpy", "studies", "spiceypy")
MODULES = ("json", "multiprocessing", "pickle", "encodings", "sitecustomize")
SECONDS = 600.0


@pytest.fixture
def hostile(tmp_path):
    """A folder of modules that leave a file when they are imported, named as ours and Python's."""
    folder = tmp_path / "hostile"
    for name in PACKAGES:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(TRAP.replace(".with_name", ".parent.with_name"))
    for name in MODULES:
        (folder / f"{name}.py").write_text(TRAP)
    return folder


@pytest.fixture
def run(hostile):
    """Run a command in the hostile folder; its output."""

    def run(*arguments):
        command = [str(ACQUIRE), *map(str, arguments)]
        done = subprocess.run(
            command, cwd=hostile, capture_output=True, text=True, timeout=SECONDS, check=False
        )
        assert imported(hostile) == [], done.stderr
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def imported(folder):
    return sorted(path.name for path in folder.glob("imported-*"))


def test_the_hostile_folder_is_noticed_where_python_imports_from_it(hostile):
    for module in (*PACKAGES, *MODULES):
        # `-c` is how the standard library starts its fork server.
        command = [sys.executable, "-S", "-c", f"import sys; sys.modules.pop({module!r}, None); "]
        command[-1] += f"import {module}"
        subprocess.run(command, cwd=hostile, capture_output=True, timeout=SECONDS, check=False)
    assert imported(hostile) == sorted(f"imported-{name}" for name in (*PACKAGES, *MODULES))


def test_workers_of_reprocessing_run_the_code_of_the_command(run, tmp_path, sky, missions):
    batches = tmp_path / "pass.ndjson"
    batches.write_text("".join(f"{samples.batch(sky, missions, str(n))}\n" for n in range(8)))
    database = ("--database", sqlite_at(tmp_path / "acquire.db"))
    run("replay", batches, "--in-process", "--run", "first", *database)
    chosen = ("--source", "first", "--run", "again", "--no-comparison", "--quiet")
    run("reprocess", *chosen, "--processes", "2", *database)
    exported = tmp_path / "attitude.bc"
    arguments = ("--spacecraft", "XTE", "--run", "again", "--format", "ck", "--output", exported)
    run("export", "attitude", *arguments, *database)


def test_processes_of_a_simulation_run_the_code_of_the_command(run):
    run("simulate", "mission", "XTE", "--stars", "2000", "--processes", "2", "--quiet")


def test_the_server_of_a_demonstration_runs_the_code_of_the_command(run, tmp_path):
    run("demo", "--folder", tmp_path / "demo", "--once", "--batches", "20", "--port", free_port())


@pytest.mark.slow
def test_processes_that_compile_kernels_run_the_code_of_the_service(hostile, tmp_path):
    """A service with an empty folder of kernels starts them; they need not end."""
    kernels = tmp_path / "kernels"
    command = [str(ACQUIRE), "serve", "--port", str(free_port())]
    command += ["--database", sqlite_at(tmp_path / "acquire.db")]
    with subprocess.Popen(
        command,
        cwd=hostile,
        env=os.environ | {"NUMBA_CACHE_DIR": str(kernels)},
        stderr=subprocess.DEVNULL,
    ) as serving:
        try:
            wait_until(lambda: imported(hostile) or list(kernels.glob("*/*.nbc")), SECONDS)
        finally:
            serving.terminate()
    assert imported(hostile) == []


def test_a_worker_of_other_code_refuses_and_names_both(missions, sky, monkeypatch):
    config = WorkerConfig(missions, None, sky.catalog.digest, 1 << 20)
    other = child_processes.Source("0.1.9", 64 * "a", "/opt/other/service")
    monkeypatch.setattr(child_processes, "own_source", lambda: other)
    with pytest.raises(BadConfiguration, match=r"0\.1\.9 of /opt/other/service.*parent service"):
        config.solver()

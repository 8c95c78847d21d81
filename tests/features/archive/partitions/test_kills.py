"""Whoever computes a partition, and whatever is killed or full: every batch once, byte-equal."""

import shutil
import subprocess
import sys
from contextlib import ExitStack

import pytest

from service.errors import BadConfiguration
from service.features.archive import partition_coordinator
from service.features.archive.folder import manifests
from service.features.archive.part import Reprocessings
from tests.features.archive.partitions.checks import assert_whole, files_of
from tests.features.archive.partitions.processes import (
    CHECKOUT,
    WAIT_S,
    begin_command,
    dask_worker,
    end,
    kill_a_child,
    run_command,
    scheduler,
)
from tests.fresh_databases import sqlite_at
from tests.scale import size
from tests.storage.test_faulty_disk import faulty_disk
from tests.waiting import wait_until

__all__ = ["faulty_disk"]

FULL_DISK = "tests.features.archive.partitions.full_disk"
WORKER_KILLS, COORDINATOR_KILLS, FAULTS = 200, 20, 50
MOST_BATCHES = partition_coordinator.MOST_BATCHES


@pytest.fixture
def database(tmp_path):
    """On SQLite alone: workers never see the database."""
    return sqlite_at(tmp_path / "acquire.db")


@pytest.fixture
def folders(archived, place, tmp_path, database):
    """Copies of one archive and its database: makes a new one."""
    archived.close()
    file = tmp_path / "acquire.db"
    made = []

    def copied():
        folder = tmp_path / f"copy-{len(made)}"
        folder.mkdir()
        made.append(folder)
        shutil.copytree(place, folder / "archive")
        for each in tmp_path.glob("acquire.db*"):
            shutil.copy(each, folder / each.name)
        return f"sqlite:///{folder / file.name}", folder / "archive"

    return copied


@pytest.fixture
def undisturbed(folders, opened, monkeypatch):
    """The parts that a single process makes of all, as large as the commands make them."""
    database, place = folders()
    monkeypatch.setattr(partition_coordinator, "MOST_BATCHES", MOST_BATCHES)
    app = opened(database=database, archive_folder=place)
    app.part(Reprocessings).reprocess("again", place, processes=1)
    app.close()
    return files_of(place, "again")


@pytest.fixture
def check(opened):
    """Checks a run of a copy, whose parts must be the undisturbed ones."""

    def whole(database, place, undisturbed):
        assert files_of(place, "again") == undisturbed
        app = opened(database=database, archive_folder=place)
        assert_whole(app, place)

    return whole


def named(place):
    return sum(part.run == "again" for each in manifests(place) for part in each.parts)


def wait_for_parts(place, count, process):
    """Wait for so many parts of the run, or for the end of the process."""
    wait_until(
        lambda: named(place) >= count or process.poll() is not None,
        WAIT_S,
        why=f"there are not {count} parts",
    )


@pytest.mark.slow
def test_a_dask_scheduler_whose_workers_come_and_go_makes_the_same_bytes(
    folders, undisturbed, check, tmp_path
):
    database, place = folders()
    with scheduler(tmp_path) as address, ExitStack() as workers:
        command = begin_command(database, place, scheduler=address)
        first = workers.enter_context(dask_worker(address))
        wait_for_parts(place, 2, command)
        workers.enter_context(dask_worker(address))
        wait_for_parts(place, 4, command)
        end(first)
        output, complaints = command.communicate(timeout=300)
    assert command.returncode == 0, complaints
    assert "use tls://" in complaints
    assert "72 recorded, 0 there already, 0 refused" in output
    check(database, place, undisturbed)


@pytest.mark.slow
def test_a_scheduler_that_goes_is_told_and_the_rest_is_done_without(
    folders, undisturbed, check, tmp_path
):
    database, place = folders()
    with scheduler(tmp_path) as address, dask_worker(address):
        command = begin_command(database, place, scheduler=address)
        wait_for_parts(place, 2, command)
    _, complaints = command.communicate(timeout=300)
    assert command.returncode == 2
    assert "run the command again" in complaints
    assert "Traceback" not in complaints
    run_command(database, place, processes=1)
    check(database, place, undisturbed)


@pytest.mark.parametrize("package", ["attitude-acquisition", "numba", "numpy", "pyarrow"])
def test_a_worker_of_another_version_is_refused(missions, package):
    from service.features.archive import dask_workers
    from service.ingest.worker_process import WorkerConfig

    versions = dask_workers.versions() | {package: "1.0"}
    with pytest.raises(BadConfiguration, match=rf"a worker has {package} .*, and the command 1\.0"):
        dask_workers.do_task(b"", versions, None)
    config = WorkerConfig(missions, None, "sha256:another", 1 << 20)
    import pickle

    with pytest.raises(BadConfiguration, match="the file has changed"):
        dask_workers._solver_of(pickle.dumps(config))


@pytest.mark.slow
@pytest.mark.torture
def test_after_every_kill_of_a_worker_each_partition_is_there_once(
    folders, undisturbed, check, rng, figures
):
    kills, rounds = 0, 0
    while kills < size(WORKER_KILLS):
        database, place = folders()
        rounds += 1
        command = begin_command(database, place, processes=2)
        while command.poll() is None and kills < size(WORKER_KILLS):
            before = named(place) + float(rng.uniform(0.0, 2.0))
            wait_for_parts(place, before, command)
            kills += kill_a_child(command.pid, rng)
        _, complaints = command.communicate(timeout=600)
        if command.returncode:
            # Two processes died over one partition.
            assert "run the command again" in complaints
        run_command(database, place, processes=2)
        check(database, place, undisturbed)
    figures(kills=kills, rounds=rounds)


@pytest.mark.slow
@pytest.mark.torture
def test_after_every_kill_of_the_command_each_partition_is_there_once(
    folders, undisturbed, check, rng, figures
):
    kills = 0
    while kills < size(COORDINATOR_KILLS):
        database, place = folders()
        while named(place) < len(undisturbed):
            command = begin_command(database, place, processes=int(rng.integers(1, 3)))
            before = named(place) + int(rng.integers(0, 4))
            wait_for_parts(place, before + 1, command)
            kills += end(command)
        run_command(database, place, processes=2)
        check(database, place, undisturbed)
    figures(kills=kills)


@pytest.mark.slow
@pytest.mark.torture
def test_a_full_disk_stops_it_with_a_message_and_it_goes_on(
    folders, undisturbed, check, faulty_disk, rng, figures
):
    """Whatever write to the archive is the one that fails."""
    faults = 0
    while faults < size(FAULTS):
        database, place = folders()
        ended_well = False
        while not ended_well:
            after = str(int(rng.integers(0, 40)))
            ran = subprocess.run(
                [
                    sys.executable,
                    "-m",
                    FULL_DISK,
                    database,
                    place,
                    after,
                ],
                env={"LD_PRELOAD": str(faulty_disk), "FAULTY_FOLDER": str(place)} | environment(),
                cwd=CHECKOUT,
                capture_output=True,
                text=True,
                check=False,
            )
            ended_well = ran.returncode == 0
            faults += not ended_well
            if not ended_well:
                assert ran.returncode == 2, ran.stderr
                assert "No space left on device" in ran.stderr
                assert "Traceback" not in ran.stderr
        check(database, place, undisturbed)
    figures(faults=faults)


def environment():
    """That of this process without the service's own settings."""
    import os

    return {name: text for name, text in os.environ.items() if not name.startswith("ACQUIRE_")}

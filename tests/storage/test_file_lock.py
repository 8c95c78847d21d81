"""One process at a time writes to a SQLite file, by whatever name it is opened."""

import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

from service.errors import BadConfiguration
from service.storage.sql.database_file import DatabaseFile, FileLock, is_written
from service.storage.sql.migrations import revision_of, upgrade
from service.storage.store import Store
from tests.fresh_databases import sqlite_at
from tests.scale import size

HOLDING = """
import sys
from pathlib import Path
from service.storage.sql.database_file import FileLock
from service.storage.sql.database_file import DatabaseFile
lock = FileLock(DatabaseFile(Path(sys.argv[1])))
lock.take()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def file(tmp_path):
    sqlite_at(tmp_path / "acquire.db")
    return tmp_path / "acquire.db"


@pytest.fixture
def holder(file):
    """A process that writes to the file."""
    command = [sys.executable, "-c", HOLDING, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"held\n"
        yield process
        process.kill()


def change(store):
    store.writer.change(lambda connection: connection.exec_driver_sql("SELECT 1"))


@pytest.mark.parametrize("name", ["acquire.db", "symbolic.db", "folder/hard.db"])
def test_a_second_process_that_writes_is_refused_by_any_name_and_told_which_is_first(
    file, holder, tmp_path, name
):
    (tmp_path / "folder").mkdir()
    (tmp_path / "symbolic.db").symlink_to(file)
    os.link(file, tmp_path / "folder" / "hard.db")
    database = f"sqlite:///{tmp_path / name}"
    with pytest.raises(BadConfiguration, match=f"process {holder.pid} .*writes to it"):
        Store(database, serving=True)
    store = Store(database)
    try:
        with store.reading() as connection:
            assert connection.exec_driver_sql("SELECT last FROM event_counter").scalar() == 0
        with pytest.raises(BadConfiguration, match=f"process {holder.pid} "):
            change(store)
    finally:
        store.close()
    assert is_written(DatabaseFile(tmp_path / name))


def test_the_lock_ends_with_the_process_that_has_it(file, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert not is_written(DatabaseFile(file))
    store = Store(f"sqlite:///{file}", serving=True)
    change(store)
    store.close()
    change_again = Store(f"sqlite:///{file}")
    change(change_again)
    change_again.close()


def test_a_schema_is_not_changed_while_another_process_writes(tmp_path):
    place = DatabaseFile(tmp_path / "new.db")
    lock = FileLock(place)
    lock.take()
    try:
        for begin in (upgrade, Store):
            with pytest.raises(BadConfiguration, match="one process at a time"):
                begin(f"sqlite:///{place.path}")
        assert revision_of(f"sqlite:///{place.path}") is None
    finally:
        lock.release()


def _try(url, ready, begun, results):
    ready.release()
    begun.wait()
    try:
        # As a service does.
        Store(url, serving=True)
    except BadConfiguration:
        results.put(False)
    else:
        results.put(True)
        # Held until the other one has tried.
        signal.pause()


def test_of_two_that_start_at_the_same_moment_one_is_always_refused(tmp_path):
    fork = multiprocessing.get_context("fork")
    for each in range(size(100, 5)):
        ready, begun, results = fork.Semaphore(0), fork.Event(), fork.Queue()
        url = sqlite_at(tmp_path / f"{each}.db")
        two = [fork.Process(target=_try, args=(url, ready, begun, results)) for _ in range(2)]
        for process in two:
            process.start()
        for _ in two:
            ready.acquire()
        begun.set()
        taken = sorted(results.get() for _ in two)
        for process in two:
            process.kill()
            process.join()
        assert taken == [False, True]

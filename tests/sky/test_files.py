"""The sky as files: built once, as it would be built anew, and done without where need be."""

import logging
import mmap
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.errors import BadInput, Fault
from service.sky import files
from service.sky.cache import LruCache
from service.sky.files import Content, is_kept, kept
from service.sky.model import SkyModel
from service.times import parse_utc

TIME = parse_utc("2003-05-01T00:00:00Z")
ARRAYS = {"x": np.arange(12.0).reshape(4, 3), "none": np.zeros((0, 2), np.int32)}


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """An empty folder of files."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    files._warn.cache_clear()
    return files.folder()


def build():
    return Content({"name": "Vega é", "number": 0.1}, ARRAYS)


def never():
    raise AssertionError("it was built again")


def path():
    return files._path("kind", 1)


def opened_as(content, arrays=ARRAYS):
    assert content.facts == {"name": "Vega é", "number": 0.1}
    assert content.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        found = content.arrays[name]
        assert found.dtype == array.dtype
        assert np.array_equal(found, array)
    return True


def is_mapped(array):
    while isinstance(array, np.ndarray):
        array = array.base
    return isinstance(array, mmap.mmap)


def test_a_file_gives_back_what_was_built_and_is_mapped():
    assert not is_kept("kind", 1)
    for content in (kept("kind", 1, build), kept("kind", 1, never)):
        assert opened_as(content)
        assert is_mapped(content.arrays["x"])
        assert not content.arrays["x"].flags.writeable
        assert content.arrays["x"].ctypes.data % files.LINE == 0
    assert is_kept("kind", 1)
    assert not is_kept("kind", 2)
    assert not is_kept("other", 1)


def _cut(data):
    return data[: len(data) // 2]


def _flip(at):
    return lambda data: data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize(
    "damage", [_cut, lambda _: b"", lambda data: bytes(len(data)), *map(_flip, (3, 130, 200, -30))]
)
def test_a_damaged_file_is_built_again(damage, caplog):
    kept("kind", 1, build)
    path().write_bytes(damage(path().read_bytes()))
    assert opened_as(kept("kind", 1, build))
    assert "is damaged: it is removed, and built again" in caplog.text
    assert opened_as(kept("kind", 1, never))


def test_what_cannot_be_built_leaves_no_file():
    def fail():
        raise BadInput(Fault("limit", "too deep"))

    with pytest.raises(BadInput, match="too deep"):
        kept("kind", 1, fail)
    assert opened_as(kept("kind", 1, build))


PROCESS = """
import os, sys, time
import numpy as np
from service.sky.files import Content, kept

def build():
    with open(sys.argv[1], "a") as told:
        told.write("built\\n")
    time.sleep(0.2)
    return Content({}, {"x": np.arange(1000)})

while not os.path.exists(sys.argv[2]):
    time.sleep(0.001)
print(kept("kind", 1, build).arrays["x"].sum())
"""


def test_of_several_processes_on_an_empty_folder_one_builds(tmp_path):
    told, go = tmp_path / "told", tmp_path / "go"
    command = [sys.executable, "-c", PROCESS, str(told), str(go)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(4)]
    go.touch()
    printed = [process.communicate(timeout=60)[0] for process in processes]
    assert printed == [b"499500\n"] * 4
    assert told.read_text() == "built\n"


def test_without_a_folder_to_write_to_everything_works_and_is_said_once(
    monkeypatch, tmp_path, caplog
):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    for _ in range(2):
        assert opened_as(kept("kind", 1, build))
    assert [each.levelno for each in caplog.records] == [logging.WARNING]
    assert "the sky cannot be kept in" in caplog.text
    assert "Not a directory" in caplog.text


def test_a_full_disk_leaves_no_half_file(caplog, folder):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (256, hard))
    try:
        assert opened_as(kept("kind", 1, build))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "the sky cannot be kept in" in caplog.text
    assert [each.suffix for each in folder.iterdir()] == [".lock"]
    assert opened_as(kept("kind", 1, build))
    assert opened_as(kept("kind", 1, never))


def test_beyond_its_bound_the_folder_loses_what_was_not_opened_for_longest(monkeypatch):
    first = kept("kind", 1, build)
    size = path().stat().st_size
    monkeypatch.setattr(files, "MOST_BYTES", 3 * size)
    for key in (2, 3):
        kept("kind", key, build)
    now = path().stat().st_mtime
    for age_s, key in ((100, 2), (50, 1), (20, 3)):
        os.utime(files._path("kind", key), (now - age_s, now - age_s))
    kept("kind", 2, never)
    kept("kind", 4, build)
    assert [is_kept("kind", key) for key in (1, 2, 3, 4)] == [False, True, True, True]
    # Who has it mapped goes on with it.
    assert opened_as(first)


def test_a_sky_of_files_is_the_sky_that_is_built(sky, missions, folder):
    def sky_of(**settings):
        return SkyModel(sky.catalog, LruCache(64 << 20), **settings)

    mission = missions["XTE"]
    anew, first, again = sky_of(opens_files=False), sky_of(), sky_of()
    catalogs = [each.run_catalog(mission, TIME) for each in (anew, first, again)]
    indexes = [
        each.index(mission, run_catalog, 4.0)
        for each, run_catalog in zip((anew, first, again), catalogs, strict=True)
    ]
    assert len(list(folder.glob("*.npy"))) == 2
    built, index = catalogs[0], indexes[0]
    for other in catalogs[1:]:
        assert (other.star_id, other.rejected) == (built.star_id, built.rejected)
        assert (other.digest, other.epoch_year) == (built.digest, built.epoch_year)
        assert np.array_equal(other.direction_at(TIME), built.direction_at(TIME))
        assert np.array_equal(other.catalog_row, built.catalog_row)
        assert np.array_equal(other.magnitude_mag, built.magnitude_mag)
        assert is_mapped(other.magnitude_mag)
    for other in indexes[1:]:
        assert (other.run_catalog, other.limit_mag) == (index.run_catalog, index.limit_mag)
        assert other.radius_deg == index.radius_deg
        assert np.array_equal(other.store, index.store)
        assert is_mapped(other.store)
        for one, two in zip(other.arrays, index.arrays, strict=True):
            assert one.dtype == two.dtype
            assert np.array_equal(one, two)


def test_a_file_is_for_all_that_it_depends_on(sky, missions, folder):
    mission = missions["XTE"]
    fainter = mission.model_copy(
        update={"catalog": mission.catalog.model_copy(update={"magnitude_limit_mag": 5.0})}
    )

    def count():
        return len(list(folder.glob("*.npy")))

    model = SkyModel(sky.catalog, LruCache(64 << 20))
    model.run_catalog(mission, TIME)
    assert count() == 1
    model.run_catalog(missions["SWAS"], TIME)
    assert count() == 1
    model.run_catalog(fainter, TIME)
    assert count() == 2
    model.run_catalog(mission, parse_utc("2005-05-01T00:00:00Z"))
    assert count() == 3
    for radius_deg in (3.0, 3.5):
        model.index(fainter, model.run_catalog(fainter, TIME), radius_deg)
    assert count() == 5


def test_the_folder_is_that_of_the_kernels(folder, tmp_path):
    assert folder.parent == Path(tmp_path / "cache")

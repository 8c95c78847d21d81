"""`acquire reprocess --archive`: what it refuses, and what it tells."""

import pytest

from tests.features.archive.partitions.checks import assert_whole


def test_options_that_do_not_fit_are_refused_by_name(acquire, tmp_path):
    code, _, complaint = acquire("reprocess", "--scheduler", "tls://h:1")
    assert (code, complaint) == (2, "acquire: --scheduler: needs --archive (got tls://h:1)\n")
    for address in ("http://h:1", "tls://h", "h:8786"):
        code, _, complaint = acquire("reprocess", "--archive", tmp_path, "--scheduler", address)
        assert code == 2
        assert "--scheduler: must be tls://HOST:PORT or tcp://HOST:PORT" in complaint
    code, _, complaint = acquire("reprocess", "--archive", tmp_path, "--scheduler", "tls://h:1")
    assert (code, "--scheduler: needs certificates: set DASK_" in complaint) == (2, True)
    both = ("--scheduler", "tls://h:1", "--processes", "2")
    code, _, complaint = acquire("reprocess", "--archive", tmp_path, *both)
    said = "--processes: is the number of processes on this machine" in complaint
    assert (code, said) == (2, True)
    code, _, complaint = acquire("reprocess", "--archive", tmp_path / "none")
    assert (code, "there is no such folder" in complaint) == (2, True)


def test_the_command_compares_both_runs(archived, place, database, acquire, opened):
    if not database.startswith("sqlite"):
        pytest.skip("the comparison does not depend on the database: SQLite shows it")
    archived.close()
    words = ("reprocess", "--database", database, "--archive", place, "--run", "again")
    code, output, complaint = acquire(*words, "--processes", "1", "--quiet")
    assert (code, complaint) == (0, "")
    assert "run again, of 72 batches:\n  72 recorded, 0 there already, 0 refused" in output
    assert "every star came out alike" in output
    code, output, _ = acquire(*words, "--processes", "1", "--quiet", "--json", "--no-comparison")
    assert code == 0
    assert '"before": 72' in output
    assert_whole(opened(archive_folder=place), place)

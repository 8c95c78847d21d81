"""What is true of a run whose batches are parts of an archive, whoever made them."""

import hashlib

from sqlalchemy import select

from service.features.archive import folder
from service.features.archive.archiving import verify_archive
from service.storage.sql.tables import archived_batches, batches
from tests.storage.recount import assert_equal_to_a_recount

START = "1996-01-10T12:00:00.000Z"
BATCHES, CADENCE_S = 60, 2_700.0
"""A batch every 45 minutes: two days."""
PART = 8
"""Batches of a part."""


def files_of(place, run):
    """The hashes of a run's parts by name, as they are in the folder."""
    found = {}
    for file in sorted(place.glob("spacecraft=*/day=*/run-*.parquet")):
        if file.name.startswith(f"run-{run}-"):
            found[str(file.relative_to(place))] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


def names_of(app, run):
    """The names of a run's batches, recorded and archived, with their spacecraft."""
    found = []
    with app.store.reading() as connection:
        for table in (batches, archived_batches):
            query = select(table.c.spacecraft, table.c.batch).where(table.c.run == run)
            found += map(tuple, connection.execute(query))
    return sorted(found)


def assert_whole(app, place, run="again"):
    """Every batch of the live run is in the run once, and every part is named and whole."""
    assert names_of(app, run) == names_of(app, "live")
    assert list(verify_archive(place, {})) == []
    named = {
        folder.path_of(place, manifest, part): part.sha256
        for manifest in folder.manifests(place)
        for part in manifest.parts
        if part.run == run
    }
    assert named == files_of(place, run)
    assert list(place.rglob("*.part")) == []
    assert_trends(app)


def assert_trends(app):
    """The trends are those of a count of all batches."""
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)

"""A process whose disk fails now and then: sends every batch until it is acknowledged.

    python -m tests.storage.disk_worker DATABASE BATCHES.ndjson FAULTS SEED

Started with `faulty_disk.c` preloaded.  Prints one JSON line: what was
acknowledged (id to the digest of the answer), how many faults struck and at what,
how many calls they made fail, how often it was told to come again, and how many
reads failed meanwhile.
"""

import ctypes
import errno
import hashlib
import json
import random
import sys
import time
from collections import Counter
from concurrent.futures import Future
from itertools import islice
from pathlib import Path

from sqlalchemy import event

from service.app.factory import open_app
from service.errors import Busy
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.storage.sql.engines import driver_of

PATIENCE_S = 60.0
WITHIN = (60, 40, 6)
"""Calls among which one fails, of each kind that `faulty_disk.c` tells apart."""
LOG_PAGES = 60
"""A checkpoint every few batches: as it is served there is one in hundreds."""


def main(database, file, faults, seed):
    disk, draw = ctypes.CDLL(None), random.Random(int(seed))
    disk.faulty_struck.restype = ctypes.c_char_p
    app = open_app(Settings(database=database))
    # The connection that is open, and those that come after a failure.
    app.store.writer.change(lambda c: _checkpoint_often(driver_of(c)))
    event.listen(app.store._writing, "connect", _checkpoint_often)
    lines = Path(file).read_bytes().splitlines()
    acknowledged, told_busy, kinds, reads_failed = {}, 0, Counter(), 0

    def in_bulk(texts):
        return app.submissions.submit_many([submission_from_json(text) for text in texts])

    def one_by_one(texts):
        sent = [submission_from_json(text) for text in texts]
        waiting = [app.submissions.queued(each, None, None, Future()) for each in sent]
        return [each.result() for each in waiting]

    waiting = iter(lines)
    for _ in range(int(faults)):
        before = disk.faulty_failed()
        # A single call or a disk that stays so for a while: in a commit, at its end, or where a
        # checkpoint takes the log over into the file.
        error = draw.choice((errno.ENOSPC, errno.EIO, errno.EROFS))
        # The first is one that the sender notices: in the log.
        kind, within = draw.choice(tuple(enumerate(WITHIN))) if kinds else (0, WITHIN[0])
        disk.faulty_fail(kind, draw.randrange(within), draw.choice((1, 1, 3, 25)), error)
        while disk.faulty_failed() == before:
            chunk = list(islice(waiting, 3))
            assert chunk, "the batches ended before the disk failed"
            send = draw.choice((in_bulk, one_by_one))
            give_up = time.monotonic() + PATIENCE_S
            while True:
                try:
                    answers = send(chunk)
                    break
                except Busy:
                    told_busy += 1
                    try:
                        app.results.page(limit=1)
                    except Busy:
                        reads_failed += 1
                    assert time.monotonic() < give_up, "writing did not resume"
            for each in answers:
                acknowledged[each.id] = hashlib.sha256(each.body).hexdigest()
        call, place = disk.faulty_struck().decode().split(" ", 1)
        kinds[f"{call} {Path(place).name} {errno.errorcode[error]}"] += 1
    disk.faulty_fail(0, 0, 0, 0)
    for each in in_bulk(waiting):
        acknowledged[each.id] = hashlib.sha256(each.body).hexdigest()
    app.close()
    told = {
        "acknowledged": acknowledged,
        "struck": kinds.total(),
        "kinds": dict(kinds.most_common()),
        "calls_failed": disk.faulty_failed(),
        "told_busy": told_busy,
        "reads_failed": reads_failed,
    }
    print(json.dumps(told))


def _checkpoint_often(driver, _record=None):
    driver.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")


if __name__ == "__main__":
    main(*sys.argv[1:])

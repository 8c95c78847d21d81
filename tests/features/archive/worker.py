"""Archives with small parts, for tests that kill it: a line a part."""

import sys
from pathlib import Path

from service.features.archive import archiving
from service.storage.store import Store
from service.times import parse_utc

if __name__ == "__main__":
    database, folder, before = sys.argv[1:]
    archiving.MOST_BATCHES = 5
    store = Store(database, create=False)
    print("ready", flush=True)
    archiving.archive(
        store, Path(folder), parse_utc(before), step=lambda done: print(done.batches, flush=True)
    )
    store.close()

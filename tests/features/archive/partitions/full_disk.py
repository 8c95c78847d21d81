"""`acquire reprocess` on a disk that is full after so many writes to the archive.

    python -m tests.features.archive.partitions.full_disk DATABASE FOLDER AFTER

Started with `faulty_disk.c` preloaded.
"""

import ctypes
import errno
import sys

from service.cli import main

OTHER_FILE = 1

if __name__ == "__main__":
    database, place, after = sys.argv[1:]
    ctypes.CDLL(None).faulty_fail(OTHER_FILE, int(after), 10**9, errno.ENOSPC)
    words = ["reprocess", "--archive", place, "--database", database, "--run", "again"]
    sys.exit(main([*words, "--no-comparison", "--quiet", "--processes", "1"]))

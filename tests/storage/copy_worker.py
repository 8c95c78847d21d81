"""Copies with small transactions, for tests that kill it: a line a transaction."""

import sys

from service.storage.upkeep import copy

if __name__ == "__main__":
    source, target = sys.argv[1:]
    copy.ROWS_AT_ONCE = copy.LARGE_ROWS_AT_ONCE = 5
    _, problems = copy.copy_record(source, target, lambda *step: print(*step, flush=True))
    assert problems == [], problems

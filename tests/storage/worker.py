"""A process to be killed: submits what it is given and says what was acknowledged.

    python -m tests.storage.worker DATABASE BATCHES.ndjson

One line of output for each answer: its id and the digest of its body.
"""

import hashlib
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from service.app.factory import open_app
from service.observations.schema import submission_from_json
from service.settings import Settings

THREADS, CHUNK = 4, 5


def acknowledge(answers):
    text = "".join(f"{each.id} {hashlib.sha256(each.body).hexdigest()}\n" for each in answers)
    # One write, past every buffer: what is said is said before the next batch is begun.
    os.write(sys.stdout.fileno(), text.encode())


def main(database, file):
    app = open_app(Settings(database=database))
    lines = Path(file).read_bytes().splitlines()
    chunks = [lines[first : first + CHUNK] for first in range(0, len(lines), CHUNK)]

    def work(numbered):
        number, chunk = numbered
        submissions = [submission_from_json(line) for line in chunk]
        if number % 3 == 0:
            acknowledge(app.submissions.submit_many(submissions))
        else:
            for each in submissions:
                acknowledge([app.submissions.submit(each)])

    with ThreadPoolExecutor(THREADS) as threads:
        list(threads.map(work, enumerate(chunks)))
    app.close()


if __name__ == "__main__":
    main(*sys.argv[1:])

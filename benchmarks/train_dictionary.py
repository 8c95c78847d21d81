"""Trains the dictionary for the compression of answers and batches.

    python -m benchmarks.train_dictionary [--seed S] FILE

It draws passes of the shipped missions, acquires them, and trains on one half of the answers
and batches.  What the dictionary makes of the other half is printed.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import zstandard

from service.ingest.solver_pool import Solver
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql.columns import LEVEL

MISSIONS = ("XTE", "SWAS", "SOHO")
BATCHES, BYTES = 400, 8192


def texts(seed: int) -> tuple[list[bytes], list[bytes]]:
    """Answers, and batches as recorded, in random order."""
    missions, sky = load_missions(), SkyModel(load_embedded(), LruCache(256 << 20))
    solver = Solver(missions, sky)
    answers, batches = [], []
    for name in MISSIONS:
        for drawn in draw_pass(missions[name], sky, Pass(BATCHES, seed, prior="mixed")):
            submission = submission_from_json(json.dumps(drawn.batch))
            answers.append(solver.solve(submission).to_json(1))
            batches.append(submission.text.encode())
    rng = np.random.default_rng(seed)
    for each in (answers, batches):
        rng.shuffle(each)
    return answers, batches


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    answers, batches = texts(arguments.seed)
    half = len(answers) // 2
    samples: list[bytes | bytearray | memoryview] = [*answers[:half], *batches[:half]]
    dictionary = zstandard.train_dictionary(BYTES, samples, level=LEVEL)
    arguments.file.write_bytes(dictionary.as_bytes())
    compressor = zstandard.ZstdCompressor(level=LEVEL, dict_data=dictionary)
    for name, some in (("answers", answers[half:]), ("batches", batches[half:])):
        packed = sum(len(compressor.compress(each)) for each in some)
        print(f"{name}: {sum(map(len, some)) / half:.0f} -> {packed / half:.0f} bytes")


if __name__ == "__main__":
    main()

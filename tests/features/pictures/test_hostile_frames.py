"""No file harms the reader: each is refused with words, in bounded memory and time."""

import io
import json
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from service.errors import BadInput
from service.features.pictures.tracker.submit import FrameIn, submission_of_frame
from tests.features.pictures.hostile_frames import hostile_files

KNOWN = FrameIn(time="2026-03-01T00:00:00Z")
MAX_PIXELS = 20_000_000
MAX_GROWTH_MB = 120
"""A frame of a megapixel takes some thirty bytes a pixel at work; no bomb may add to that."""

FILES = {name: (cache(make), word) for name, make, word in hostile_files(np.random.default_rng(4))}


@pytest.mark.parametrize("name", FILES)
def test_a_hostile_file_is_refused_with_words(missions, name):
    make, word = FILES[name]
    data, started = make(), time.monotonic()
    with pytest.raises(BadInput) as refusal:
        submission_of_frame(io.BytesIO(data), "sha256:0", KNOWN, missions["IMAGER"], MAX_PIXELS)
    (fault,) = refusal.value.faults
    assert fault.field == "frame"
    assert word in str(fault)
    assert len(str(fault)) < 400
    assert time.monotonic() - started < 20


def test_a_frame_larger_than_the_setting_is_refused_before_it_is_read(missions):
    with pytest.raises(BadInput, match="at most 1,000 pixels"):
        submission_of_frame(
            io.BytesIO(FILES["no star"][0]()),
            "sha256:0",
            KNOWN,
            missions["IMAGER"],
            1000,
        )


READ = """
import io, json, resource, sys
from pathlib import Path
import PIL.Image, PIL.PngImagePlugin, PIL.TiffImagePlugin, sep
from service.errors import BadInput
from service.features.pictures.tracker.submit import FrameIn, submission_of_frame
from service.missions.mission import load_missions

mission, known = load_missions()["IMAGER"], FrameIn(time="2026-03-01T00:00:00Z")
def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, refused = peak_mb(), 0
for path in sorted(Path(sys.argv[1]).iterdir()):
    with path.open("rb") as file:
        try:
            submission_of_frame(file, "sha256:0", known, mission, 20_000_000)
        except BadInput:
            refused += 1
print(json.dumps({"grown_mb": peak_mb() - before, "refused": refused}))
"""


def test_all_of_them_one_after_another_take_a_bounded_memory(tmp_path):
    for number, (make, _) in enumerate(FILES.values()):
        (tmp_path / f"{number:03d}").write_bytes(make())
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", READ, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[3],
    )
    told = json.loads(done.stdout)
    assert told["refused"] == len(FILES)
    assert told["grown_mb"] < MAX_GROWTH_MB, told

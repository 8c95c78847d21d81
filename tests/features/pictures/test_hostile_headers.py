"""No place, size or kind that a header states harms the reader: it is refused with words."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.cli import main
from service.errors import BadFile
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from tests.features.pictures.hostile_headers import absurd_files, good_files
from tests.scale import size

ABSURD = absurd_files(np.random.default_rng(4))
MUTATIONS, IN_A_SITTING = 200_000, 60
"""Mutations of each file of `good_files`."""
MAX_GROWTH_MB = 120
"""Files of 48 x 64 pixels, and limits of a megapixel: a decoder at work takes some 40 MB."""


@pytest.mark.parametrize("name", ABSURD)
def test_an_absurd_header_is_refused_with_words(name):
    data, word = ABSURD[name]
    with pytest.raises(BadFile) as refusal:
        read_frame(io.BytesIO(data), FrameLimits(20_000_000))
    (fault,) = refusal.value.faults
    assert fault.field == "frame"
    assert word in str(fault)
    assert len(str(fault)) < 400


def test_an_absurd_unit_behind_an_image_is_not_looked_at(rng):
    files = good_files(rng)
    absurd, _ = ABSURD["FITS of 8 EB"]
    behind = absurd.replace(b"SIMPLE  =                    T", b"XTENSION= 'IMAGE   '          ")
    frame = read_frame(io.BytesIO(files["FITS"] + behind), FrameLimits(1_000_000))
    assert np.array_equal(
        frame.counts, read_frame(io.BytesIO(files["FITS"]), FrameLimits(1_000_000)).counts
    )


def test_the_command_refuses_each_in_one_line(tmp_path, capsys):
    names = []
    for number, (data, _) in enumerate(ABSURD.values()):
        names.append(str(tmp_path / f"{number}.fits"))
        Path(names[-1]).write_bytes(data)
    assert main(["frame", *names]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    lines = told.err.strip().splitlines()
    assert len(lines) == len(ABSURD)
    for name, line in zip(names, lines, strict=True):
        assert line.startswith(f"acquire: {name}: frame: ")


READ = """
import io, json, random, resource, sys, warnings
import numpy as np, sep
import PIL.Image, PIL.PngImagePlugin, PIL.TiffImagePlugin, tifffile, astropy.io.fits
from service.errors import BadFile
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from tests.features.pictures.hostile_headers import good_files, with_absurd_header

warnings.simplefilter("ignore")
count, seed = map(int, sys.argv[1:])
limits = FrameLimits(1_000_000)
def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
for name, data in good_files(np.random.default_rng(seed)).items():
    draw, read, refused, before = random.Random(seed), 0, 0, peak_mb()
    for _ in range(count):
        try:
            frame = read_frame(io.BytesIO(with_absurd_header(name, data, draw)), limits)
            assert frame.counts.size <= limits.max_pixels
            read += 1
        except BadFile:
            refused += 1
    told = {"name": name, "read": read, "refused": refused, "grown_mb": peak_mb() - before}
    print(json.dumps(told), flush=True)
"""


@pytest.mark.torture
def test_a_header_with_absurd_numbers_takes_a_bounded_memory(seed, figures):
    count = size(MUTATIONS, IN_A_SITTING)
    done = subprocess.run(
        [sys.executable, "-c", READ, str(count), str(seed)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[3],
    )
    assert done.returncode == 0, done.stderr[-4000:]
    told = [json.loads(line) for line in done.stdout.splitlines()]
    figures(mutations=count, formats=len(told), refused=sum(each["refused"] for each in told))
    assert len(told) == len(good_files(np.random.default_rng(seed)))
    for each in told:
        assert each["read"] + each["refused"] == count
        assert each["grown_mb"] < MAX_GROWTH_MB, each
        assert each["refused"] > 0, each

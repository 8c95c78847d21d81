"""`acquire simulate frames` and `acquire frame`: from nothing to an attitude with its picture."""

import gzip
import json

import pytest
from PIL import Image


@pytest.fixture
def frames(acquire, tmp_path):
    code, out, _ = acquire(
        "simulate", "frames", "--spacecraft", "IMAGER", "--frames", 2, "--seed", 4, "frames"
    )
    assert code == 0
    assert "2 frames of IMAGER" in out
    return sorted((tmp_path / "frames").glob("*.fits"))


def test_frames_are_drawn_and_their_attitudes_found(acquire, frames, tmp_path):
    asked = ("frame", *frames, "--spacecraft", "IMAGER", "--in-process", "--overlay", "pictures")
    code, out, err = acquire(*asked)
    assert (code, err) == (0, "")
    assert out.count("  good  ") == 2
    for frame in frames:
        with Image.open(tmp_path / "pictures" / f"{frame.stem}.png") as picture:
            assert picture.size[0] == 1024
    # Again, as JSON: the recorded answers.
    code, out, _ = acquire("frame", *frames, "--spacecraft", "IMAGER", "--in-process", "--json")
    answers = [json.loads(line) for line in out.splitlines()]
    told = (tmp_path / "frames" / "truth.ndjson").read_text().splitlines()
    truth = [json.loads(line) for line in told]
    assert [each["batch"] for each in answers] == [each["batch"] for each in truth]
    for answer, true in zip(answers, truth, strict=True):
        assert answer["attitude"]["quaternion"] == pytest.approx(true["quaternion"], abs=1e-4)


def test_the_metadata_of_a_packed_frame_lie_beside_it(acquire, frames, tmp_path):
    packed, beside = (tmp_path / f"packed.{end}" for end in ("fits.gz", "json"))
    packed.write_bytes(gzip.compress(frames[0].read_bytes(), 1))
    beside.write_text(
        json.dumps({**json.loads(frames[0].with_suffix(".json").read_text()), "batch": "own"})
    )
    code, out, _ = acquire("frame", packed, "--spacecraft", "IMAGER", "--in-process", "--json")
    assert (code, json.loads(out)["batch"]) == (0, "own")


def test_a_file_that_is_refused_is_told_and_the_others_go_on(acquire, frames, tmp_path):
    (tmp_path / "bad.fits").write_bytes(b"SIMPLE")
    asked = ("frame", "bad.fits", frames[0], "--spacecraft", "IMAGER", "--in-process")
    code, out, err = acquire(*asked, "--time", "2026-03-01T00:00:00Z")
    assert code == 1
    assert "bad.fits: frame: is not FITS" in err
    assert "  good  " in out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("frame x.fits --spacecraft NO --in-process", "no such file"),
        ("frame a b --batch one --spacecraft IMAGER", "--batch: names one frame"),
        ("frame a --spacecraft IMAGER --database sqlite:///x.db", "goes with --in-process"),
        ("frame a --spacecraft IMAGER --dark b.png", "--dark: goes without --spacecraft"),
        ("frame a --spacecraft IMAGER --fov 20", "--fov: goes without --spacecraft"),
        ("frame a --spacecraft IMAGER --a-priori {", "--a-priori: is not JSON"),
        ("frame a --spacecraft IMAGER --centroid best", "invalid choice"),
        ("simulate frames --spacecraft XTE --frames 1 out", "describes no camera"),
        ("simulate frames --spacecraft IMAGER --frames 1 --rates 99 out", "rates: must be from"),
    ],
)
def test_a_mistake_is_one_clear_line(acquire, arguments, complaint):
    code, out, err = acquire(*arguments.split())
    assert code != 0
    assert out == ""
    assert complaint in err.lower() or complaint in err

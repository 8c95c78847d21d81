"""An exposure that its stars contradict is said, of a frame and of a picture."""

import io

import numpy as np
import pytest

from service.errors import BadFile
from service.features.pictures.blind.picture import blind_sky, solve_picture
from service.features.pictures.blind.picture_remarks import doubt_of_exposure
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.fits import write_fits
from service.features.pictures.frames.frame import FrameLimits
from service.features.pictures.tracker.frame_submission import submit_frame
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames
from service.features.pictures.tracker.submit import FrameIn, usual_magnitude

MAX_PIXELS = 2_000_000
EXPOSURES = ("as it is", "in milliseconds", "a thousandth")


@pytest.fixture(scope="module")
def frame(missions, sky):
    return next(iter(draw_frames(missions["IMAGER"], sky, FrameSettings(frames=1, seed=5))))


def file_of(frame, exposure_s):
    file = io.BytesIO()
    cards = {"DATE-AVG": frame.known["time"].rstrip("Z"), "EXPTIME": exposure_s}
    write_fits(file, frame.counts, cards)
    file.seek(0)
    return file


def remarks_of(frame, exposure_s, missions, sky):
    return submit_frame(
        file_of(frame, exposure_s),
        "sha256:0",
        FrameIn(),
        missions["IMAGER"],
        sky.catalog,
        MAX_PIXELS,
    ).frame.remarks


def test_a_right_exposure_is_not_doubted(frame, missions, sky):
    _, camera = missions["IMAGER"].camera_tracker(None, "tracker")
    remarks = remarks_of(frame, camera.exposure_s, missions, sky)
    assert f"exposure_of_file: {camera.exposure_s:.6g} s, from EXPTIME" in remarks
    assert not any("doubtful" in remark for remark in remarks)


def test_an_exposure_in_milliseconds_is_refused_with_its_keyword(frame, missions, sky):
    _, camera = missions["IMAGER"].camera_tracker(None, "tracker")
    with pytest.raises(BadFile) as refusal:
        remarks_of(frame, 1000.0 * camera.exposure_s, missions, sky)
    text = str(refusal.value)
    assert "no star that could be used" in text
    assert "from EXPTIME, the candidates would be 7." in text
    assert "fainter" in text


def test_an_exposure_that_is_too_short_is_said(frame, missions, sky):
    _, camera = missions["IMAGER"].camera_tracker(None, "tracker")
    remarks = remarks_of(frame, camera.exposure_s / 1000.0, missions, sky)
    (doubt,) = [remark for remark in remarks if remark.startswith("exposure_doubtful: ")]
    assert "brighter" in doubt


def test_the_zero_point_of_a_picture_is_held_against_that_of_its_camera(frame, missions, sky):
    _, camera = missions["IMAGER"].camera_tracker(None, "tracker")
    for factor, words in ((1.0, None), (1000.0, "a factor of 1e+03"), (0.1, "a factor of 10")):
        read = read_frame(file_of(frame, factor * camera.exposure_s), FrameLimits(MAX_PIXELS))
        result = solve_picture(read, *blind_sky(sky.catalog, 2026), camera.focal_length_px)
        doubt = doubt_of_exposure(result, camera.zero_point_mag)
        assert len(doubt) == (words is not None)
        assert words is None or doubt[0].startswith("exposure_doubtful: with ")
        assert doubt_of_exposure(result, None) == []


def test_the_usual_magnitudes_are_those_of_the_catalog(sky):
    """Over the whole sky, so many stars are as bright as that."""
    magnitude = np.sort(sky.catalog.magnitude_v_mag)
    for rank in (500, 5000, 40_000):
        usual = usual_magnitude(np.array([rank]), 41253.0)[0]
        assert usual == pytest.approx(magnitude[rank - 1], abs=0.25)

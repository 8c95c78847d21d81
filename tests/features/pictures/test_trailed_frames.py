"""Frames of a tracker whose body turns during the exposure: stars in the middle of their trails."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from service.errors import BadFile
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.features.pictures.tracker.submit import read_known, submission_of_frame
from tests.scale import draws

DIGEST = "sha256:" + "0" * 64


def drawn_frames(mission, sky, rates_deg_per_s, count, seed=3):
    settings = FrameSettings(frames=count, seed=seed, rates_deg_per_s=rates_deg_per_s)
    return draw_frames(mission, sky, settings)


def submitted(mission, drawn, **changed):
    known = {name: value for name, value in (drawn.known | changed).items() if value is not None}
    file = io.BytesIO(frame_bytes(drawn))
    return submission_of_frame(file, DIGEST, read_known(known), mission, 10_000_000)


@pytest.mark.parametrize("rates_told", [True, False])
@pytest.mark.parametrize("rates_deg_per_s", [0.0, 0.3, 1.0, 3.0])
def test_errors_of_places_are_those_that_their_sigmas_say(
    missions, sky, rates_deg_per_s, rates_told
):
    """Trails of 0 to 50 px, with roll, beside 200 hot pixels and cosmic rays."""
    mission, pulls = missions["IMAGER"], []
    for drawn in drawn_frames(mission, sky, rates_deg_per_s, draws(5, 40)):
        changed = {} if rates_told else {"body_rates_deg_per_s": None}
        record = submitted(mission, drawn, **changed).frame
        used = [star for star in record.stars if star["used"]]
        place = np.array([(star["u_px"], star["v_px"]) for star in used])
        sigma = np.array([(star["sigma_u_px"], star["sigma_v_px"]) for star in used])
        true = np.array([(star["u_px"], star["v_px"]) for star in drawn.truth["stars"]])
        _, nearest = cKDTree(true).query(place)
        pulls.append((place - true[nearest]) / sigma)
    pull = np.abs(np.concatenate(pulls))
    assert len(pull) > 8 * len(pulls)
    # Blends within a pixel are in the frames: the central 68.3 % are compared.
    assert 0.8 < np.quantile(pull, 0.683) < 1.25
    assert np.mean(pull > 5.0) < 0.05


def test_trails_are_named_and_rates_that_contradict_them_too(missions, sky):
    (drawn,) = drawn_frames(missions["IMAGER"], sky, 2.0, 1)
    agreed = submitted(missions["IMAGER"], drawn).frame.remarks
    assert [each for each in agreed if each.startswith("trailed: stars moved by about ")]
    assert not [each for each in agreed if each.startswith("body_rates_deg_per_s: ")]
    slower = (np.array(drawn.known["body_rates_deg_per_s"]) / 57.3).tolist()
    doubted = submitted(missions["IMAGER"], drawn, body_rates_deg_per_s=slower).frame.remarks
    assert [each for each in doubted if each.startswith("body_rates_deg_per_s: ")]


def test_rates_of_short_trails_and_of_another_direction_are_told_apart(missions, sky):
    def doubts(drawn, rates):
        remarks = submitted(missions["IMAGER"], drawn, body_rates_deg_per_s=rates).frame.remarks
        return "".join(each for each in remarks if each.startswith("body_rates_deg_per_s: "))

    (short,) = drawn_frames(missions["IMAGER"], sky, 2.0, 1, seed=5)
    x, y, z = short.known["body_rates_deg_per_s"]
    assert doubts(short, [x, y, z]) == ""
    (long,) = drawn_frames(missions["IMAGER"], sky, 2.0, 1)
    x, y, z = long.known["body_rates_deg_per_s"]
    assert doubts(long, [x, y, z]) == ""
    assert "in another direction" in doubts(long, [-x, y, z]) + doubts(long, [x, y, -z])
    assert "are zero or not given, and the frame shows" in doubts(long, None)


def test_two_images_of_each_star_are_refused_as_trailed(missions, sky):
    (drawn,) = drawn_frames(missions["IMAGER"], sky, 0.0, 1)
    level = np.median(drawn.counts)
    twice = drawn.counts + np.roll(drawn.counts, (9, -7), axis=(0, 1)) - level
    double = replace(drawn, counts=np.clip(twice, 0, 65535).astype(np.uint16))
    with pytest.raises(BadFile, match=r"is trailed: .* in two images of each"):
        submitted(missions["IMAGER"], double)


def test_a_stretched_frame_of_stars_that_stand_still_is_not_called_trailed(missions, sky):
    refusals = []
    for drawn in drawn_frames(missions["IMAGER"], sky, 0.0, draws(4, 20)):
        least, most = float(drawn.counts.min()), float(np.quantile(drawn.counts, 0.999))
        grey = np.clip((drawn.counts - least) / (most - least) * 255.0, 0.0, 255.0)
        file = io.BytesIO()
        Image.fromarray(grey.astype(np.uint8)).convert("RGB").save(file, "PNG")
        known = read_known({"time": drawn.known["time"]})
        try:
            submission_of_frame(file, DIGEST, known, missions["IMAGER"], 10_000_000)
        except BadFile as refusal:
            refusals.append(str(refusal))
    assert refusals
    assert all("stars are cut off at the largest count" in each for each in refusals)

"""Drawn frames: the same again for the same seed, light and noise as the camera says."""

import json

import numpy as np
import pytest

from service.errors import BadInput
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, write_frames


@pytest.fixture
def imager(missions):
    return missions["IMAGER"]


def draw(imager, sky, **wanted):
    return list(draw_frames(imager, sky, FrameSettings(**{"frames": 1} | wanted)))


def test_the_same_settings_give_the_same_frames_and_each_its_own(imager, sky):
    first, second = draw(imager, sky, frames=2, seed=6)
    (again,) = draw_frames(imager, sky, FrameSettings(frames=2, seed=6), [1])
    assert np.array_equal(second.counts, again.counts)
    assert second.known == again.known
    assert not np.array_equal(first.counts, second.counts)
    assert first.truth["quaternion"] != second.truth["quaternion"]


def test_background_and_noise_are_those_of_the_camera(imager, sky):
    camera = imager.trackers[0].camera
    (drawn,) = draw(imager, sky, hot_pixels=0, cosmic_rays=0)
    level_e = (100.0 + camera.dark_e_per_s) * camera.exposure_s
    level = camera.bias_counts + level_e / camera.gain_e_per_count
    noise = np.sqrt(level_e + camera.read_noise_e**2) / camera.gain_e_per_count
    assert np.median(drawn.counts) == pytest.approx(level, abs=1.0)
    low, high = np.quantile(drawn.counts, (0.1587, 0.5))
    # Counts are whole: the quantile is known to half of one.
    assert high - low == pytest.approx(noise, abs=0.8)


@pytest.mark.parametrize("psf", ["gaussian", "airy"])
def test_a_star_s_light_is_that_of_its_magnitude(imager, sky, psf):
    camera = imager.trackers[0].camera
    (drawn,) = draw(imager, sky, seed=2, psf=psf, hot_pixels=0, cosmic_rays=0, sky_e_per_s=0.0)
    light = drawn.counts - np.median(drawn.counts).astype(float)
    u, v, magnitude = (
        np.array([star[name] for star in drawn.truth["stars"]])
        for name in ("u_px", "v_px", "magnitude")
    )
    inside = (u > 30) & (u < 990) & (v > 30) & (v < 990)
    k = int(np.argmin(np.where(inside & (magnitude > 2.5), magnitude, np.inf)))
    row, column = round(v[k]), round(u[k])
    total = light[row - 20 : row + 21, column - 20 : column + 21].sum()
    expected = camera.flux_counts(magnitude[k], camera.exposure_s)
    # Faint neighbours are in the square, and of an Airy disc some percent lie beyond it.
    assert total == pytest.approx(expected, rel=0.06)


def test_the_cross_has_four_arms(imager, sky):
    (drawn,) = draw(imager, sky, seed=2, psf="cross", hot_pixels=0, cosmic_rays=0)
    star = min(
        (s for s in drawn.truth["stars"] if 60 < s["u_px"] < 960 and 60 < s["v_px"] < 960),
        key=lambda s: s["magnitude"],
    )
    light = drawn.counts - float(np.median(drawn.counts))
    row, column = round(star["v_px"]), round(star["u_px"])
    arms = [
        light[row, column + 6 : column + 16].sum(),
        light[row, column - 15 : column - 5].sum(),
        light[row + 6 : row + 16, column].sum(),
        light[row - 15 : row - 5, column].sum(),
    ]
    between = [np.diag(light[row + 6 : row + 16, column + 6 : column + 16]).sum()]
    assert min(arms) > 5.0 * max(between)


def test_files_hold_the_frame_what_is_known_and_apart_from_it_the_truth(imager, sky, tmp_path):
    drawn = draw(imager, sky)
    assert write_frames(iter(drawn), tmp_path / "out") == 1
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    stem = f"frame-{drawn[0].known['batch']}"
    assert names == [f"{stem}.fits", f"{stem}.json", "truth.ndjson"]
    with (tmp_path / "out" / f"{stem}.fits").open("rb") as file:
        frame = read_frame(file, FrameLimits(2_000_000))
    assert np.array_equal(frame.counts, drawn[0].counts)
    assert frame.time == drawn[0].known["time"]
    assert frame.exposure_s == drawn[0].exposure_s
    known = json.loads((tmp_path / "out" / f"{stem}.json").read_text())
    assert known == drawn[0].known
    assert "quaternion" not in known
    assert json.loads((tmp_path / "out" / "truth.ndjson").read_text()) == drawn[0].truth


@pytest.mark.parametrize(
    ("wanted", "word"),
    [
        ({"frames": 0}, "frames"),
        ({"psf": "round"}, "psf"),
        ({"a_priori_error_deg": -1.0}, "prior-error"),
        ({"rates_deg_per_s": 99.0}, "rates"),
        ({"hot_pixels": -1}, "hot-pixels"),
    ],
)
def test_settings_that_cannot_be_are_named(wanted, word):
    with pytest.raises(BadInput, match=word):
        FrameSettings(**{"frames": 1} | wanted)

"""A camera of a few lines, or of none: calibrated from its pictures, or fitted on every frame."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.cli import main
from service.errors import BadBatch, BadConfiguration
from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import solve_picture
from service.features.pictures.blind.solver import rotation_between
from service.features.pictures.camera_calibration import calibrate_camera
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.frame_submission import submit_frame
from service.features.pictures.tracker.submit import FrameIn
from service.missions.mission import parse_mission, read_mission
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from tests.features.pictures.drawn import draw_picture, jpeg_of
from tests.scale import draws

FOLDER = Path(__file__).parent
LENS = Lens(1024, 768, 3889.03, 0.02, 0.01, -0.015)
KNOWN = FrameIn(time="2020-01-01T00:00:00Z")
TRUTH = {each["file"]: each for each in json.loads((FOLDER / "truth.json").read_text())["pictures"]}

ROUGH = """
name = "FLIR"
[camera]
width_px = 1024
height_px = 768
field_of_view_deg = {field}
"""


@pytest.fixture(scope="module")
def pictures(blind, tmp_path_factory):
    """Files of six pictures of one camera."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("pictures")
    for number in range(6):
        picture = draw_picture(rng, blind[0], lens=LENS, stars=40)
        (folder / f"{number}.jpg").write_bytes(jpeg_of(picture.counts))
    return sorted(folder.glob("*.jpg"))


def test_a_mission_file_of_six_lines_is_made_whole():
    mission = parse_mission(ROUGH.format(field=11.0), "flir.toml")
    (tracker,) = mission.trackers
    assert not tracker.camera.calibrated
    assert tracker.camera.zero_point_mag is None
    assert tracker.camera.focal_length_px == pytest.approx(5317, abs=1)
    assert tracker.field_of_view_radius_deg > tracker.camera.corner_radius_deg
    assert mission.zone.radius_deg > tracker.field_of_view_radius_deg
    assert 6.5 < mission.catalog.magnitude_limit_mag < 8.0
    exact = parse_mission(
        'name = "A"\n[camera]\nwidth_px = 640\nheight_px = 480\nfocal_length_px = 2000', "a.toml"
    )
    assert exact.trackers[0].camera.calibrated


def test_a_pitch_and_a_focal_length_in_millimetres_tell_the_scale():
    text = 'name = "A"\n[camera]\nwidth_px = 640\nheight_px = 480\n'
    mission = parse_mission(text + "focal_length_mm = 25\npixel_um = 5", "a.toml")
    assert mission.trackers[0].camera.focal_length_px == 5000.0


@pytest.mark.parametrize(
    "camera",
    [
        "width_px = 640",
        "width_px = 'many'\nheight_px = 480",
        "width_px = 640\nheight_px = 480\nfield_of_view_deg = 0",
        "width_px = 640\nheight_px = 480\nfield_of_view_deg = nan",
        "width_px = 640\nheight_px = 480\nfocal_length_mm = 25",
        "width_px = 640\nheight_px = 480\nlens = 'a good one'",
        "width_px = 640\nheight_px = 1e9",
    ],
)
def test_what_is_wrong_with_a_short_file_is_refused_with_words(camera):
    with pytest.raises(BadConfiguration, match="camera"):
        parse_mission(f'name = "A"\n[camera]\n{camera}', "a.toml")


@pytest.mark.parametrize("field", [10.5, 12.5])
def test_the_frame_of_a_rough_camera_becomes_a_batch_with_its_lens_fitted(field):
    mission = parse_mission(ROUGH.format(field=field), "flir.toml")
    name = "cedarsolve-2019-07-29T204726_Alt40_Azi-135_Try1.jpg"
    with (FOLDER / name).open("rb") as file:
        made = submit_frame(file, "sha256:0", KNOWN, mission, load_embedded(), 10_000_000)
    assert made.frame.remarks[0].startswith("lens_fitted: focal length 51")
    (observations,) = made.batch.observations
    assert len(observations.magnitude_mag) > 20
    assert np.isfinite(observations.magnitude_mag).all()
    assert made.batch.a_priori is not None
    assert len(made.frame.stars) == len(observations.magnitude_mag)


def test_a_time_may_be_absent_where_aberration_is_ignored():
    mission = parse_mission(ROUGH.format(field=11.0), "flir.toml")
    catalog, size = load_embedded(), 10_000_000

    def submitted(**known):
        with (FOLDER / "cedarsolve-2019-07-29T204726_Alt40_Azi-135_Try1.jpg").open("rb") as file:
            return submit_frame(file, "sha256:0", FrameIn(**known), mission, catalog, size)

    with pytest.raises(BadBatch, match="may be absent where aberration is ignored"):
        submitted()
    made = submitted(aberration="ignore")
    assert made.frame.remarks[-1].startswith("time_unknown")
    assert made.batch.aberration == "ignore"
    assert made.batch.a_priori is not None


@pytest.mark.slow
def test_a_frame_without_an_attitude_still_becomes_a_batch(rng):
    mission = parse_mission(ROUGH.format(field=11.0), "flir.toml")
    counts = rng.normal(50.0, 3.0, (768, 1024))
    for u, v in rng.uniform(50, 700, (5, 2)).astype(int):
        counts[v - 1 : v + 2, u - 1 : u + 2] += 60.0
    made = submit_frame(_file(counts), "sha256:0", KNOWN, mission, load_embedded(), 10_000_000)
    assert made.batch.a_priori is None
    assert any(each.startswith("try_next") for each in made.frame.remarks)


def _file(counts):
    return io.BytesIO(jpeg_of(np.clip(counts, 0, 255).astype(np.uint8), 95))


def test_a_camera_is_calibrated_from_its_pictures_alone(pictures, tmp_path, capsys):
    target = tmp_path / "mycam.toml"
    assert main(["camera", "calibrate", *map(str, pictures), "-o", str(target)]) == 0
    told = capsys.readouterr().out
    assert "not_observable" in told
    mission = read_mission(target)
    assert mission.name == "MYCAM"
    camera = mission.trackers[0].camera
    assert camera.calibrated
    assert camera.zero_point_mag is not None
    assert camera.focal_length_px == pytest.approx(LENS.focal_px, rel=5e-4)
    # The lens as a whole, at places all over the sensor.
    u, v = (each.ravel() for each in np.meshgrid(np.linspace(50, 970, 9), np.linspace(50, 700, 7)))
    found, truth = camera.directions(u, v), LENS.directions(u, v)
    apart = found - truth @ rotation_between(found, truth).T
    assert np.abs(apart).max() * LENS.focal_px < 0.5
    for word in ("before", "after"):
        with Image.open(tmp_path / f"mycam-residuals-{word}.png") as picture:
            assert picture.width == 900


def test_a_dark_frame_goes_with_the_pictures_of_a_calibration(pictures, tmp_path, capsys):
    dark, target = tmp_path / "dark.jpg", tmp_path / "mycam.toml"
    dark.write_bytes(jpeg_of(np.full((768, 1024), 1, np.uint8)))
    files = [str(each) for each in pictures[:2]]
    assert main(["camera", "calibrate", *files, "--dark", str(dark), "-o", str(target)]) == 0
    dark.write_bytes(jpeg_of(np.full((100, 100), 1, np.uint8)))
    assert main(["frame", files[0], "--dark", str(dark), "--overlay", str(tmp_path)]) == 1
    assert "size of its dark frame" in capsys.readouterr().err


def test_claimed_sigmas_of_a_calibration_hold(blind):
    """Stars alone, without pixels: places with noise of a tenth of a pixel."""
    sky, solver = blind
    rng, pulls = np.random.default_rng(5), []
    for _ in range(draws(6, 12)):
        lens = Lens(1024, 768, rng.uniform(2000.0, 4000.0), *rng.normal(0.0, 0.01, 3))
        results = []
        for _ in range(4):
            counts = draw_picture(rng, sky, lens=lens, stars=35, quality=None).counts
            frame = Frame(counts.astype(np.float32), "NPY", "sha256:0", 255.0)
            result = solve_picture(frame, sky, solver, lens.focal_px)
            if result.attitude is not None:
                results.append(result)
        stars = [sky.direction[[star.row for star in each.attitude.stars]] for each in results]
        found = calibrate_camera(results, stars)
        pulls.append(np.log(found.lens.focal_px / lens.focal_px) / found.sigma(0))
    assert np.mean(np.abs(pulls) < 3.0) >= 0.9


def test_a_calibration_without_an_attitude_is_refused(tmp_path, capsys, rng):
    picture = tmp_path / "noise.jpg"
    picture.write_bytes(_file(rng.normal(50, 3, (100, 150))).getvalue())
    assert main(["camera", "calibrate", str(picture), "-o", str(tmp_path / "a.toml")]) == 2
    assert "nothing to calibrate with" in capsys.readouterr().err


def test_a_jpeg_of_a_rough_camera_is_recorded_with_its_overlay(tmp_path, capsys, monkeypatch):
    (tmp_path / "flir.toml").write_text(ROUGH.format(field=11.0))
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path))
    picture = FOLDER / "cedarsolve-2019-07-29T204726_Alt40_Azi-135_Try1.jpg"
    database = f"sqlite:///{tmp_path / 'records.db'}"
    overlay = tmp_path / "overlay.png"
    options = ["--spacecraft", "FLIR", "--time", "2019-07-29T20:47:26Z", "--json"]
    options += ["--in-process", "--database", database, "--overlay", str(overlay)]
    assert main(["frame", str(picture), *options]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["frame"]["format"] == "JPEG"
    assert answer["frame"]["remarks"][0].startswith("lens_fitted")
    assert answer["attitude"]["status"] == "good"
    error = attitude_error_arcsec(
        matrix_from_quaternion(answer["attitude"]["quaternion"]),
        TRUTH[picture.name]["rotation_icrs_to_camera"],
    )
    assert np.abs(error).max() < 360
    assert overlay.read_bytes().startswith(b"\x89PNG")

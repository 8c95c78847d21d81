"""Pictures of any camera, solved over HTTP and by the command, in every format."""

import base64
import gzip
import io
import json
import random
from pathlib import Path

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from service.cli import main
from service.features.pictures.tracker.simulated import frame_bytes
from service.missions.mission import load_missions
from service.vectors import matrix_from_quaternion
from tests.features.pictures.hostile_headers import absurd_files, good_files, with_absurd_header
from tests.features.pictures.test_frames_over_http import URL
from tests.scale import draws, size, some_in_a_sitting

PLEIADES = Path(__file__).with_name("cedarsolve-pleiades.jpg")
OCTETS = {"Content-Type": "application/octet-stream"}


def test_a_picture_of_any_camera_is_solved_and_nothing_is_recorded(client):
    before = client.get("/api/v1/batches?run=*&limit=1").json()
    asked = {"overlay": "true", "field_of_view_deg": "11"}
    answer = client.post(
        "/api/v1/pictures", params=asked, content=PLEIADES.read_bytes(), headers=OCTETS
    )
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert abs(found["attitude"]["ra_deg"] - 56.9) < 2.0
    assert abs(found["attitude"]["dec_deg"] - 24.1) < 2.0
    assert "Alcyone" in [star["name"] for star in found["stars"]]
    drawn = Image.open(io.BytesIO(base64.b64decode(found["overlay_png"])))
    assert drawn.format == "PNG"
    assert max(drawn.size) >= 800
    assert client.get("/api/v1/batches?run=*&limit=1").json() == before


def test_a_picture_of_a_mission_s_camera_has_the_attitude_of_the_truth(client, frames):
    address = "/api/v1/pictures?spacecraft=IMAGER"
    found = client.post(address, content=frame_bytes(frames[1]), headers=OCTETS).json()
    assert found["time"] == frames[1].known["time"]
    truth = matrix_from_quaternion(frames[1].truth["quaternion"])
    tracker = load_missions()["IMAGER"].trackers[0]
    boresight = tracker.boresight_body @ truth
    seen = matrix_from_quaternion(found["attitude"]["quaternion"])[2]
    assert np.degrees(np.arccos(boresight @ seen)) < 0.05


@pytest.mark.slow
def test_a_picture_without_stars_says_what_to_try_and_names_no_option_of_a_command(client):
    noise = np.random.default_rng(3).normal(40.0, 3.0, (480, 640)).clip(0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "PNG")
    found = client.post("/api/v1/pictures", content=file.getvalue(), headers=OCTETS).json()
    assert found["attitude"] is None
    assert found["stars"] == []
    assert found["lens"] is None
    assert any(each.startswith("try_next: ") for each in found["remarks"])
    assert not any("--" in each for each in found["remarks"])


@pytest.mark.parametrize(
    ("query", "status"),
    [("spacecraft=NOPE", 404), ("spacecraft=XTE", 422), ("spacecraft=IMAGER", 422)],
)
def test_a_picture_of_a_camera_that_is_not_there_or_of_another_size_is_refused(
    client, query, status
):
    content = PLEIADES.read_bytes()
    answer = client.post(f"/api/v1/pictures?{query}", content=content, headers=OCTETS)
    assert answer.status_code == status, answer.text


def fits_file(values, **more):
    file = io.BytesIO()
    units = [fits.PrimaryHDU(values)]
    if more:
        units = [fits.PrimaryHDU(), fits.CompImageHDU(values, **more)]
    fits.HDUList(units).writeto(file)
    return file.getvalue()


def tiff_file(values, **layout):
    file = io.BytesIO()
    tifffile.imwrite(file, values, **layout)
    return file.getvalue()


def in_8_bits(values):
    """The same with a quarter of its light in steps of 8 bits."""
    return np.clip((values.astype(float) - np.median(values)) / 4.0 + 30.0, 0, 255).astype(np.uint8)


FORMATS = {
    "FITS": fits_file,
    "FITS of 64 bits": lambda v: fits_file(v.astype(">f8")),
    "FITS of 0 to 1": lambda v: fits_file(v.astype(">f4") / 65535.0),
    "FITS in tiles of Rice": lambda v: fits_file(v, compression_type="RICE_1"),
    "FITS in tiles of gzip": lambda v: fits_file(v, compression_type="GZIP_2"),
    "TIFF": tiff_file,
    "TIFF of 0 to 1": lambda v: tiff_file(v.astype("f4") / 65535.0),
    "BigTIFF": lambda v: tiff_file(v, bigtiff=True, byteorder=">"),
    "TIFF of ImageJ": lambda v: tiff_file(v, imagej=True),
    "NPY": lambda v: picture_file(v, "NPY"),
    "PNG": lambda v: picture_file(v, "PNG"),
    "PGM": lambda v: picture_file(v, "PPM"),
    "JPEG": lambda v: picture_file(in_8_bits(v), "JPEG", quality=95),
    "GIF": lambda v: picture_file(in_8_bits(v), "GIF"),
    "BMP": lambda v: picture_file(in_8_bits(v), "BMP"),
}
"""Every format that the documents name; a camera's raw file needs a package of its own."""


def picture_file(values, file_format, **more):
    file = io.BytesIO()
    if file_format == "NPY":
        np.save(file, values)
    else:
        Image.fromarray(values).save(file, file_format, **more)
    return file.getvalue()


@pytest.mark.parametrize("name", some_in_a_sitting([*FORMATS]))
def test_every_format_is_read_by_every_way(client, send, frames, tmp_path, capsys, name):
    """From a file, over HTTP as the console sends it, as a spacecraft's frame, and each in gzip."""
    truth = matrix_from_quaternion(frames[0].truth["quaternion"])
    tracker = load_missions()["IMAGER"].trackers[0]
    boresight = tracker.boresight_body @ truth
    content = FORMATS[name](frames[0].counts)
    for data in (content, gzip.compress(content, 1)):
        answer = client.post("/api/v1/pictures?spacecraft=IMAGER", content=data, headers=OCTETS)
        assert answer.status_code == 200, answer.text
        found = matrix_from_quaternion(answer.json()["attitude"]["quaternion"])[2]
        assert np.degrees(np.arccos(min(boresight @ found, 1.0))) < 0.05
        known = frames[0].known | {"batch": f"{name} {len(data)}".replace(" ", "-")}
        recorded = send(data, known)
        # A camera's gain and zero point are those of 16 bits.
        expected = (201, 422) if "0 to 1" in name or name in ("JPEG", "GIF", "BMP") else (201,)
        assert recorded.status_code in expected, recorded.text
        if recorded.status_code == 422:
            assert "no star that could be used" in recorded.text
        path = tmp_path / "picture"
        path.write_bytes(data)
        asked = ["frame", str(path), "--fov", "10", "--json", "--overlay", str(tmp_path / "o.png")]
        assert main(asked) == 0
        told = json.loads(capsys.readouterr().out)
        found = matrix_from_quaternion(told["attitude"]["quaternion"])[2]
        assert np.degrees(np.arccos(min(boresight @ found, 1.0))) < 0.05


TIMES = {
    "an exposure in milliseconds": (
        {
            "DATE-OBS": ("2026-03-01T00:00:00", "start of the exposure"),
            "EXPTIME": (500, "exposure time in milliseconds"),
        },
        ("2026-03-01T00:00:00.250Z", 0.5),
    ),
    "local time": (
        {
            "DATE-OBS": ("2026-03-01T09:00:00", "Local time of start of exposure"),
            "UTCOFFS": 9,
            "EXPTIME": 0.5,
        },
        ("2026-03-01T00:00:00.250Z", 0.5),
    ),
    "local time of an unknown place": (
        {"DATE-OBS": ("2026-03-01T09:00:00", "Local time"), "EXPTIME": 0.5},
        (None, 0.5),
    ),
}


@pytest.mark.parametrize("case", TIMES)
def test_the_comments_of_a_header_count_over_http_too(client, send, frames, case):
    cards, (time, exposure_s) = TIMES[case]
    unit = fits.PrimaryHDU(frames[0].counts)
    for key, value in cards.items():
        unit.header[key] = value
    file = io.BytesIO()
    unit.writeto(file)
    told = client.post("/api/v1/pictures", content=file.getvalue(), headers=OCTETS).json()
    assert (told["time"], told["exposure_s"]) == (time, exposure_s)
    recorded = send(file.getvalue(), {"batch": case.replace(" ", "-"), "a_priori": None})
    if time is None:
        assert recorded.status_code == 422
        assert recorded.json()["errors"][0]["field"] == "time"
    else:
        assert recorded.status_code == 201, recorded.text
        answer = recorded.json()
        assert (answer["time"], answer["frame"]["exposure_s"]) == (time, exposure_s)


def test_a_projection_is_told_by_its_name(client):
    asked = {"lens": "equidistant", "field_of_view_deg": "11"}
    content = PLEIADES.read_bytes()
    found = client.post("/api/v1/pictures", params=asked, content=content, headers=OCTETS).json()
    assert found["lens"]["projection"] == "equidistant"
    assert "Alcyone" in [star["name"] for star in found["stars"]]
    refused = client.post("/api/v1/pictures?lens=wide", content=content, headers=OCTETS)
    assert refused.status_code == 422
    assert "equisolid" in refused.text


ABSURD = absurd_files(np.random.default_rng(4))


@pytest.mark.parametrize("route", ["/api/v1/pictures", URL])
def test_an_absurd_header_is_the_client_s_mistake(client, route):
    for name, (data, word) in ABSURD.items():
        answer = client.post(route, content=data, headers=OCTETS)
        assert answer.status_code == 422, (name, answer.text)
        (fault,) = answer.json()["errors"]
        assert fault["field"] == "frame"
        # A frame of a tracker has to have its size.
        assert word in fault["message"] + str(fault.get("value")) or route == URL, name


@pytest.mark.torture
def test_no_header_of_a_picture_is_answered_with_a_fault_of_ours(client, seed):
    draw, files = random.Random(seed), good_files(np.random.default_rng(seed))
    for name in draw.sample(sorted(files), draws(8, len(files))):
        for _ in range(size(2_000)):
            content = with_absurd_header(name, files[name], draw)
            answer = client.post("/api/v1/pictures", content=content, headers=OCTETS)
            assert answer.status_code in (200, 422), (name, answer.text)

"""A frame in, identification and attitude out: recorded, repeated, frames, refused with words."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.missions.mission import load_missions
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from tests.web.test_bodies import raw

URL = "/api/v1/spacecraft/IMAGER/frames"


@pytest.fixture(scope="module")
def frames(app):
    mission = load_missions()["IMAGER"]
    return list(draw_frames(mission, app.sky, FrameSettings(frames=2, seed=5)))


@pytest.fixture
def send(client):
    def post(frame, known, url=URL, **headers):
        content = frame if isinstance(frame, bytes) else frame_bytes(frame)
        query = {
            name: value if isinstance(value, str) else json.dumps(value)
            for name, value in known.items()
        }
        headers = {"Content-Type": "application/fits"} | headers
        return client.post(url, params=query, content=content, headers=headers)

    return post


@pytest.fixture(scope="module")
def recorded(client, frames):
    """The first frame, recorded, with what was told of it."""
    known = frames[0].known | {"batch": "recorded"}
    query = {k: v if isinstance(v, str) else json.dumps(v) for k, v in known.items()}
    answer = client.post(
        URL,
        params=query,
        content=frame_bytes(frames[0]),
        headers={"Content-Type": "application/octet-stream"},
    )
    assert answer.status_code == 201, answer.text
    return answer.json(), known


def test_the_attitude_is_that_of_the_truth_within_its_own_sigmas(recorded, frames):
    answer, _ = recorded
    attitude = answer["attitude"]
    assert attitude["status"] == "good"
    error = attitude_error_arcsec(
        matrix_from_quaternion(attitude["quaternion"]),
        matrix_from_quaternion(frames[0].truth["quaternion"]),
    )
    assert error @ np.linalg.solve(attitude["covariance_arcsec2"], error) < 30.0
    assert answer["counts"]["unique"] >= 5
    assert answer["frame"]["used"] == answer["counts"]["observed"]


def test_the_record_holds_the_batch_and_what_was_found(client, recorded):
    answer, known = recorded
    record = client.get(f"/api/v1/batches/{answer['id']}").json()
    stars = record["input"]["observations"][0]["stars"]
    used = [star for star in record["frame"]["stars"] if star["used"]]
    assert len(stars) == len(used) == answer["frame"]["used"]
    assert [star["magnitude"] for star in stars] == [star["magnitude"] for star in used]
    assert record["input"]["a_priori"]["quaternion"] == known["a_priori"]["quaternion"]
    # The batch alone explains the answer: sent again as a batch it gives the same attitude.
    again = record["input"] | {"batch": "as-a-batch"}
    other = client.post("/api/v1/batches", json=again).json()
    assert other["attitude"]["quaternion"] == answer["attitude"]["quaternion"]


@pytest.mark.parametrize("told", [None, "nothing"])
def test_a_frame_of_which_nothing_is_known_is_found_in_the_whole_sky(send, frames, told):
    """`a_priori` may be null, or left out: a camera says enough by itself."""
    known = {name: value for name, value in frames[1].known.items() if name != "a_priori"}
    known |= {"batch": f"whole-sky-{told}"} | ({"a_priori": None} if told is None else {})
    answer = send(frames[1], known)
    assert answer.status_code == 201, answer.text
    attitude = answer.json()["attitude"]
    assert attitude["status"] == "good"
    assert answer.json()["path"] == "lost_in_space"
    error = attitude_error_arcsec(
        matrix_from_quaternion(attitude["quaternion"]),
        matrix_from_quaternion(frames[1].truth["quaternion"]),
    )
    assert error @ np.linalg.solve(attitude["covariance_arcsec2"], error) < 30.0


def test_the_same_frame_again_gives_the_first_answer_and_another_is_a_conflict(
    send, recorded, frames
):
    answer, known = recorded
    again = send(frames[0], known)
    assert (again.status_code, again.headers["Replayed"]) == (200, "true")
    assert again.json() == answer
    assert send(frames[1], known).status_code == 409
    assert send(frames[0], known | {"aberration": "ignore"}).status_code == 409


def test_without_a_batch_id_the_frame_s_digest_names_the_batch(send, frames):
    known = {name: value for name, value in frames[1].known.items() if name != "batch"}
    answer = send(frames[1], known)
    assert answer.status_code == 201
    digest = answer.json()["frame"]["digest"]
    assert answer.json()["batch"] == "frame-" + digest[7:23]
    assert send(frames[1], known).status_code == 200


@pytest.mark.parametrize("file_format", ["tiff", "png", "npy"])
@pytest.mark.parametrize("method", ["window", "recursive"])
def test_every_kind_of_file_and_method_gives_an_attitude(send, frames, file_format, method):
    known = frames[0].known | {"batch": f"{file_format}-{method}", "centroid": method}
    answer = send(frame_bytes(frames[0], file_format), known)
    assert answer.status_code == 201, answer.text
    assert answer.json()["attitude"]["status"] == "good"
    assert answer.json()["frame"]["centroid"] == method


def test_the_overlay_is_a_picture_of_the_frame_also_for_a_what_if(client, recorded):
    answer, _ = recorded
    here = f"/api/v1/batches/{answer['id']}"
    first = client.get(f"{here}/overlay")
    with Image.open(io.BytesIO(first.content)) as picture:
        assert picture.format == "PNG"
        assert picture.size[0] == 1024
        colors = {color for _, color in picture.getcolors(1 << 20)}
    assert (90, 220, 120) in colors  # a unique star
    assert (110, 200, 255) in colors  # a residual arrow
    asked = {"options": {"solver": "triad"}, "record": True}
    other = client.post(f"{here}/what-if", json=asked).json()
    assert client.get(f"/api/v1/batches/{other['id']}/overlay").status_code == 200


def test_the_overlay_comes_as_plain_bytes_where_these_are_asked_for(client, recorded):
    """As a client asks for it that knows no type of pictures."""
    here = f"/api/v1/batches/{recorded[0]['id']}/overlay"
    picture = client.get(here)
    plain = client.get(here, headers={"Accept": "application/octet-stream"})
    assert picture.headers["content-type"] == "image/png"
    assert plain.headers["content-type"] == "application/octet-stream"
    assert plain.content == picture.content


def test_a_batch_without_a_frame_has_no_overlay(client, post, batch):
    answer = post(batch).json()
    refused = client.get(f"/api/v1/batches/{answer['id']}/overlay")
    assert refused.status_code == 404
    assert "not made of a frame" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("told", "field"),
    [
        ({"time": "noon"}, "time"),
        ({"a_priori": "[1"}, "a_priori"),
        ({"a_priori": '{"quaternion": [1, 2, 3, 4]}'}, "a_priori.quaternion"),
        ({"tracker": "NOPE"}, "tracker"),
        ({"centroid": "guess"}, "centroid"),
        ({"exposure_s": "-1"}, "exposure_s"),
        ({"colour": "red"}, "colour"),
        ({"options": '{"solver": "guess"}'}, "options.solver"),
    ],
)
def test_what_is_told_wrongly_is_named(send, frames, told, field):
    answer = send(frames[0], frames[0].known | {"batch": "wrong"} | told)
    assert answer.status_code == 422
    assert field in [each["field"] for each in answer.json()["errors"]]


def test_a_picture_does_not_tell_its_time_and_is_asked_for_it(send, frames):
    known = {"a_priori": frames[0].known["a_priori"]}
    answer = send(frame_bytes(frames[0], "png"), known)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "time"


@pytest.mark.parametrize("counts", [1e300, -1e300])
def test_a_frame_of_counts_that_are_too_large_is_refused_as_a_frame(send, frames, counts):
    """Not as a detector with a wrong noise, of which its sender has told nothing."""
    values = frames[0].counts.astype(np.float64)
    values[50, 60] = counts
    file = io.BytesIO()
    np.save(file, values)
    answer = send(file.getvalue(), frames[0].known | {"batch": "too large"})
    assert answer.status_code == 422
    (fault,) = answer.json()["errors"]
    assert (fault["field"], fault["value"]) == ("frame", f"{counts:g}")


def test_a_spacecraft_without_a_camera_and_one_that_is_not_there(send, frames):
    answer = send(frames[0], frames[0].known, url="/api/v1/spacecraft/XTE/frames")
    assert (answer.status_code, "no camera" in answer.json()["detail"]) == (422, True)
    answer = send(frames[0], frames[0].known, url="/api/v1/spacecraft/NOPE/frames")
    assert answer.status_code == 404


def test_a_type_that_is_none_and_a_file_that_is_too_large(address, send, frames):
    answer = send(frames[0], frames[0].known, **{"Content-Type": "text/plain"})
    assert answer.status_code == 415
    lines = (f"POST {URL} HTTP/1.1", "Host: localhost", "Content-Type: image/png")
    head = "\r\n".join([*lines, f"Content-Length: {65 << 20}", "", ""])
    assert raw(address, head.encode()).startswith(b"HTTP/1.1 413")


def test_the_page_of_its_batch_shows_the_frame_with_the_stars(client, recorded):
    answer, _ = recorded
    page = client.get(f"/batches/{answer['id']}").raise_for_status().text
    address = f"/api/v1/batches/{answer['id']}/overlay"
    assert f'src="{address}"' in page
    assert f"The frame of this batch with {answer['counts']['observed']} stars" in page
    picture = client.get(address, headers={"Accept": "image/avif,image/webp,image/png,*/*"})
    assert picture.headers["Content-Type"] == "image/png"
    with Image.open(io.BytesIO(picture.content)) as shown:
        assert min(shown.size) > 700

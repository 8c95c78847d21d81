"""Readings of scanning trackers over HTTP and from files: the attitude that their vectors give."""

import json
import math

import httpx
import numpy as np
import pytest

from service.app.factory import open_app
from service.missions.mission import read_mission
from service.observations.focal_plane import measured_angles_deg, tracker_vectors
from service.observations.scans.reduce import reduced
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.vectors import angle_between_deg, matrix_from_quaternion, rotate_about
from service.web.app import create_app
from tests.observations.test_scans import FILE, lines_of
from tests.web.conformance import check
from tests.web.serving import Server, in_process_settings

URL = "/api/v1/batches"


@pytest.fixture(scope="module")
def scanner():
    return read_mission(FILE)


@pytest.fixture(scope="module")
def scan_app(scanner, chosen_database):
    settings = in_process_settings(chosen_database())
    return open_app(settings, scanner)


@pytest.fixture(scope="module")
def scan_client(scan_app):
    hooks = {"response": [check]}
    with (
        Server(create_app(scan_app)) as url,
        httpx.Client(base_url=url, timeout=60, event_hooks=hooks) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def drawn(scan_app, scanner):
    """Batches of lines and wires; the raster's stars as the sums of its lines, at the epoch."""
    rng = np.random.default_rng(5)
    raster = scanner.tracker("RASTER", "")
    wanted = Pass(batches=6, seed=5, angles_share=1.0, troubles=NO_TROUBLES)
    batches = list(draw_pass(scanner, scan_app.sky, wanted))
    for each in batches:
        rates = raster.body_from_tracker.T @ np.radians(each.batch["body_rates_deg_per_s"])
        (seen,) = [one for one in each.batch["observations"] if one["tracker"] == "RASTER"]
        stars = []
        for star in seen["stars"]:
            there = tracker_vectors(np.array([[star["h_deg"], star["v_deg"]]]), raster.calibration)
            angles = measured_angles_deg(
                rotate_about(rates * star["time_offset_s"], there), raster.calibration
            )
            stars.append((*angles[0], 10.0 ** (0.4 * (18.0 - star["magnitude"]))))
        seen |= {"stars": [], **lines_of(raster.scan, stars, rng)}
    return batches


def with_vectors(body, scanner):
    """The same batch as unit vectors with sigmas."""
    batch = reduced(submission_from_json(json.dumps(body)).batch, scanner)
    observations = []
    for stars in batch.observations:
        vectors = tracker_vectors(stars.angles_deg, scanner.tracker(stars.tracker, "").calibration)
        sent = []
        for k, vector in enumerate(vectors.tolist()):
            star = {"vector": vector, "sigma_arcsec": stars.sigma_arcsec[k]}
            star["time_offset_s"] = stars.time_offset_s[k]
            if np.isfinite(stars.magnitude_mag[k]):
                star["magnitude"] = stars.magnitude_mag[k]
            sent.append(star)
        observations.append({"tracker": stars.tracker, "stars": sent})
    return body | {"observations": observations}


def post(client, body, name):
    return client.post(URL, json=body | {"batch": name})


def test_readings_give_the_attitude_that_their_vectors_give(scan_client, drawn, scanner):
    seen = 0
    for k, each in enumerate(drawn):
        first = post(scan_client, each.batch, f"readings-{k}").raise_for_status().json()
        again = post(scan_client, with_vectors(each.batch, scanner), f"vectors-{k}")
        other = again.raise_for_status().json()["attitude"]
        assert first["attitude"]["quaternion"] == pytest.approx(other["quaternion"], abs=1e-9)
        assert first["attitude"]["taste"] == pytest.approx(other["taste"], abs=1e-6)
        truth = matrix_from_quaternion(np.array(each.truth["quaternion"]))
        found = matrix_from_quaternion(np.array(first["attitude"]["quaternion"]))
        assert max(angle_between_deg(found[i], truth[i]) for i in range(3)) * 3600.0 < 20.0
        seen += sum(len(one["stars"]) for one in first["observations"])
    assert seen > 30


def test_counts_give_the_attitude_of_vectors_that_were_computed_by_hand(scan_client, drawn):
    """Equations 7.21 and 7.22 of the report for each line, and (tan h, tan v, 1)."""
    (lines,) = [one for one in drawn[0].batch["observations"] if one["tracker"] == "LINES"]
    stars = []
    for star in lines["stars"]:
        plane, variance = [], 1.0
        for axis in "hv":
            counts = star[f"{axis}_counts"]
            light = [each - 50.0 for each in counts]
            d = sum((n - 12) * each for n, each in enumerate(light)) / sum(light)
            square = sum((n - 12 - d) ** 2 * (16.0 + each / 2.0) for n, each in enumerate(counts))
            variance += 0.5 * 15.0**2 * square / sum(light) ** 2
            plane.append(math.tan(math.radians(star[f"{axis}_deg"] + 15.0 * d / 3600.0)))
        vector = np.array([*plane, 1.0]) / math.hypot(*plane, 1.0)
        given = {name: star[name] for name in ("magnitude", "time_offset_s")}
        stars.append({"vector": vector.tolist(), "sigma_arcsec": math.sqrt(variance), **given})
    found = []
    for name, sent in (("by-counts", lines["stars"]), ("by-hand", stars)):
        alone = drawn[0].batch | {"observations": [{"tracker": "LINES", "stars": sent}]}
        found.append(post(scan_client, alone, name).raise_for_status().json()["attitude"])
    assert len(stars) > 2
    assert found[0]["quaternion"] == pytest.approx(found[1]["quaternion"], abs=1e-9)
    first, second = (np.array(each["covariance_arcsec2"]) for each in found)
    assert first == pytest.approx(second, rel=1e-6)


def test_the_record_keeps_what_was_sent(scan_client, scan_app, drawn):
    body = drawn[1].batch
    answer = post(scan_client, body, "kept").raise_for_status().json()
    record = scan_client.get(f"{URL}/{answer['id']}").json()
    assert record["input"]["observations"] == body["observations"]
    assert post(scan_client, body, "kept").headers["Replayed"] == "true"
    tried = scan_client.post(f"{URL}/{answer['id']}/what-if", json={}).raise_for_status().json()
    assert tried["attitude"]["quaternion"] == answer["attitude"]["quaternion"]
    page = scan_client.get(f"/batches/{answer['id']}")
    assert page.status_code == 200
    tracks = scan_client.get("/api/v1/spacecraft/SCANNER/tracks").raise_for_status().json()
    assert tracks["batches"] >= 1


@pytest.mark.parametrize(
    ("tracker", "given", "field"),
    [
        ("LINES", {"h_counts": [60.0] * 24}, "stars.0.h_counts"),
        ("LINES", {"h_counts": [-1.0] * 25}, "stars.0.h_counts.0"),
        ("LINES", {"v_counts": None}, "stars.0"),
        ("WIRES", {"h_times": [3.0, 2.0, 4.0]}, "stars.0.h_times.1"),
        ("WIRES", {"h_times": [1.0, 2.0, 9e9]}, "stars.0.h_times.2"),
        ("WIRES", {"v_times": [1.0, 2.0]}, "stars.0.v_times"),
        ("RASTER", {"row_counts": [1.0] * 9}, "row_counts"),
    ],
)
def test_readings_that_cannot_be_are_a_422_by_name(scan_client, drawn, tracker, given, field):
    body = json.loads(json.dumps(drawn[0].batch))
    index, seen = next(
        (k, one) for k, one in enumerate(body["observations"]) if one["tracker"] == tracker
    )
    (seen["stars"][0] if seen["stars"] else seen).update(given)
    answer = post(scan_client, body, "refused")
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == f"observations.{index}.{field}"


def test_not_a_number_is_a_422(scan_client, drawn):
    body = json.loads(json.dumps(drawn[0].batch))
    (lines,) = [one for one in body["observations"] if one["tracker"] == "LINES"]
    lines["stars"][0]["h_counts"][3] = math.nan
    sent = json.dumps(body | {"batch": "nan"}).encode()
    answer = scan_client.post(URL, content=sent, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert "h_counts.3" in answer.json()["errors"][0]["field"]


def test_the_example_is_checked_without_a_finding_that_it_is_wrong(acquire):
    assert acquire("mission", "check", FILE)[0] == 0


@pytest.mark.parametrize(
    ("before", "after", "key"),
    [
        ("duration_s = 0.9", "duration_s = 0.5", "trackers.1.scan"),
        ("time_sigma_s = 1e-4", "time_sigma_s = 1e-3", "trackers.1.sigma_arcsec"),
        ("columns = 401", "columns = 201", "trackers.2.scan"),
    ],
)
def test_a_scan_that_does_not_fit_its_tracker_is_unusual(acquire, tmp_path, before, after, key):
    text = FILE.read_text(encoding="utf-8")
    assert before in text
    (tmp_path / "mine.toml").write_text(text.replace(before, after))
    _, out, _ = acquire("mission", "check", "mine.toml", "--json")
    assert key in [each["key"] for each in json.loads(out)["findings"]]

"""Filtered and smoothed attitudes leave the service in every format, which names the grade."""

import csv
import io
import json
import re
import zipfile

import httpx
import numpy as np
import pytest
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from service.cli import main
from service.ephemerides.aem import read_aem
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.part import Definitive
from service.features.products.attitude_formats import attitude_formats, write_attitudes
from service.features.products.part import Products
from service.times import parse_utc, shifted
from service.web.app import create_app
from tests.features.definitive.passes import NOON, NOON_NS
from tests.features.definitive.records import put_attitudes, put_pass
from tests.features.definitive.simulated import ARCSEC
from tests.web.conformance import check
from tests.web.serving import Server

WORDS = {"filtered": "ekf", "smoothed": "filter_smoother"}
ADDRESS = "/api/v1/spacecraft/XTE/attitude"


@pytest.fixture
def smoothed(app, half_hour):
    """Half an hour in both grades."""
    put_pass(app, half_hour[1])
    app.part(Definitive).days.smooth("XTE")
    return app


@pytest.fixture
def client(smoothed):
    with (
        Server(create_app(smoothed)) as address,
        httpx.Client(base_url=address, timeout=60, event_hooks={"response": [check]}) as client,
    ):
        yield client


def whole(series):
    blocks = list(series.blocks)
    joined = blocks[0]
    for each in blocks[1:]:
        joined = joined.followed_by(each)
    return joined


@pytest.mark.parametrize("grade", WORDS)
def test_a_series_has_the_samples_in_order_of_time(smoothed, half_hour, grade):
    truth, _ = half_hour
    rows = whole(smoothed.part(Products).attitudes("XTE", grade=grade))
    # Seven measurements confirm the filter's start; the smoother knows of them.
    expected = np.arange(0 if grade == "smoothed" else 48, 1801)
    assert (rows.time_ns - NOON_NS).tolist() == (expected * 10**9).tolist()
    assert rows.time[0] == shifted(NOON, float(expected[0])).text
    assert set(rows.method) == {WORDS[grade]}
    assert set(rows.model) == {"gyro"}
    assert set(rows.revision.tolist()) == {1}
    assert set(rows.rate_origin) == {"estimated"}
    assert set(rows.stretch.tolist()) == {0}
    error = (Rotation.from_quat(rows.quaternion).inv() * truth.attitude[expected]).as_rotvec()
    assert np.abs(error[600:]).max() < 30.0 * ARCSEC
    newest = whole(smoothed.part(Products).attitudes("XTE", grade=grade, order="newest"))
    np.testing.assert_array_equal(newest.time_ns, rows.time_ns[::-1])


def test_a_period_is_cut_to_the_sample(smoothed):
    start, end = (shifted(NOON, seconds) for seconds in (100.0, 110.0))
    rows = whole(smoothed.part(Products).attitudes("XTE", grade="smoothed", start=start, end=end))
    assert rows.time_ns.tolist() == [start.tai_ns + k * 10**9 for k in range(10)]
    none = smoothed.part(Products).attitudes(
        "XTE", grade="smoothed", start=parse_utc("1999-03-02T00:00:00Z")
    )
    assert list(none.blocks) == []
    none = smoothed.part(Products).attitudes("XTE", run="other", grade="smoothed")
    assert list(none.blocks) == []


def test_suspect_samples_are_given_when_they_are_asked_for(smoothed):
    rows = whole(smoothed.part(Products).attitudes("XTE", grade="filtered", status="all"))
    assert len(rows) == 1801
    assert rows.status[:49].tolist() == ["suspect"] * 48 + ["good"]


@pytest.mark.parametrize("name", attitude_formats())
def test_every_format_names_the_grade(smoothed, name):
    series = smoothed.part(Products).attitudes("XTE", grade="smoothed")
    data = b"".join(write_attitudes(name, series))
    if name == "csv":
        assert b"filter_smoother" in data
    elif name == "ck":
        with zipfile.ZipFile(io.BytesIO(data)) as files:
            assert b"grade: smoothed" in files.read("README.txt")
    elif name == "parquet":
        table = parquet.read_table(io.BytesIO(data))
        assert table.schema.metadata[b"grade"] == b"smoothed"
        assert table.num_rows == 1801
    else:
        assert b"smoothed" in data


def test_an_acm_names_the_method_in_the_standard_s_words(smoothed):
    for grade, word in WORDS.items():
        series = smoothed.part(Products).attitudes("XTE", grade=grade)
        text = b"".join(write_attitudes("acm", series))
        assert re.search(rf"^AD_METHOD\s*= {word.upper()}$", text.decode(), re.MULTILINE)
        # Sums of stars are those of batches.
        assert b"USER_DEFINED_STARS" not in text


def test_an_aem_is_read_again(smoothed):
    rows = whole(smoothed.part(Products).attitudes("XTE", grade="smoothed"))
    series = smoothed.part(Products).attitudes("XTE", grade="smoothed")
    text = b"".join(write_attitudes("aem", series))
    assert b"COMMENT Angular velocity estimated by the filter" in text
    again = read_aem("xte.aem", io.BytesIO(text)).at(rows.time_ns)
    np.testing.assert_allclose(again, rows.quaternion, atol=1e-15)


def test_the_interface_answers_as_it_says(client):
    period = {"start": NOON.text, "end": shifted(NOON, 60.0).text}
    for grade in ("raw", *WORDS):
        answer = client.get(ADDRESS, params=period | {"grade": grade}).json()
        assert answer["about"]["grade"] == grade
    (item, *_) = answer["items"]
    assert (item["method"], item["model"], item["revision"]) == ("filter_smoother", "gyro", 1)
    assert item["batch"] is None
    assert len(item["bias_deg_per_h"]) == 3
    table = client.get(ADDRESS, params=period | {"grade": "filtered", "format": "csv"})
    assert "attitude-filtered" in table.headers["content-disposition"]
    first = next(csv.DictReader(io.StringIO(table.text)))
    assert (first["model"], first["method"]) == ("gyro", "ekf")
    assert client.get(ADDRESS, params={"grade": "best"}).status_code == 422


def test_between_two_samples_the_covariance_is_no_less_than_theirs(client):
    time = shifted(NOON, 900.5).text
    answer = client.get(f"{ADDRESS}/at", params={"time": time, "grade": "smoothed"}).json()
    assert len(answer["ids"]) == 1
    series = {"start": shifted(NOON, 900.0).text, "end": shifted(NOON, 901.5).text}
    pair = client.get(ADDRESS, params=series | {"grade": "smoothed"}).json()["items"]
    covariances = [np.array(each["covariance_arcsec2"]) for each in pair]
    np.testing.assert_allclose(
        answer["covariance_arcsec2"],
        np.mean(covariances, axis=0) + np.eye(3) * answer["motion_arcsec"] ** 2,
        rtol=1e-12,
    )


def test_a_constant_rate_has_no_bias(app, half_hour):
    put_attitudes(app, half_hour[1].attitudes)
    app.part(Definitive).days.smooth("XTE")
    series = app.part(Products).attitudes("XTE", grade="smoothed", status="all")
    (item, *_) = json.loads(b"".join(write_attitudes("json", series)))["items"]
    assert (item["model"], item["bias_deg_per_h"]) == ("constant_rate", None)
    assert b"".join(write_attitudes("fits", app.part(Products).attitudes("XTE", grade="smoothed")))


def test_the_latest_revision_is_given(smoothed, half_hour):
    late = AttitudeMeasurements(
        *(
            getattr(half_hour[1].attitudes, name)[:10]
            for name in ("tai_ns", "quaternion", "covariance_rad2")
        )
    )
    put_attitudes(smoothed, late, name="late")
    smoothed.part(Definitive).days.smooth("XTE")
    rows = whole(smoothed.part(Products).attitudes("XTE", grade="smoothed"))
    assert set(rows.revision.tolist()) == {2}


def test_the_command_exports_a_grade(smoothed, database, capsysbinary):
    smoothed.close()
    asked = ["export", "attitude", "--spacecraft", "XTE", "--grade", "smoothed", "--format", "json"]
    assert main([*asked, "--database", database]) == 0
    answer = json.loads(capsysbinary.readouterr().out)
    assert answer["about"]["grade"] == "smoothed"
    assert len(answer["items"]) == 1801


def test_the_command_gives_a_moment_in_a_grade(smoothed, database, capsys):
    moment = shifted(NOON, 900.5)
    raw, expected = (
        smoothed.part(Products).attitude_at("XTE", moment, "interpolated", grade=grade)
        for grade in ("raw", "smoothed")
    )
    smoothed.close()
    asked = ["export", "attitude-at", moment.text, "--spacecraft", "XTE", "--grade", "smoothed"]
    assert main([*asked, "--database", database]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["quaternion"] == expected.quaternion != raw.quaternion
    assert found["covariance_arcsec2"] == expected.covariance_arcsec2

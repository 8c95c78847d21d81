"""Tracks over HTTP, on pages and by the command, from batches with an object among the stars."""

import json
import re

import numpy as np
import pytest

from service.cli import main
from service.features.tracks.part import Tracks
from service.vectors import from_ra_dec, unit
from tests.features.tracks.drawn import conjunctions, draw
from tests.web.browser import CHROMIUM
from tests.web.fitting import assert_fits

ROUTE = "/api/v1/spacecraft/XTE/tracks"
RUN = "tracks"


@pytest.fixture(scope="module")
def drawn(app, missions):
    rng = np.random.default_rng(7)
    return draw(missions["XTE"], app.sky, conjunctions(rng, 1)[0], rng)


@pytest.fixture(scope="module")
def posted(client, drawn):
    """The ids of the results by the place of their batch."""
    answers = [
        client.post("/api/v1/batches", json=each | {"run": RUN}) for each in drawn.with_points
    ]
    return [each.raise_for_status().json()["id"] for each in answers]


@pytest.fixture
def found(client, posted):
    return client.get(ROUTE, params={"run": RUN}).raise_for_status().json()


def test_the_object_the_planets_and_the_hot_pixels_are_told(found, drawn):
    kinds = sorted(each["kind"] for each in found["items"])
    assert kinds == ["fixed_on_detector"] * 3 + ["moving"] + ["planet"] * 2
    named = {each["planet"] for each in found["items"]} - {None}
    assert named == set(drawn.planets)
    assert found["batches"] == len(drawn.with_points)
    assert found["linked"] == sum(len(each["points"]) for each in found["items"])
    assert found["unexplained"] >= found["linked"]


def test_the_points_of_the_object_are_the_stars_that_were_put_in(found, drawn, posted):
    (track,) = [each for each in found["items"] if each["kind"] == "moving"]
    for point in track["points"]:
        assert drawn.where[posted.index(point["id"])][point["star"]] == "object"
    speed = np.linalg.norm(drawn.rate_arcsec_per_s)
    off = abs(track["rate_arcsec_per_s"] - speed)
    assert off < 4 * track["sigma_rate_arcsec_per_s"]
    assert track["magnitude"] == pytest.approx(5.0, abs=4 * track["sigma_magnitude"])
    # Half-way through, where it was put.
    middle = from_ra_dec(track["ra_deg"], track["dec_deg"])
    assert np.degrees(np.arccos(middle @ unit(drawn.place))) < 0.5


def test_a_period_bounds_what_is_linked(client, found, drawn):
    times = [each["time"] for each in drawn.with_points]
    part = client.get(ROUTE, params={"run": RUN, "start": times[5], "end": times[15]}).json()
    assert part["batches"] == 10
    for track in part["items"]:
        assert times[5][:19] <= track["first"][:19] <= track["last"][:19] <= times[15][:19]


def test_the_tdm_holds_the_moving_track_alone(client, found):
    answer = client.get(ROUTE, params={"run": RUN, "format": "tdm"}).raise_for_status()
    assert answer.headers["content-type"].startswith("text/plain")
    assert answer.headers["content-disposition"].endswith('"XTE-tracks-tracks.tdm"')
    (track,) = [each for each in found["items"] if each["kind"] == "moving"]
    angles = re.findall(r"^ANGLE_1 = \S+ (\S+)$", answer.text, re.MULTILINE)
    assert [float(each) for each in angles] == [each["ra_deg"] for each in track["points"]]
    assert answer.text.count("META_START") == 1


def test_a_period_without_moving_tracks_has_no_tdm(client, posted):
    asked = {"run": RUN, "end": "1990-01-01T00:00:00Z"}
    assert client.get(ROUTE, params=asked).json()["items"] == []
    answer = client.get(ROUTE, params=asked | {"format": "tdm"})
    assert answer.status_code == 404
    assert "no moving track" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"format": "aem"}, "format"),
        ({"start": "1996-01-02T00:00:00Z", "end": "1996-01-01T00:00:00Z"}, "query"),
        ({"size": 3}, "size"),
    ],
)
def test_a_wrong_parameter_is_named(client, asked, field):
    answer = client.get(ROUTE, params=asked)
    assert answer.status_code == 422
    assert field in json.dumps(answer.json()["errors"])


def test_an_unknown_spacecraft_is_not_found(client):
    assert client.get("/api/v1/spacecraft/HAL/tracks").status_code == 404


def test_a_period_of_too_many_batches_is_refused(app, posted):
    with pytest.raises(Exception, match="more than 20 batches; choose a shorter one"):
        app.part(Tracks).of_period("XTE", run=RUN, most_batches=20)


def test_the_period_s_page_lists_the_tracks(client, posted, drawn):
    page = client.get("/spacecraft/XTE/period", params={"run": RUN}).raise_for_status().text
    section = page.partition('aria-labelledby="tracks"')[2].partition("</section>")[0]
    assert len(re.findall(r'<tr>\s*<th scope="row">', section)) == 6
    assert "fixed on detector" in section
    for planet in drawn.planets:
        assert planet in section
    assert "format=tdm" in section


def test_a_batch_s_page_names_its_own_points(client, found, posted):
    (track,) = [each for each in found["items"] if each["kind"] == "moving"]
    point = track["points"][len(track["points"]) // 2]
    page = client.get(f"/batches/{point['id']}", params={"run": RUN}).raise_for_status().text
    section = page.partition('aria-labelledby="tracks"')[2].partition("</section>")[0]
    row = next(each for each in section.split("<tr>") if ">moving" in each)
    assert f"STARTRACKER_1 {point['star'] + 1}<" in row


def test_the_command_says_the_same(app, found, capsys, tmp_path):
    asked = ["tracks", "XTE", "--run", RUN, "--database", app.settings.database]
    assert main([*asked, "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["items"] == found["items"]
    assert main(asked) == 0
    told = capsys.readouterr().out.splitlines()
    assert len(told) == 2 + len(found["items"])
    assert main([*asked, "--format", "tdm", "-o", str(tmp_path / "x.tdm")]) == 0
    assert (tmp_path / "x.tdm").read_text().startswith("CCSDS_TDM_VERS = 2.0")


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
@pytest.mark.slow
def test_the_tables_fit_and_axe_finds_no_fault(address, posted, browser):
    for path in ("/spacecraft/XTE/period", f"/batches/{posted[15]}"):
        assert_fits(browser, f"{address}{path}?run={RUN}")
        assert browser.run("document.querySelector('[aria-labelledby=tracks] td') !== null")
    browser.call("Page.navigate", url="about:blank")

"""Spacecraft and trackers that no mission file describes any more: what is recorded stays."""

import json
import re
from urllib.parse import quote

import httpx
import pytest

from service.errors import BadBatch, BadInput
from service.features.alarms.part import Alarms
from service.features.products.part import open_products
from service.missions.mission import SHIPPED_FOLDER
from service.observations.schema import submission_from_json
from service.trends.limits import LimitSettings
from service.web.app import create_app
from tests.storage import twin
from tests.storage.conftest import opened
from tests.web.conformance import checked
from tests.web.markup import Markup
from tests.web.serving import Server

__all__ = ["opened"]

NAME = "SURVEYOR"
QUICK = LimitSettings.model_validate(
    {"warning": {"high": 2.0}, "critical": {"high": 30.0}, "minimum_count": 1, "duration_s": 0}
)
SECOND = """
[[trackers]]
name = "STARTRACKER_2"
x_axis_body = [0.0, 0.0, 1.0]
y_axis_body = [1.0, 0.0, 0.0]
z_axis_body = [0.0, 1.0, 0.0]
field_of_view_radius_deg = 4.0
sigma_arcsec = 2.1213203
magnitude_sigma_mag = 0.1

[gyro]"""


@pytest.fixture
def folder(tmp_path):
    """A site's folder with a mission of two trackers."""
    made = tmp_path / "missions"
    made.mkdir()
    text = (SHIPPED_FOLDER / "xte.toml").read_text()
    text = text.replace('name = "XTE"', f'name = "{NAME}"\nlost_in_space_fallback = false')
    (made / "surveyor.toml").write_text(text.replace("\n[gyro]", SECOND))
    return made


def submission(app, name, after_s, **wanted):
    sent = json.loads(twin.batch(app.sky, app.missions[NAME], name, after_s=after_s, **wanted))
    return submission_from_json(json.dumps(sent | {"spacecraft": NAME}))


@pytest.fixture
def file(folder, opened):
    """The mission's file; each tracker of the spacecraft has an alarm that is out of its limits."""
    app = opened(missions=folder)
    app.part(Alarms).limits.set(NAME, "residual_ratio", QUICK, who="jb")
    for k in range(4):
        app.submissions.submit(submission(app, f"b{k}", 30.0 * k, noise_arcsec=(30.0, 30.0)))
    assert {each.tracker for each in app.part(Alarms).active()} >= {None, twin.FIRST, twin.SECOND}
    app.close()
    return folder / "surveyor.toml"


def crawled(client, addresses):
    """The status of every page of these addresses, and of its links of each kind."""
    found = {address: client.get(address) for address in addresses}
    kinds = {
        re.sub(r"[0-9A-Z]{26}|=[^&]*", "*", attributes["href"]): attributes["href"]
        for page in found.values()
        for tag, attributes in Markup(page.text).elements
        if tag == "a" and NAME in (attributes.get("href") or "") and "download" not in attributes
    }
    found |= {link: client.get(link) for link in kinds.values()}
    return {address: page.status_code for address, page in found.items()}


def test_a_removed_mission_stays_readable_and_its_alarms_can_be_closed(file, opened):
    file.unlink()
    app = opened(missions=file.parent)
    assert NAME not in app.missions
    (row,) = (each for each in app.spacecraft.overview().items if each.name == NAME)
    assert row.retired
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as plain:
        client = checked(plain)
        alarms = client.get("/api/v1/alarms").json()["items"]
        assert len(row.alarms) == len(alarms) > 2
        own = f"/spacecraft/{NAME}"
        pages = ["/", "/alarms", "/batches", "/missions", own]
        pages += [f"{own}/{each}" for each in ("period", "limits", "grades", "calibration")]
        pages += [f"/alarms/{alarms[0]['id']}", f"/batches/{row.latest_batch.id}"]
        assert set(crawled(client, pages).values()) == {200}
        assert "retired" in client.get("/").text
        assert "Retired" in client.get("/missions").text
        files = ("history?format=csv", "attitude?format=aem&status=all", "tables/stars?format=csv")
        for each in ("", "/attitudes", "/limits", "/rates", *(f"/{name}" for name in files)):
            answer = client.get(f"/api/v1{own}{each}")
            assert answer.status_code == 200, (each, answer.text)
        for alarm in alarms:
            closed = client.post(f"/api/v1/alarms/{alarm['id']}/acknowledge", json={"who": "jb"})
            assert closed.json()["state"] == "cleared"
        again = app.results.get(row.latest_batch.id).input | {"batch": "new"}
        with pytest.raises(BadBatch, match="there is no such spacecraft"):
            app.submissions.submit(submission_from_json(json.dumps(again)))


def test_the_commands_export_a_removed_mission_s_record(file, opened, database):
    file.unlink()
    app = opened(missions=file.parent)
    with open_products(app.settings) as products:
        series = products.attitudes(NAME, status="all")
        assert {each.name for each in series.about.trackers} == {twin.FIRST, twin.SECOND}
        assert sum(map(len, series.blocks)) == 4


def test_a_renamed_tracker_keeps_its_history_and_its_alarm_can_be_closed(file, opened):
    file.write_text(file.read_text().replace(twin.SECOND, "AFT"))
    app = opened(missions=file.parent)
    (alarm,) = (each for each in app.part(Alarms).active() if each.tracker == twin.SECOND)
    old = app.spacecraft.history(NAME, tracker=twin.SECOND, quantities=["residual_ratio"])
    assert old.series
    with pytest.raises(BadInput, match="tracker: SURVEYOR has AFT, STARTRACKER_1"):
        app.spacecraft.history(NAME, tracker="STARTRACKER_9")
    # Batches of the new name do not take it back into its limits.
    app.submissions.submit(submission(app, "b9", 300.0, noise_arcsec=(30.0, 30.0)))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        query = f"?tracker={quote(twin.SECOND)}"
        pages = [f"/spacecraft/{NAME}{query}", f"/spacecraft/{NAME}/period{query}"]
        assert set(crawled(client, [f"/alarms/{alarm.id}", *pages]).values()) == {200}
        assert app.part(Alarms).acknowledge(alarm.id, "jb").state == "cleared"
        (live,) = (each for each in app.part(Alarms).active() if each.tracker == twin.FIRST)
        assert app.part(Alarms).acknowledge(live.id, "jb").state == "acknowledged"


def test_the_page_of_missions_says_that_a_file_was_changed(file, opened):
    app = opened(missions=file.parent)
    assert app.adoptions.changed_files() == {}
    text = file.read_text()
    file.write_text(text.replace("radius_deg = 4.0", "radius_deg = 4.5"))
    assert "changed" in app.adoptions.changed_files()[NAME]
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        assert "it takes effect at the next start" in client.get("/missions").text
        file.write_text(text + "nonsense")
        page = client.get("/missions")
        assert (page.status_code, "not TOML" in page.text) == (200, True)
        file.unlink()
        assert "the next start retires" in client.get("/missions").text

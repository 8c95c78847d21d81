"""The console as markup: what its pages say, and what they do not let through."""

import itertools
import math
import re
import tomllib

import httpx
import numpy as np
import pytest

from service.app.factory import open_app
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.models.overview import Sparkline
from service.vectors import angle_between_deg, matrix_from_quaternion
from service.web.app import create_app
from service.web.console import formatting, options
from service.web.console.charts import sky_chart
from service.web.console.charts.sparkline import HEIGHT, WIDTH, sparkline
from tests.web.console_pages import console_addresses
from tests.web.markup import Markup
from tests.web.serving import Server

HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{7*7}}\u202e"


@pytest.fixture(scope="module")
def empty(chosen_database):
    app = open_app(Settings(database=chosen_database()))
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        yield client


@pytest.fixture(scope="module")
def addresses(client, full_run):
    """Every page of a run with something in it."""
    found = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    names = [*console_addresses(), "/spacecraft/SOHO"]
    return [
        *(f"{name}?run={full_run}" for name in names),
        f"/batches/{found['items'][0]['id']}",
        f"/batches/{found['items'][0]['id']}?tolerances.separation_deg=0.02",
    ]


def text_of(page):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page.text))


# ---- every page ----------------------------------------------------------------------------------


def test_every_page_is_sound_markup_that_runs_nothing_in_place(client, addresses):
    for address in addresses:
        answer = client.get(address)
        assert answer.status_code == 200, (address, answer.text[:500])
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        markup = Markup(answer.text)
        assert len(set(markup.ids())) == len(markup.ids()), address
        for tag, attributes in markup.elements:
            assert tag != "style"
            assert "style" not in attributes
            assert not [name for name in attributes if name.startswith("on")]
            for name in ("href", "src", "action"):
                assert (attributes.get(name) or "/").startswith(("/", "#")), (tag, attributes)


def test_every_page_is_light(client, addresses):
    """With every script and style that it asks for, below 250 kB."""
    for address in addresses:
        weight, seen = len(client.get(address).content), set()
        waiting = re.findall(r'(?:src|href)="(/static/[^"]+)"', client.get(address).text)
        while waiting:
            file = waiting.pop()
            if file in seen:
                continue
            seen.add(file)
            content = client.get(file).text
            weight += len(content.encode())
            waiting += [f"/static/{each}" for each in re.findall(r'from "\./([^"]+)"', content)]
        trends = re.search(r'data-history="([^"]+)"', client.get(address).text)
        if trends:
            weight += len(client.get(trends[1].replace("&amp;", "&")).content)
        assert weight < 250_000, (address, weight)


def test_every_page_says_as_of_when_and_of_which_run(client, addresses, full_run):
    for address in addresses:
        text = text_of(client.get(address))
        assert re.search(r"shown as of \d{4}-\d\d-\d\d \(\d{3}\) \d\d:\d\d:\d\d UTC", text), address
        assert f"Named run {full_run}" in text


def test_every_link_of_every_page_leads_somewhere(client, addresses):
    seen = set()
    for address in addresses:
        for tag, attributes in Markup(client.get(address).text).elements:
            if tag == "a" and (attributes.get("href") or "#").startswith("/"):
                seen.add(attributes["href"].partition("#")[0])
    # Of pages of one kind a few stand for all.
    kinds = {}
    for link in sorted(seen):
        kinds.setdefault(re.sub(r"[0-9A-Z]{26}|=[^&]*", "*", link), []).append(link)
    for links in kinds.values():
        for link in links[:2]:
            assert client.get(link).status_code == 200, link


def test_scripts_and_styles_ask_nothing_of_elsewhere(client):
    asked = set(re.findall(r'"(/static/[^"]+)"', client.get("/").text))
    for file in asked | {"/static/spacecraft.js", "/static/vendor/uplot.min.js"}:
        answer = client.get(file)
        assert answer.status_code == 200, file
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        found = re.findall(r"(?<!\w)https?://[\w.]+", answer.text)
        assert set(found) <= {"http://www.w3.org", "https://github.com"}, file


# ---- nothing there, and things that are not ------------------------------------------------------


def test_with_nothing_recorded_it_says_what_to_do(empty):
    answer = empty.get("/")
    assert answer.status_code == 200
    assert "No live batches yet" in answer.text
    assert "POST /api/v1/batches" in answer.text
    assert "No live batches of XTE yet" in text_of(empty.get("/spacecraft/XTE"))
    assert "No zones are cached" in text_of(empty.get("/zones"))


def test_with_only_named_runs_it_leads_to_them(empty, batch):
    empty.post("/api/v1/batches", json=batch | {"run": "pass-7"}, timeout=60)
    text = empty.get("/").text
    assert "No live batches yet" in text
    assert '<a href="/?run=pass-7">pass-7</a> (1)' in text


@pytest.mark.parametrize(
    ("place", "status", "said"),
    [
        ("/batches/01JD0000000000000000000000", 404, "there is no batch"),
        ("/batches/nothing", 404, "there is no batch"),
        ("/spacecraft/NOBODY", 404, "no spacecraft"),
        ("/spacecraft/XTE?start=yesterday", 422, "start"),
        ("/spacecraft/XTE?by=silence_s", 422, "by"),
        ("/batches?colour=red", 422, "colour"),
        ("/batches/{id}?tolerances.separation_deg=wide", 422, "tolerances.separation_deg"),
        ("/batches/{id}?tolerances.separation_deg=-1", 422, "tolerances.separation_deg"),
        ("/batches/{id}?view=moon", 422, "view"),
        ("/alarms/01JD0000000000000000000000", 404, "there is no alarm"),
        ("/compare?spacecraft=XTE&a.tolerances.separation_deg=wide", 422, "a.tolerances"),
        ("/compare?spacecraft=XTE&sample=9999", 422, "sample"),
    ],
)
def test_what_is_not_there_is_told_on_a_page(client, full_run, place, status, said):
    first = client.get("/api/v1/batches", params={"run": full_run}).json()["items"][0]
    answer = client.get(place.replace("{id}", first["id"]))
    assert answer.status_code == status
    assert answer.headers["content-type"].startswith("text/html")
    assert said in text_of(answer)
    Markup(answer.text)


def test_a_failed_solve_shows_no_attitude_as_the_present_one(client, post, batch, run):
    """The last attitude stands with its own time and in its own words, in overview and page."""
    lone = batch["observations"][0] | {"stars": batch["observations"][0]["stars"][:1]}
    first = post(batch | {"run": run}).json()
    later = {"time": "1999-03-01T05:00:00.000Z", "batch": "later", "observations": [lone]}
    post(batch | {"run": run} | later)
    overview = text_of(client.get(f"/?run={run}"))
    row = overview[overview.index("XTE") :]
    assert "no attitude" in row
    assert "fewer than two unique stars" in row
    assert "last one was good, at 1999-03-01 (060) 00:00:00 UTC" in row
    shown = [f"{abs(q):.6f}" for q in first["attitude"]["quaternion"]]
    assert not any(each in row for each in shown)
    page = text_of(client.get(f"/spacecraft/XTE?run={run}"))
    latest = page[page.index("Latest batch") : page.index("CSV")]
    assert "05:00:00" in latest
    assert "no attitude" in latest
    assert "σ" not in latest


def test_names_of_clients_are_shown_as_they_are_and_do_nothing(client, post, batch, run):
    posted = post(batch | {"batch": HOSTILE, "run": run})
    assert posted.status_code == 201
    for address in (f"/?run={run}", f"/batches?run={run}", f"/batches/{posted.json()['id']}"):
        text = client.get(address).text
        tags = [tag for tag, _ in Markup(text).elements]
        assert "img" not in tags
        assert "alert(1)</script>" not in text
        assert "{{7*7}}" in text


# ---- one batch -----------------------------------------------------------------------------------


def test_residual_arrows_are_as_long_as_the_residuals_that_were_recorded(app, client, run):
    """The picture is worked out anew from the batch; what it shows must be what was recorded."""
    for each in pass_of(client, app, run):
        answer = client.get(f"/api/v1/batches/{each}").json()["answer"]
        field = app.results.star_field(each)
        for tracker, drawn in zip(answer["observations"], field.trackers, strict=True):
            for star, seen in zip(tracker["stars"], drawn.observed, strict=True):
                if star["residual_arcsec"] is None:
                    assert seen.residual_arcsec is None
                else:
                    length = math.hypot(*seen.residual_arcsec)
                    assert length == pytest.approx(star["residual_arcsec"], abs=2e-3)


def pass_of(client, app, run):
    """The results of a few batches of every mission, with aberration and body rates."""
    lines = [
        submission_from_json(
            httpx.Request("POST", "http://x", json=each.batch | {"run": run}).content
        )
        for name in ("XTE", "SWAS", "SOHO")
        for each in draw_pass(load_missions()[name], app.sky, Pass(batches=6, seed=3))
    ]
    return [each.id for each in app.submissions.submit_many(lines)]


@pytest.mark.parametrize(("angle", "sign"), [("h", 1), ("h", -1), ("v", 1), ("v", -1)])
def test_residual_arrows_point_from_the_predicted_place_to_where_a_star_was_seen(
    client, post, drawn, run, angle, sign
):
    """One star is moved by 30 arcsec, ten sigmas; h is to the right in the picture, v upwards."""
    body = drawn("XTE", 1, angles_share=1.0)[0]
    stars = body["observations"][0]["stars"]
    stars[0][f"{angle}_deg"] += sign * 30.0 / 3600.0
    answer = post(body | {"batch": f"moved {angle} {sign}", "run": run}).json()
    moved = answer["observations"][0]["stars"][0]
    assert moved["outcome"] == "unique"
    assert moved["residual_arcsec"] > 15.0
    page = Markup(client.get(f"/batches/{answer['id']}").text)
    lines = [
        [float(told[name]) for name in ("x1", "y1", "x2", "y2")]
        for tag, told in page.elements
        if tag == "line" and told.get("class") == "arrow"
    ]
    ways = [(x2 - x1, y1 - y2) for x1, y1, x2, y2 in lines]
    right, up = max(ways, key=lambda way: math.hypot(*way))
    expected = (sign, 0.0) if angle == "h" else (0.0, sign)
    assert (right, up) == pytest.approx([70.0 * each for each in expected], abs=25.0)


def test_stars_named_by_an_answer_stand_where_they_were_seen(app, client, run):
    for each in pass_of(client, app, run):
        for tracker in app.results.star_field(each).trackers:
            places = {star.id: star for star in tracker.catalog}
            for seen in tracker.observed:
                if seen.residual_arcsec is not None:
                    star = places[seen.star]
                    off = math.hypot(star.h_deg - seen.h_deg, star.v_deg - seen.v_deg)
                    assert off * 3600 < 2.0 * math.hypot(*seen.residual_arcsec) + 1.0


def test_the_edge_of_a_zone_lies_at_the_bounds_of_its_aim(app, client, run):
    """Every point of SOHO's edges is 2.1 deg above or below the great circle about the pole."""
    id = pass_of(client, app, run)[-1]
    record = client.get(f"/api/v1/batches/{id}").json()
    presumed, found = (
        matrix_from_quaternion(record[place][name]["quaternion"])
        for place, name in (("input", "a_priori"), ("answer", "attitude"))
    )
    (tracker,) = app.results.star_field(id).trackers
    assert len(tracker.zone_edges) >= 2
    hv = np.radians(np.concatenate([np.array(line) for line in tracker.zone_edges]))
    # Its tracker's axes are the body's; the pole is body X.
    edge = np.column_stack([np.tan(hv), np.ones(len(hv))])
    off = np.abs(angle_between_deg(edge, found @ presumed[0]) - 90.0)
    assert off == pytest.approx(np.full(len(off), 2.1), abs=1e-3)


def test_the_vote_table_says_what_the_answer_says(client, full_run):
    found = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    for each in found["items"][:5]:
        page = text_of(client.get(f"/batches/{each['id']}"))
        answer = client.get(f"/api/v1/batches/{each['id']}").json()["answer"]
        for star in answer["observations"][0]["stars"]:
            if star["star"]:
                assert star["star"]["id"] in page
            for rival in star.get("rivals", []):
                assert rival in page


def test_a_what_if_on_the_page_is_the_what_if_of_the_api(client, full_run):
    id = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    id = id["items"][3]["id"]
    tolerance = {"options": {"identifier": "starid", "tolerances": {"separation_deg": 0.05}}}
    answer = client.post(f"/api/v1/batches/{id}/what-if", json=tolerance).json()
    page = text_of(client.get(f"/batches/{id}?identifier=starid&tolerances.separation_deg=0.05"))
    assert "What-if, not recorded" in page
    counts = answer["counts"]
    for name in ("unique", "ambiguous", "unmatched"):
        assert re.search(rf"{name} {counts[name]}\b", page), name
    assert "separation_deg = 0.05 # was 0.0066" in page
    record = client.get(f"/api/v1/batches/{id}").json()
    assert record["what_ifs"] == []


def test_fields_that_stand_as_they_stood_are_no_what_if(client, full_run):
    """A form sends every field; sent unchanged, the page shows what was recorded."""
    found = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    address = f"/batches/{found['items'][0]['id']}"
    fields = {
        attributes["name"]: attributes.get("value") or ""
        for tag, attributes in Markup(client.get(address).text).elements
        if tag == "input" and "data-before" in attributes
    }
    assert len(fields) > 8
    assert "What-if, not recorded" not in client.get(address, params=fields).text


def test_settings_as_toml_read_back_as_what_was_asked():
    held = options.settings_of_mission(load_missions()["XTE"])
    asked = options.asked_options(
        {
            "identifier": "starid",
            "tests.magnitude": "off",
            "tolerances.separation_deg": "0.01",
            "tolerances.magnitude_mag": str(held["tolerances"]["magnitude_mag"]),
            "zone_grid_deg": "0",
        }
    )
    text = options.toml_of(options.fields_of(asked, held))
    assert tomllib.loads(text) == {
        "identifier": "starid",
        "zone": {"grid_deg": 0.0},
        "tests": {"magnitude": False},
        "tolerances": {"separation_deg": 0.01},
    }


# ---- pictures ------------------------------------------------------------------------------------


def test_brighter_stars_are_larger_and_the_faintest_are_still_seen():
    sizes = [sky_chart.star_radius(magnitude, 6.5) for magnitude in np.linspace(-1, 7, 50)]
    assert all(a >= b for a, b in itertools.pairwise(sizes))
    assert sizes[-1] >= 1.0


def test_a_sparkline_has_a_gap_where_nothing_was_recorded():
    series = Sparkline(
        bucket_s=60,
        unix_s=[0, 60, 120, 600, 660, 1200],
        batches=[1] * 6,
        unique_share=[0.0] * 6,
        ambiguous_share=[0.0, 0.5, 0.0, 1.0, 0.0, 0.25],
        unmatched_share=[0.0] * 6,
    )
    line = sparkline(series, 0, 1260)
    assert line.ambiguous.count("M") == 2
    assert [name for name, _, _ in line.dots] == ["ambiguous", "unmatched"]
    assert line.top == 1.0
    for x, y in re.findall(r"([\d.]+) ([\d.]+)", line.ambiguous):
        assert 0 <= float(x) <= WIDTH
        assert 0 <= float(y) <= HEIGHT


# ---- words ---------------------------------------------------------------------------------------


def test_values_are_written_with_their_units():
    thin = formatting.THIN
    assert formatting.share(1, 8) == f"12.5{thin}%"
    assert formatting.share(0, 0) == "–"
    assert formatting.share(None) == "–"
    assert formatting.arcsec(2.345) == "2.35″"
    assert formatting.arcsec(7200) == "2.00°"
    assert formatting.number(-0.5) == "−0.50"
    assert formatting.number(math.nan) == "–"
    assert formatting.age(3725) == f"1{thin}h 2{thin}min"
    assert formatting.age(None) == "–"
    assert formatting.count(1234567) == f"1{thin}234{thin}567"
    assert formatting.with_day_of_year("1998-12-31T23:59:60.000Z") == "1998-12-31 (365) 23:59:60"

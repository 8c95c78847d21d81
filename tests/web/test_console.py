"""The console as markup: what its pages say, and what they do not let through."""

import base64
import html
import itertools
import math
import re
import tomllib
from dataclasses import replace

import httpx
import numpy as np
import pytest

from service.app.factory import open_app
from service.missions.mission import load_missions
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.storage.queries.star_field import Boresight, TrackerField
from service.times import HOUR_S
from service.vectors import angle_between_deg, matrix_from_quaternion
from service.web.app import create_app
from service.web.console import formatting, options
from service.web.console.charts import sky_chart
from service.web.console.charts.sparkline import HEIGHT, PAD, WIDTH, common_top, packed, sparkline
from tests.web.console_pages import console_addresses
from tests.web.markup import Markup
from tests.web.serving import Server, in_process_settings

STEADY = Pass(batches=16, seed=3, cadence_s=300.0, troubles=NO_TROUBLES)

HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{7*7}}"


@pytest.fixture(scope="module")
def empty(chosen_database):
    app = open_app(in_process_settings(chosen_database()))
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
        assert weight < 256_000, (address, weight)


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
    # Commands to copy, with the address at which the reader found the service.
    assert f"acquire replay xte.ndjson --run live --url {empty.base_url}" in answer.text
    assert "No live batches of XTE yet" in text_of(empty.get("/spacecraft/XTE"))


def test_with_only_named_runs_it_leads_to_them(empty, batch):
    empty.post("/api/v1/batches", json=batch | {"run": "pass-7"}, timeout=60)
    text = empty.get("/").text
    assert "No live batches yet" in text
    assert "; the recorded ones are in other runs" in text
    assert '<a href="/?run=pass-7">pass-7</a>, 1 batch<' in text
    # There is something to look at: no commands to make more.
    assert "acquire replay" not in text


CHOSEN_RANGE = re.compile(r"<option selected>(hour|day|week|month|year)</option>")


def test_a_named_run_is_first_shown_over_the_range_that_holds_it(client, full_run):
    # 20 batches of XTE last ten minutes, those of SOHO more than an hour and a half.
    for name, fitting in (("XTE", "hour"), ("SOHO", "day")):
        page = client.get(f"/spacecraft/{name}", params={"run": full_run}).text
        assert CHOSEN_RANGE.findall(page) == [fitting]
    page = client.get("/spacecraft/XTE", params={"run": full_run, "range": "year"}).text
    assert CHOSEN_RANGE.findall(page) == ["year"]


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
    """The last attitude stands with its own time, in overview and page."""
    lone = batch["observations"][0] | {"stars": batch["observations"][0]["stars"][:1]}
    first = post(batch | {"run": run}).json()
    later = {"time": "1999-03-01T05:00:00.000Z", "batch": "later", "observations": [lone]}
    post(batch | {"run": run} | later)
    overview = text_of(client.get(f"/?run={run}"))
    row = overview[overview.index("XTE") :]
    assert "no attitude" in row
    assert "fewer than two unique stars" in row
    assert "last good 03-01 00:00" in row
    shown = [f"{abs(q):.6f}" for q in first["attitude"]["quaternion"]]
    assert not any(each in row for each in shown)
    page = text_of(client.get(f"/spacecraft/XTE?run={run}"))
    latest = page[page.index("Latest batch") : page.index("sky, residuals")]
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


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("b1\u2800", "b1‹U+2800›"),
        ("\u3164", "‹U+3164›"),
    ],
)
def test_a_name_that_nobody_would_see_is_shown_by_its_codes(client, post, batch, run, name, shown):
    posted = post(batch | {"batch": name, "run": run})
    assert posted.status_code == 201
    for address in (f"/batches?run={run}", f"/batches/{posted.json()['id']}"):
        assert shown in client.get(address).text


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("\u200b\u200b", "‹U+200B›‹U+200B›"),
        ("b1\u2060", "b1‹U+2060›"),
        (" ", "‹U+0020›"),
        ("a b", "a b"),
    ],
)
def test_names_of_earlier_versions_are_shown_by_their_codes(name, shown):
    assert formatting.name(name) == shown


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
        if tag == "line" and told.get("class") in ("arrow", "arrow cut")
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
    assert len(fields) >= 2
    assert "What-if, not recorded" not in client.get(address, params=fields).text


def test_settings_as_toml_read_back_as_what_was_asked():
    held = options.settings_of_mission(load_missions()["XTE"])
    asked = options.asked_options(
        {
            "identifier": "starid",
            "tests.magnitude": "off",
            "tolerances.separation_deg": "0.01",
            "tolerances.magnitude_mag": str(held["tolerances"]["magnitude_mag"]),
        }
    )
    text = options.toml_of(options.fields_of(asked, held))
    assert tomllib.loads(text) == {
        "identifier": "starid",
        "tests": {"magnitude": False},
        "tolerances": {"separation_deg": 0.01},
    }


# ---- pictures ------------------------------------------------------------------------------------


def test_brighter_stars_are_larger_and_the_faintest_are_still_seen():
    sizes = [sky_chart.star_radius(magnitude, 6.5) for magnitude in np.linspace(-1, 7, 50)]
    assert all(a >= b for a, b in itertools.pairwise(sizes))
    assert sizes[-1] >= 1.0


@pytest.mark.parametrize("radius_deg", [0.1, 1.0, 8.0, 39.9, 40.1, 67.2, 80.0])
def test_a_star_chart_of_any_size_has_one_to_four_rings(radius_deg):
    chart = sky_chart.sky_chart(
        TrackerField(
            tracker="wide",
            boresight=Boresight(ra_deg=0.0, dec_deg=0.0),
            field_of_view_radius_deg=radius_deg / 1.25,
            radius_deg=radius_deg,
            magnitude_limit_mag=6.0,
            zone_edges=[],
            catalog=[],
            observed=[],
        ),
        "quest",
    )
    assert len(chart.rings) in ((0, 1, 2, 3, 4) if radius_deg < 0.25 else (1, 2, 3, 4))


def points_of(path):
    """The points of a path of relative moves, in parts between gaps."""
    parts = []
    for kind, text in re.findall(r"([Mhl])([-\d ]+)", path):
        numbers = [int(each) for each in text.split()]
        if kind == "M":
            parts.append([tuple(numbers)])
        else:
            x, y = parts[-1][-1]
            parts[-1].append((x + numbers[0], y + (numbers[1] if kind == "l" else 0)))
    return parts


def test_a_sparkline_has_a_gap_where_nothing_was_recorded():
    shares = [0.0, 0.5, 0.0, math.nan, 1.0, math.nan, 0.25, 0.25, 0.5]
    path = sparkline({"ambiguous_share": np.array(shares)}, top=1.0).paths["ambiguous_share"]
    parts = points_of(path)
    assert [part[0][0] for part in parts] == [
        round(PAD + k * (WIDTH - 2 * PAD) / 8) for k in (0, 4, 6)
    ]
    assert path == "M2 36l18 -17l19 17M76 2h0M113 28h19l18 -9"
    middle = round(PAD + 4 * (WIDTH - 2 * PAD) / 8)
    assert parts[1] == [(middle, PAD), (middle, PAD)]
    for x, y in itertools.chain(*parts):
        assert 0 <= x <= WIDTH
        assert 0 <= y <= HEIGHT


def test_every_sparkline_of_a_page_has_one_scale():
    assert [common_top(each) for each in (0.0, 0.05, 0.06, 0.3, 1.0)] == [0.05, 0.05, 0.1, 0.5, 1]
    low, high = (
        points_of(sparkline({"a": np.array([share] * 2)}, top=0.5).paths["a"])[0][0][1]
        for share in (0.1, 0.4)
    )
    assert HEIGHT - PAD - low == pytest.approx((HEIGHT - PAD - high) / 4, abs=1)


def test_packed_cells_tell_no_batch_from_no_share():
    cells = base64.b64decode(packed(np.array([[math.nan, 0.0], [0.5, 1.0]])))
    assert list(cells) == [0, 1, 128, 255]


# ---- colours -------------------------------------------------------------------------------------

ROLES = ("--link", "--curve", "--limit", "--accent")
SEEN_AS = {
    "every colour": np.eye(3),
    "no red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
    "no blue": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.3039],
    ],
}
"""Machado, Oliveira and Fernandes (2009), of linear sRGB at full severity."""
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear(colour):
    part = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    part = XYZ @ np.clip(rgb, 0, 1) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(part > 0.008856, np.cbrt(part), 7.787 * part + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_link_curve_limit_and_alarm_are_told_apart_in_both_schemes(client):
    """Also without one of the three cones; a difference of 20 in CIELAB is plain to see."""
    css = client.get("/static/console.css").text
    blocks = re.findall(r"--paper: #[^}]+", css)
    assert len(blocks) == 3
    for block in blocks:
        tones = dict(re.findall(r"(--[\w-]+): (#[0-9a-f]{6})", block))
        for (a, b), seen in itertools.product(itertools.combinations(ROLES, 2), SEEN_AS):
            matrix = np.array(SEEN_AS[seen])
            apart = np.linalg.norm(lab(matrix @ linear(tones[a])) - lab(matrix @ linear(tones[b])))
            assert apart > 20, (a, b, seen)
        for role, least in zip(ROLES, (4.5, 3, 3, 4.5), strict=True):
            light = sorted(XYZ[1] @ linear(tones[each]) + 0.05 for each in (role, "--panel"))
            assert light[1] / light[0] >= least, role


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
    assert formatting.age(3 * 86400 + 7200) == f"3{thin}d 2{thin}h"
    assert formatting.age(300 * 86400 + 7200) == f"300{thin}d"
    assert formatting.age(None) == "–"
    assert formatting.count(1234567) == f"1{thin}234{thin}567"
    assert formatting.with_day_of_year("1998-12-31T23:59:60.000Z") == "1998-12-31 (365) 23:59:60"


# ---- whether the service is well, and files ------------------------------------------------------


def test_the_page_of_the_service_tells_whether_it_is_well(client):
    text = text_of(client.get("/about"))
    for each in (
        "ready for batches yes",
        "batches that wait to be answered 0",
        "last write succeeded",
        "trends and alarms 0 results",
        "memory",
        "table of leap seconds",
        "webhooks",
    ):
        assert each in text, each


def test_a_batch_is_found_by_the_id_of_its_sender_or_by_a_time(client, full_run):
    asked = {"run": full_run, "spacecraft": "XTE"}
    sent = client.get("/api/v1/batches", params=asked).json()["items"]
    one = sent[3]
    for address in (f"/batches/{one['batch']}", f"/batches?find={one['batch']}"):
        page = client.get(address, params={"run": full_run}, follow_redirects=True)
        assert page.status_code == 200
        # Both spacecraft of the run may have the id: then both are listed.
        assert one["id"] in str(page.url) or f"/batches/{one['id']}" in page.text
    shown = {"run": full_run, "spacecraft": "XTE", "find": one["time"]}
    page = client.get("/batches", params=shown, follow_redirects=True)
    assert page.text.index(f"/batches/{one['id']}") > 0
    listed = re.findall(r'href="/batches/([0-9A-Z]{26})', page.text)
    assert listed[0] == one["id"]
    missing = client.get("/batches", params={"find": "no-such-batch"})
    assert "No batch no-such-batch" in text_of(missing)


def test_files_of_attitudes_say_what_each_grade_is_and_how_many_intervals(tmp_path):
    app = open_app(in_process_settings(f"sqlite:///{tmp_path / 'acquire.db'}"))
    with Server(create_app(app)) as address, httpx.Client(base_url=address, timeout=60) as client:
        batches = [each.batch for each in draw_pass(app.missions["XTE"], app.sky, STEADY)]
        for each in batches:
            client.post("/api/v1/batches", json=each).raise_for_status()
        text = text_of(client.get("/spacecraft/XTE/files"))
        assert re.search(r"raw 16 1 1999-03-01 \(060\) 00:00:00 to 1999-03-01 \(060\) 01:15", text)
        assert re.search(r"automatic: 12\Dmin\D30\Ds for raw attitudes", text), text
        assert "The definitive attitude" in text
        # The gap follows the cadence, so that an AEM of a steady cadence is one segment.
        aem = client.get("/api/v1/spacecraft/XTE/attitude", params={"format": "aem"}).text
        assert aem.count("META_START") == 1
        page = text_of(client.get("/spacecraft/XTE/files", params={"gap_s": "60"}))
        assert "16 intervals for 16 attitudes" in page
        assert "15 times after a gap longer than 1 min (choose a larger one below" in page


def test_files_of_a_day_say_which_intervals_no_larger_gap_would_join(tmp_path):
    app = open_app(in_process_settings(f"sqlite:///{tmp_path / 'acquire.db'}"))
    asked = replace(STEADY, start="1999-03-01T12:10:00.000Z", batches=24, cadence_s=HOUR_S)
    with Server(create_app(app)) as address, httpx.Client(base_url=address, timeout=60) as client:
        for each in draw_pass(app.missions["XTE"], app.sky, asked):
            client.post("/api/v1/batches", json=each.batch).raise_for_status()
        files, day = "/spacecraft/XTE/files", {"day": "1999-03-01", "gap_s": "7200"}
        page = client.get(files, params=day)
        assert re.search(r"raw 12 \d+ 1999-03-01 \(060\) 12:10:00 to", text_of(page)), text_of(page)
        told = re.search(r"begins (\d+) times after a turn of more than 90°", text_of(page))
        assert told, text_of(page)
        assert "choose a larger one" not in text_of(page)
        link = html.unescape(re.search(r'href="([^"]*format=aem[^"]*)"', page.text)[1])
        aem = client.get(link).raise_for_status().text
        assert aem.count("META_START") == 1 + int(told[1])
        assert {each[:10] for each in re.findall(r"^1999\S+", aem, re.MULTILINE)} == {"1999-03-01"}
        # The day of the latest batch is shown first, and the day before it is a link away.
        first = client.get(files).text
        assert 'value="1999-03-02"' in first
        day_before = html.unescape(re.search(r'href="([^"]+)">◀ Day before', first)[1])
        assert 'value="1999-03-01"' in client.get(day_before).text
        assert client.get(files, params={"day": "yesterday"}).status_code == 422
        assert client.get(files, params={"day": "9999-12-31"}).status_code in (200, 422)

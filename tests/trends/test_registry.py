"""A quantity that is added to the registry, and to nothing else, is everywhere."""

import csv
import io

import pytest

from service.cli import main
from service.trends.limits import LimitSettings, above
from service.trends.measures import BatchShare, StarShare
from service.trends.quantities import QUANTITIES, Quantity
from service.web.app import bare_app
from tests.web.conformance import checked
from tests.web.markup import Markup
from tests.web.serving import serving_in_process

HISTORY = "/api/v1/spacecraft/XTE/history"
LIMITS = "/api/v1/spacecraft/XTE/limits"

ADDED = (
    Quantity(
        "not_unique_share",
        "1",
        "stars that are not unique",
        StarShare(lambda counts: counts["observed"] - counts["unique"]),
        lambda mission: above(0.3, 0.5, 0.8, hysteresis=0.05),
    ),
    Quantity(
        "good_share",
        "1",
        "batches with a good attitude",
        BatchShare(lambda counts: counts["solved"] - counts["suspect"]),
        lambda mission: LimitSettings(),
    ),
)


@pytest.fixture(scope="module")
def service(chosen_database):
    """A service of this module's own: its quantities would be in the way of other tests."""
    with serving_in_process(chosen_database()) as service:
        yield service


@pytest.fixture(scope="module")
def client(service):
    return checked(service.client)


@pytest.fixture(scope="module")
def full_run(service):
    return service.send_full_run()


@pytest.fixture(params=ADDED, ids=lambda each: each.name)
def added(request, monkeypatch):
    monkeypatch.setitem(QUANTITIES, request.param.name, request.param)
    return request.param


def test_nothing_knows_it_before(client, full_run):
    for each in ADDED:
        answer = client.get(HISTORY, params={"run": full_run, "quantity": each.name})
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["field"].startswith("quantity")
        assert client.get(f"{LIMITS}/{each.name}").status_code == 404


def test_openapi_lists_it(added):
    described = bare_app().openapi()
    (quantity,) = (
        each
        for each in described["paths"]["/api/v1/spacecraft/{name}/history"]["get"]["parameters"]
        if each["name"] == "quantity"
    )
    assert quantity["schema"]["items"]["enum"][-1] == added.name
    schemas = described["components"]["schemas"]
    assert schemas["LimitOut"]["properties"]["quantity"]["enum"][-1] == added.name
    assert schemas["AlarmOut"]["properties"]["quantity"]["enum"][-1] == added.name


def value_of(item, name):
    counts = item["counts"]
    if name == "good_share":
        return float(item["status"] == "good")
    return (counts["observed"] - counts["unique"]) / counts["observed"]


def test_it_has_a_history_batch_by_batch(full_run, added, bare_client):
    asked = {"run": full_run, "quantity": added.name, "strategy": "latest", "size": 20}
    shown = bare_client.get(HISTORY, params=asked).raise_for_status().json()
    page = {"run": full_run, "spacecraft": "XTE"}
    items = bare_client.get("/api/v1/batches", params=page).json()["items"]
    assert shown["series"][added.name]["unit"] == "1"
    wanted = [value_of(each, added.name) for each in items[::-1]]
    assert shown["series"][added.name]["value"] == pytest.approx(wanted)
    assert len(set(wanted)) > 1 or added.name == "good_share"


@pytest.mark.parametrize("size", [500, 1])
def test_it_has_a_history_in_buckets(full_run, added, bare_client, size):
    """From batches and from hours alike."""
    asked = {"run": full_run, "quantity": added.name, "size": size}
    shown = bare_client.get(HISTORY, params=asked).raise_for_status().json()
    page = {"run": full_run, "spacecraft": "XTE"}
    items = bare_client.get("/api/v1/batches", params=page).json()["items"]
    counts = shown["batches"]
    means = shown["series"][added.name]["mean"]
    total = sum(count * mean for count, mean in zip(counts, means, strict=True))
    if added.name == "good_share":
        assert total == pytest.approx(sum(value_of(each, added.name) for each in items))
    if size == 1:
        whole = sum(each["counts"]["observed"] for each in items)
        part = whole - sum(each["counts"]["unique"] for each in items)
        if added.name == "not_unique_share":
            assert means == [pytest.approx(part / whole)]


def test_its_column_is_in_the_csv(full_run, added, bare_client):
    asked = {"run": full_run, "quantity": added.name, "format": "csv", "strategy": "latest"}
    answer = bare_client.get(HISTORY, params=asked).raise_for_status()
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert len(rows) == 20
    assert all(row[added.name] for row in rows)


def test_the_command_writes_its_column(service, full_run, added, capsys):
    where = ["--run", full_run, "--database", service.app.settings.database]
    assert main(["history", "--spacecraft", "XTE", *where]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(rows) == 20
    assert all(0.0 <= float(row[added.name]) <= 1.0 for row in rows)


def test_it_has_limits(added, bare_client):
    shown = bare_client.get(LIMITS).raise_for_status().json()["items"][-1]
    assert (shown["quantity"], shown["unit"]) == (added.name, "1")
    assert shown["is_default"]
    assert bare_client.get(f"{LIMITS}/{added.name}").status_code == 200


def test_limits_of_it_raise_an_alarm(added, bare_client, service):
    """Any value is above such a bound."""
    bound = {"critical": {"high": -1.0}, "minimum_count": 1, "duration_s": 0.0}
    body = {"settings": bound, "who": "test"}
    bare_client.put(f"{LIMITS}/{added.name}", json=body).raise_for_status()
    try:
        batch = service.draw("XTE", 1, seed=9)[0] | {"batch": f"alarm-{added.name}"}
        bare_client.post("/api/v1/batches", json=batch).raise_for_status()
        raised = bare_client.get("/api/v1/alarms", params={"spacecraft": "XTE"}).json()["items"]
        assert added.name in {each["quantity"] for each in raised}
        page = bare_client.get("/alarms").raise_for_status().text
        assert added.label in page
    finally:
        bare_client.delete(f"{LIMITS}/{added.name}", params={"who": "test"}).raise_for_status()
        for alarm in bare_client.get("/api/v1/alarms").json()["items"]:
            if alarm["quantity"] == added.name:
                path = f"/api/v1/alarms/{alarm['id']}"
                bare_client.post(f"{path}/acknowledge", json={"who": "test"}).raise_for_status()


def test_the_console_shows_it(full_run, added, bare_client):
    limits = bare_client.get("/spacecraft/XTE/limits").raise_for_status().text
    assert added.label in limits
    page = bare_client.get("/spacecraft/XTE", params={"run": full_run}).raise_for_status().text
    assert added.label.capitalize() in page
    Markup(page)


@pytest.fixture
def bare_client(client):
    """Without the comparison against openapi.yaml, which does not know what is added."""
    hooks, client.event_hooks = client.event_hooks, {"response": []}
    yield client
    client.event_hooks = hooks

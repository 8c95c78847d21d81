"""What is promised of every feature: it can be switched off, and another package can bring one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.cli import build_parser
from service.errors import BadConfiguration
from service.feature import SHIPPED, Feature, features_on, known_features

FEATURES = Path(__file__).parents[2] / "service" / "features"


def commands_of(parser):
    return set(parser.commands.choices)


def test_every_folder_of_a_feature_is_in_the_list():
    assert set(SHIPPED) == {each.parent.name for each in FEATURES.glob("*/__init__.py")}
    assert {each.name for each in known_features().values()} >= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_feature_brings_what_it_says_and_has_a_folder_of_tests(name):
    feature = known_features()[name]
    for kind in feature.brings:
        assert (FEATURES / name / f"{kind}.py").exists()
    assert list((Path(__file__).parent / name).glob("test_*.py"))


def test_a_command_of_a_feature_that_is_off_is_not_there():
    assert "follow" in commands_of(build_parser())
    assert "follow" not in commands_of(build_parser(features_off="follow"))


def test_a_name_of_no_feature_is_refused_with_the_names_of_all(acquire, monkeypatch):
    monkeypatch.setenv("ACQUIRE_FEATURES_OFF", "follow, folow")
    code, _, complaint = acquire("version")
    assert code == 2
    assert "ACQUIRE_FEATURES_OFF: must be features of advice, follow" in complaint
    assert "(got 'folow')" in complaint
    with pytest.raises(BadConfiguration, match="ACQUIRE_FEATURES_OFF"):
        features_on("folow")


def test_a_feature_can_only_bring_what_the_service_asks_for():
    with pytest.raises(ValueError, match="cannot bring colours"):
        Feature("paint", "paint", ("colours",))


ROOT = Path(__file__).parents[2]

SERVED = """
import os, sys
import httpx
from service.app.factory import open_app
from service.cli import build_parser
from service.settings import Settings
from service.web.app import create_app
from tests.web.serving import Server

off, *addresses = sys.argv[2:]
print("commands", *build_parser(off).commands.choices)
settings = Settings(database="sqlite:///" + sys.argv[1], replay_processes=0, features_off=off)
with Server(create_app(open_app(settings, serving=True))) as url:
    for address in addresses:
        answer = httpx.get(url + address, timeout=120)
        print(answer.status_code, address, answer.text.replace(os.linesep, " "))
print("modules", *sys.modules)
"""


def served(folder, off, *addresses, path=()):
    """The commands and modules of a service of its own, and its answers by address."""
    run = subprocess.run(
        [sys.executable, "-c", SERVED, str(folder / "acquire.db"), off, *addresses],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))},
        capture_output=True,
        text=True,
        check=True,
    )
    commands, *answers, modules = run.stdout.splitlines()
    found = {}
    for line in answers:
        status, address, text = line.split(" ", 2)
        found[address] = int(status), text
    return set(commands.split()), set(modules.split()), found


def test_with_every_feature_off_the_pages_are_there_and_nothing_of_a_feature_is(tmp_path):
    pages = ("/", "/about", "/missions", "/batches", "/alarms")
    gone = ("/webhooks", "/api/v1/webhooks", "/api/v1/spacecraft/XTE/tracks")
    off = ",".join(SHIPPED)
    commands, modules, found = served(tmp_path, off, *pages, *gone, "/metrics")
    assert not commands & set(SHIPPED)
    assert [found[each][0] for each in pages] == [200] * len(pages)
    assert [found[each][0] for each in gone] == [404] * len(gone)
    assert "starid_batches" in found["/metrics"][1]
    assert "starid_webhook" not in found["/metrics"][1]
    loaded = {each for each in modules if each.startswith("service.features.")}
    # The names of the features, and the tables, which stay in the database.
    assert loaded <= {f"service.features.{name}" for name in SHIPPED} | {
        f"service.features.{name}.tables" for name in SHIPPED
    }


DWELL = {
    "dwell/__init__.py": """
from service.feature import Feature
FEATURE = Feature("dwell", __name__, ("part", "command", "routes", "pages"))
""",
    "dwell/part.py": """
from sqlalchemy import func, select
from service.storage.sql.tables import results

class Dwell:
    def __init__(self, context):
        self._context = context

    def close(self):
        pass

    def of(self, spacecraft):
        self._context.mission(spacecraft)
        time = results.c.time_ns
        asked = select(func.count(), func.max(time) - func.min(time))
        with self._context.reading() as connection:
            count, span_ns = connection.execute(
                asked.where(results.c.spacecraft == spacecraft, results.c.current)
            ).one()
        return {"batches": count, "span_s": (span_ns or 0) / 1e9}

def open_part(app):
    return Dwell(app.context)
""",
    "dwell/command.py": """
from service.cli import arguments

def add(commands):
    arguments.add_command(commands, "dwell", run)

def run(parsed):
    \"\"\"Tell how long a spacecraft was observed.

    acquire dwell
    \"\"\"
    return 0
""",
    "dwell/routes.py": """
from dwell.part import Dwell
from service.contract.base import Record
from service.web.openapi import ApiRouter, Returns
from service.web.requests.access import AppDep, Policy, json_response
from service.web.requests.query_parameters import SpacecraftPath

class DwellOut(Record, frozen=True, kw_only=True):
    \"\"\"How long a spacecraft was observed.\"\"\"

    batches: int
    span_s: float

router = ApiRouter("dwell")
ROUTERS = (router,)
POLICIES = {"get_dwell": Policy("read", "path")}

@router.serves("GET /spacecraft/{name}/dwell", Returns("The dwell.", DwellOut))
def get_dwell(name: SpacecraftPath, app: AppDep):
    \"\"\"How long a spacecraft was observed.\"\"\"
    return json_response(app.part(Dwell).of(name))
""",
    "dwell/pages.py": """
from dwell.part import Dwell
from service.web.console.page import ContextDep, FromQuery, PageQuery, console_page
from service.web.requests.access import READ

@console_page("/dwell", "Dwell", READ, position=95)
def dwell_page(query: FromQuery[PageQuery], context: ContextDep):
    return context.rendered("dwell.html.jinja", query.run, dwell=context.app.part(Dwell).of("XTE"))
""",
    "dwell/templates/dwell.html.jinja": """
{% extends "layout.html.jinja" %}
{% block scripts %}<script type="module" src="/static/dwell.js"></script>{% endblock %}
{% block main %}<p>{{ dwell.batches }} batches</p>{% endblock %}
""",
    "dwell/static/dwell.js": "// dwell",
    "dwell-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: dwell\nVersion: 1\n",
    "dwell-1.dist-info/entry_points.txt": "[acquire.features]\ndwell = dwell:FEATURE\n",
}
"""A package that brings a feature."""


def test_another_package_brings_a_feature_without_a_change_of_the_service(tmp_path):
    for name, text in DWELL.items():
        file = tmp_path / "site" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    route, site = "/api/v1/spacecraft/XTE/dwell", (tmp_path / "site",)
    asked = (route, "/dwell", "/static/dwell.js", "/", "/api/v1/openapi.json")
    commands, _, found = served(tmp_path, "", *asked, path=site)
    assert "dwell" in commands
    assert found[route] == (200, '{"batches":0,"span_s":0.0}')
    assert found["/dwell"][0] == 200
    assert "<p>0 batches</p>" in found["/dwell"][1]
    assert found["/static/dwell.js"] == (200, "// dwell")
    assert 'href="/dwell"' in found["/"][1]
    assert '"DwellOut"' in found["/api/v1/openapi.json"][1]
    commands, modules, found = served(tmp_path, "dwell", route, "/dwell", path=site)
    assert "dwell" not in commands
    assert [status for status, _ in found.values()] == [404, 404]
    assert {each for each in modules if each.startswith("dwell.")} == set()

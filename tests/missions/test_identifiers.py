"""One entry in the registry makes an identifier known to the whole service."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.missions.identifiers import IDENTIFIERS, IdentifierEntry, register

ROOT = Path(__file__).parents[2]

FROM_OUTSIDE = """
import json
from service.missions.identifiers import IdentifierEntry, register

def identify_nothing(sighting):
    from service.identify.identification import nothing_known
    return nothing_known(len(sighting.direction))

register(IdentifierEntry("nothing", identify_nothing, "leaves every star unmatched"))

import contextlib
import io
import sys
import httpx
from service.acquire import acquire
from service.app.factory import open_app
from service.cli import main
from service.cli.parser import build_parser
from service.missions.mission import SHIPPED_FOLDER, parse_mission
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.web.app import bare_app, create_app
from service.web.console.options import fields_of
from tests.observations.example import BATCH
from tests.web.serving import Server

text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
mission = parse_mission(text.replace('identifier = "verified"', 'identifier = "nothing"'), "xte")
body = json.dumps(BATCH | {"options": {"identifier": "nothing", "zone_grid_deg": 0.0}})
batch = submission_from_json(body).batch
acquisition = acquire(batch, mission, SkyModel(load_embedded(), LruCache(1 << 26)))
shapes = bare_app().openapi()["components"]["schemas"]
arguments = ["simulate", "paper", "--identifier", "nothing", "verified"]

database = f"sqlite:///{sys.argv[1]}/acquire.db"
app = open_app(Settings(database=database, replay_processes=0))
with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
    sent = client.post("/api/v1/batches", json=json.loads(body)).raise_for_status().json()
    other = {"options": {"identifier": "starid"}}
    tried = client.post(f"/api/v1/batches/{sent['id']}/what-if", json=other).raise_for_status()
    page = client.get(f"/batches/{sent['id']}").raise_for_status().text
described = io.StringIO()
with contextlib.redirect_stdout(described):
    main(["openapi"])
print(json.dumps({
    "mission": mission.identifier,
    "batch": batch.options.identifier,
    "outcomes": acquisition.counts,
    "form": [each.choices for each in fields_of({}, None) if each.name == "identifier"],
    "options": shapes["OptionsIn"]["properties"]["identifier"],
    "answer": shapes["Answer"]["properties"]["identifier"],
    "recorded": sent["identifier"],
    "unmatched": sent["counts"]["unmatched"],
    "tried": tried.json()["identifier"],
    "page": page,
    "printed": described.getvalue(),
    "command": build_parser().parse_args(arguments).identifier,
}))
"""


def test_an_identifier_added_through_the_registry_alone_is_known_everywhere(tmp_path):
    """In missions, batches, the API, its description, the pages and the commands."""
    told = subprocess.run(
        [sys.executable, "-c", FROM_OUTSIDE, str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    seen = json.loads(told.stdout)
    names = [*IDENTIFIERS, "nothing"]
    assert seen["mission"] == seen["batch"] == "nothing"
    assert seen["outcomes"] == {"observed": 2, "unique": 0, "ambiguous": 0, "unmatched": 2}
    assert seen["form"] == [names]
    assert seen["answer"]["enum"] == names
    assert {"enum": names, "type": "string"} in seen["options"]["anyOf"]
    assert (seen["recorded"], seen["unmatched"], seen["tried"]) == ("nothing", 2, "starid")
    assert ">nothing</option>" in seen["page"]
    assert "- nothing\n" in seen["printed"]
    assert seen["command"] == ["nothing", "verified"]


def test_every_entry_names_a_function_and_says_what_it_is():
    for name, entry in IDENTIFIERS.items():
        assert entry.name == name
        assert entry.description
        assert callable(entry.identify)


def test_a_second_identifier_of_one_name_is_refused():
    with pytest.raises(ValueError, match="verified"):
        register(IdentifierEntry("verified", print, "another"))

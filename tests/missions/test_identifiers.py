"""One entry in the registry makes an identifier known to the whole service."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.acquire import acquire
from service.acquire.choices import idle_reason
from service.missions.identifiers import IDENTIFIERS, IdentifierEntry, register
from service.missions.mission import Tolerances
from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass

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
from service.cli import build_parser
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
from tests.missions.stated_files import STATED_FOLDER

text = (STATED_FOLDER / "xte.toml").read_text(encoding="utf-8")
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


@pytest.mark.slow
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


TRIED = {
    "pair_separation_max_deg": (0.5,),
    "separation_deg": (1e-6,),
    "magnitude_mag": (1e-3,),
    "magnitude_order_mag": (0.0, 30.0),
    "cross_product_deg": (1e-4,),
    "pole_difference_deg": (1e-5, 30.0),
    "pole_angle_deg": (1e-5,),
    "fov_rotation_deg": (1e-4,),
}


def base_of(identifier, setting):
    """Options under which stars are ambiguous, so that each test of the votes tells some apart."""
    if IDENTIFIERS[identifier].uses is not None:
        return {"tests": {}, "tolerances": {}}
    # The test of the field's rotation hides what that of the cross product refuses.
    is_on = setting.startswith("fov_rotation")
    tolerances = {"separation_deg": 0.3} | ({} if is_on else {"cross_product_deg": 30.0})
    return {"tests": {"fov_rotation": is_on}, "tolerances": tolerances}


def settings_of(name, held):
    """The values of a test or of a tolerance to try instead of the one that holds."""
    if name in TRIED:
        return [("tolerances", name, value) for value in TRIED[name]]
    return [("tests", name, not getattr(held, name))]


@pytest.mark.parametrize("spacecraft", ["XTE", "SOHO"])
@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_a_setting_changes_an_answer_or_is_said_to_be_idle(missions, sky, identifier, spacecraft):
    """Every test and tolerance, under every identifier, in a cap and in a band."""
    mission = missions[spacecraft]
    drawn = [each.batch for each in draw_pass(mission, sky, Pass(3, 3, stars=6))]

    def found(base, table=None, name=None, value=None):
        options = {"identifier": identifier, **{key: {**base[key]} for key in base}}
        if table is not None:
            options[table][name] = value
        for body in drawn:
            text = json.dumps(body | {"options": options})
            acquired = acquire(submission_from_json(text).batch, mission, sky)
            each = acquired.trackers[0].identification
            # Only of `starid` the votes decide; `verified` shows those of the tests beside.
            votes = each.votes.tolist() if identifier == "starid" else None
            seen = each.outcome.tolist(), each.star.tolist(), votes
            yield seen, str(each.probability.tolist()), acquired.warnings

    for setting in (*type(mission.tests).model_fields, *Tolerances.model_fields):
        base = base_of(identifier, setting)
        plain, tests = list(found(base)), mission.tests.model_copy(update=base["tests"])
        reason = idle_reason(setting, identifier, tests, mission.zone)
        tried = [list(found(base, *each)) for each in settings_of(setting, tests)]
        changes = any([x[:2] for x in each] != [x[:2] for x in plain] for each in tried)
        warnings = [warning for each in tried for *_, told in each for warning in told]
        idle = [
            text for text in warnings if f".{setting} is not used" in text or "test_off" in text
        ]
        assert changes == (reason is None), setting
        assert bool(idle) == (reason is not None), setting

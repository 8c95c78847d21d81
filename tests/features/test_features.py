"""What is promised of every feature: it can be switched off, and another package can bring one."""

import json
import os
import subprocess
import sys
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.app.factory import open_app
from service.cli import build_parser
from service.errors import BadBatch, BadConfiguration
from service.feature import SETTING, SHIPPED, Feature, features_on, known_features
from service.settings import Settings
from service.storage.sql import migrations

FEATURES = Path(__file__).parents[2] / "service" / "features"


def commands_of(parser):
    return set(parser.commands.choices)


def test_every_folder_is_the_feature_of_its_name():
    names = [each.parent.name for each in sorted(FEATURES.glob("*/__init__.py"))]
    assert list(known_features())[: len(names)] == names
    assert all(known_features()[name].name == name for name in names)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_feature_brings_what_it_says_and_has_a_folder_of_tests(name):
    feature = known_features()[name]
    for kind in feature.brings:
        assert find_spec(f"{feature.package}.{kind}")
    assert list((Path(__file__).parent / name).glob("test_*.py"))


def test_a_command_of_a_feature_that_is_off_is_not_there():
    assert "follow" in commands_of(build_parser())
    assert "follow" not in commands_of(build_parser(features_off="follow"))


def test_options_of_a_feature_that_is_off_are_not_there():
    def options_of(parser):
        return {each.dest for each in parser.commands.choices["replay"]._actions}

    found = options_of(build_parser()) - options_of(build_parser("packets"))
    assert found == {"packets", "xtce", "spacecraft"}


FRAME_READ = """
import io, sys
from service.app.factory import open_app
from service.features.pictures.part import Pictures
from service.features.pictures.tracker.simulated import FrameSettings, draw_frames, frame_bytes
from service.features.pictures.tracker.submit import read_known
from service.settings import Settings

app = open_app(Settings(database="sqlite:///" + sys.argv[1], replay_processes=0))
(drawn,) = draw_frames(app.missions["IMAGER"], app.sky, FrameSettings(frames=1))
file = io.BytesIO(frame_bytes(drawn))
print(app.part(Pictures).frames.submit("IMAGER", read_known(drawn.known), file).id)
app.close()
"""


def test_a_recorded_frame_can_be_read_where_frames_are_off(tmp_path):
    sent = [sys.executable, "-c", FRAME_READ, str(tmp_path / "acquire.db")]
    run = subprocess.run(sent, cwd=ROOT, capture_output=True, text=True, check=True)
    id = run.stdout.strip()
    batch, page, overlay = (
        f"/api/v1/batches/{id}",
        f"/batches/{id}",
        f"/api/v1/batches/{id}/overlay",
    )
    commands, modules, found = served(tmp_path, "pictures", batch, page, overlay)
    assert not commands & {"frame", "camera"}
    assert [found[each][0] for each in (batch, page, overlay)] == [200, 200, 404]
    assert '"preview_step"' not in found[batch][1]
    assert '"candidates"' in found[batch][1]
    assert overlay not in found[page][1]
    assert not {"PIL", "sep", "service.features.pictures.part"} & modules
    _, _, found = served(tmp_path, "", page, overlay)
    assert [each[0] for each in found.values()] == [200, 200]
    assert overlay in found[page][1]


def test_frames_are_simulated_only_where_frames_are_on():
    def simulated(off):
        return {*build_parser(off).commands.choices["simulate"].commands.choices}

    assert simulated("") - simulated("pictures") == {"frames"}


def test_a_name_of_no_feature_is_refused_with_the_names_of_all(acquire, monkeypatch):
    monkeypatch.setenv("ACQUIRE_FEATURES_OFF", "follow, folow")
    code, _, complaint = acquire("version")
    assert code == 2
    assert (
        "ACQUIRE_FEATURES_OFF: must be features of advice, alarms, archive, calibration"
        in complaint
    )
    assert "(got 'folow')" in complaint
    with pytest.raises(BadConfiguration, match="ACQUIRE_FEATURES_OFF"):
        features_on("folow")


def test_alarms_of_a_run_are_refused_where_the_alarms_are_off(acquire, monkeypatch, tmp_path):
    monkeypatch.setenv("ACQUIRE_FEATURES_OFF", "alarms")
    file = tmp_path / "one.ndjson"
    batch = json.loads((ROOT / "docs" / "example-batch.json").read_text(encoding="utf-8"))
    file.write_text(json.dumps(batch), encoding="utf-8")
    database = ("--database", f"sqlite:///{tmp_path / 'a.db'}")
    code, _, complaint = acquire("replay", "--in-process", "--alarms", *database, str(file))
    assert (code, "alarms: are off in this service" in complaint) == (2, True)
    settings = Settings(database=database[1], replay_processes=0, features_off="alarms")
    with closing(open_app(settings)) as app, pytest.raises(BadBatch, match="are off"):
        app.replays.start([b""], "night", alarms=True)


def test_a_feature_can_only_bring_what_the_service_asks_for():
    with pytest.raises(ValueError, match="cannot bring colours"):
        Feature("paint", "paint", ("colours",))


ROOT = Path(__file__).parents[2]

SERVED = """
import sys
from pathlib import Path
import httpx
from service.app.factory import open_app
from service.cli import build_parser
from service.settings import Settings
from service.web.app import create_app
from tests.web.serving import Server

off, sent, *addresses = sys.argv[2:]
print("commands", *build_parser(off).commands.choices)
settings = Settings(database="sqlite:///" + sys.argv[1], replay_processes=0, features_off=off)
app = open_app(settings, serving=True)
app.service.ready()
with Server(create_app(app)) as url:
    if sent:
        body, json_type = Path(sent).read_bytes(), {"Content-Type": "application/json"}
        answer = httpx.post(url + "/api/v1/batches", content=body, headers=json_type, timeout=120)
        assert answer.json()["attitude"]["status"] == "good"
    for address in addresses:
        answer = httpx.get(url + address, timeout=120)
        print(answer.status_code, address, " ".join(answer.text.split()))
print("modules", *sys.modules)
"""


def served(folder, off, *addresses, path=(), sent=""):
    """The commands and modules of a service that got a batch, and its answers by address."""
    run = subprocess.run(
        [sys.executable, "-c", SERVED, str(folder / "acquire.db"), off, sent, *addresses],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path)), SETTING: off},
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
    pages = ("/", "/about", "/missions", "/batches", "/runs", "/annotations", "/spacecraft/XTE")
    pages += ("/spacecraft/XTE/period",)
    history = "/api/v1/spacecraft/XTE/history?format=csv"
    gone = ("/webhooks", "/alarms", "/api/v1/alarms", "/api/v1/spacecraft/XTE/tracks")
    gone += ("/spacecraft/XTE/files", "/api/v1/spacecraft/XTE/attitude")
    gone += ("/pictures", "/api/v1/pictures", "/api/v1/spacecraft/IMAGER/frames")
    gone += ("/spacecraft/XTE/grades", "/api/v1/spacecraft/XTE/definitive-attitude")
    off = ",".join(SHIPPED)
    commands, modules, found = served(
        tmp_path, off, *pages, *gone, history, "/metrics", sent="docs/example-batch.json"
    )
    assert not commands & {*SHIPPED, "export", "score", "calibrate", "camera", "frame", "smooth"}
    assert {"serve", "replay", "reprocess", "history"} <= commands
    assert "pyarrow" not in modules
    assert [found[each][0] for each in pages] == [200] * len(pages)
    assert found[history][0] == 200
    assert "1996-010-0110" in found[history][1]
    assert [found[each][0] for each in gone] == [404] * len(gone)
    assert "starid_batches" in found["/metrics"][1]
    assert "starid_webhook" not in found["/metrics"][1]
    assert "starid_alarms" not in found["/metrics"][1]
    assert "sky, residuals, rates" in found["/spacecraft/XTE"][1]
    shown = found["/"][1] + found["/spacecraft/XTE"][1] + found["/missions"][1]
    shown += found["/spacecraft/XTE/period"][1]
    for gone_page in ("/alarms", "/calibration", "/files", "/attitude?", "/grades", "/pictures"):
        assert gone_page not in shown
    loaded = {each for each in modules if each.startswith("service.features.")}
    assert not {"PIL", "sep"} & modules
    # The names of the features, and the tables, which stay in the database.
    assert loaded <= {f"service.features.{name}" for name in SHIPPED} | {
        f"service.features.{name}.tables" for name in SHIPPED
    }


PREDICTED = """
import json, sys
from service.app.factory import open_app
from service.gyro.blocks import block_from_json
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import GyroWanted, draw_pass, with_gyro

app = open_app(
    Settings(database="sqlite:///" + sys.argv[1], replay_processes=0, features_off=sys.argv[2])
)
mission = app.missions["XTE"]
drawn = draw_pass(mission, app.sky, Pass(batches=4, cadence_s=10.0, seed=5))
sent = list(with_gyro(drawn, mission, GyroWanted(), 30.0, 5))
for block in [block for each in sent for block in each.gyro]:
    own = {name: value for name, value in block.items() if name != "spacecraft"}
    app.gyro.record(block_from_json(json.dumps(own), "XTE"))
for number, each in enumerate(sent):
    body = each.batch | ({"a_priori": {"from": "last"}} if number else {})
    print(app.submissions.submit(submission_from_json(json.dumps(body))).body.decode())
app.close()
"""


def predicted(file, off):
    """What answers of batches that ask for the last attitude say of stars and attitude."""
    run = subprocess.run(
        [sys.executable, "-c", PREDICTED, str(file), off],
        cwd=ROOT,
        env=os.environ | {SETTING: off},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    predictions = [each["tracking"]["prediction"] for each in answers[1:]]
    for each in predictions:
        # The id of a result.
        del each["result"]
    named = ("observations", "counts", "attitude", "reason", "warnings")
    return predictions, [{name: each[name] for name in named} for each in answers]


def test_answers_of_the_main_job_are_the_same_with_every_feature_off(tmp_path):
    """Predicted by a gyro, too: its blocks are the main job's."""
    predictions, answers = predicted(tmp_path / "on.db", "")
    assert [each["rate"] for each in predictions] == ["gyro"] * 3
    assert all(each["attitude"]["status"] == "good" for each in answers)
    assert predicted(tmp_path / "off.db", ",".join(SHIPPED)) == (predictions, answers)


DWELL = {
    "dwell/__init__.py": """
from service.feature import Feature
FEATURE = Feature(
    "dwell", __name__, ("tables", "projection", "part", "command", "routes", "pages")
)
""",
    "dwell/tables.py": """
import sqlalchemy as sa
from service.storage.sql.columns import BOUND, Name, RunName, metadata

dwell_bands = sa.Table(
    "dwell_bands",
    metadata,
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    # Of 30 degrees of declination each, from the south pole on.
    sa.Column("band", sa.SmallInteger, primary_key=True, autoincrement=False),
    sa.Column("batches", sa.BigInteger, nullable=False),
    info={BOUND: "made again from results"},
)
TABLES = (dwell_bands,)
""",
    "dwell/projection.py": """
import json
import math
from collections import Counter

import sqlalchemy as sa

from dwell.tables import dwell_bands
from service.storage.sql.columns import unpack
from service.vectors import matrix_from_quaternion

def apply(connection, results):
    counted = Counter()
    for each in results:
        attitude = json.loads(unpack(each.result["answer"]))["attitude"]
        if each.is_first and attitude is not None:
            # Body axis +Z in inertial axes.
            z = float(matrix_from_quaternion(attitude["quaternion"])[2, 2])
            run, spacecraft = each.owner
            counted[spacecraft, run, int((math.degrees(math.asin(z)) + 90.0) // 30.0)] += 1
    for (spacecraft, run, band), batches in counted.items():
        c = dwell_bands.c
        place = c.spacecraft == spacecraft, c.run == run, c.band == band
        more = sa.update(dwell_bands).where(*place).values(batches=c.batches + batches)
        if not connection.execute(more).rowcount:
            row = {"spacecraft": spacecraft, "run": run, "band": band, "batches": batches}
            connection.execute(sa.insert(dwell_bands), row)

def wants(connection, run):
    return False
""",
    "dwell/part.py": """
from sqlalchemy import select
from dwell.tables import dwell_bands

class Dwell:
    def __init__(self, context):
        self._context = context

    def close(self):
        pass

    def of(self, spacecraft, run):
        self._context.mission(spacecraft)
        c = dwell_bands.c
        asked = select(c.band, c.batches).where(c.spacecraft == spacecraft, c.run == run)
        with self._context.reading() as connection:
            found = dict(map(tuple, connection.execute(asked)))
        return [found.get(band, 0) for band in range(6)]

def open_part(app):
    return Dwell(app.context)
""",
    "dwell/command.py": """
from contextlib import closing
from dwell.part import Dwell
from service.app.factory import open_app
from service.cli import arguments

def add(commands):
    parser = arguments.add_command(commands, "dwell", run)
    parser.add_argument("spacecraft")
    arguments.add_database(parser)

def run(parsed):
    \"\"\"Tell how often the axis +Z of a spacecraft was in each band of declination.

    acquire dwell XTE
    \"\"\"
    with closing(open_app(arguments.settings_of_existing(parsed))) as app:
        print(*app.part(Dwell).of(parsed.spacecraft, "live"))
    return 0
""",
    "dwell/routes.py": """
from dwell.part import Dwell
from service.contract.base import Record
from service.web.openapi import ApiRouter, Returns
from service.web.requests.access import AppDep, Policy, json_response
from service.web.requests.query_parameters import FromQuery, RunQuery, SpacecraftPath

class DwellOut(Record, frozen=True, kw_only=True):
    \"\"\"How often the axis +Z was in each band of declination.\"\"\"

    batches: list[int]

router = ApiRouter("dwell")
ROUTERS = (router,)

@router.serves(
    "GET /spacecraft/{name}/dwell", Policy("read", "path"), Returns("The dwell.", DwellOut)
)
def get_dwell(name: SpacecraftPath, query: FromQuery[RunQuery], app: AppDep):
    \"\"\"How often the axis +Z of a spacecraft was in each band of declination.\"\"\"
    return json_response({"batches": app.part(Dwell).of(name, query.run or "live")})
""",
    "dwell/pages.py": """
from dwell.part import Dwell
from service.web.console.page import ContextDep, FromQuery, PageQuery, console_page
from service.web.requests.access import READ

@console_page("/dwell", "Dwell", READ, position=95)
def dwell_page(query: FromQuery[PageQuery], context: ContextDep):
    dwell = context.app.part(Dwell).of("XTE", query.run)
    return context.rendered("dwell.html.jinja", query.run, dwell=dwell)
""",
    "dwell/templates/dwell.html.jinja": """
{% extends "layout.html.jinja" %}
{% block scripts %}<script type="module" src="/static/dwell.js"></script>{% endblock %}
{% block main %}<p>{{ dwell | sum }} batches</p>{% endblock %}
""",
    "dwell/static/dwell.js": "// dwell",
    "dwell-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: dwell\nVersion: 1\n",
    "dwell-1.dist-info/entry_points.txt": "[acquire.features]\ndwell = dwell:FEATURE\n",
}
"""A package that brings a feature: how often an axis of the body dwells where in the sky."""


def bands_of(answers):
    """How often body +Z was in each 30 degrees of declination, by scipy."""
    found = [0] * 6
    for answer in answers:
        if answer["attitude"] is not None:
            z = Rotation.from_quat(answer["attitude"]["quaternion"]).apply([0.0, 0.0, 1.0])
            found[int((np.degrees(np.arcsin(z[2])) + 90.0) // 30.0)] += 1
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the package, as an installation has it."""
    folder = tmp_path_factory.mktemp("site")
    for name, text in DWELL.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


def test_another_package_brings_a_feature_without_a_change_of_the_service(tmp_path, site):
    route = "/api/v1/spacecraft/XTE/dwell"
    asked = (route, "/dwell", "/static/dwell.js", "/", "/api/v1/openapi.json")
    commands, _, found = served(tmp_path, "", *asked, path=(site,))
    assert "dwell" in commands
    assert found[route] == (200, '{"batches":[0,0,0,0,0,0]}')
    assert found["/dwell"][0] == 200
    assert "<p>0 batches</p>" in found["/dwell"][1]
    assert found["/static/dwell.js"] == (200, "// dwell")
    assert 'href="/dwell"' in found["/"][1]
    assert '"DwellOut"' in found["/api/v1/openapi.json"][1]
    commands, modules, found = served(tmp_path, "dwell", route, "/dwell", path=(site,))
    assert "dwell" not in commands
    assert [status for status, _ in found.values()] == [404, 404]
    # Its tables stay in the database.
    loaded = {each for each in modules if each.startswith("dwell.")}
    assert loaded <= {"dwell.tables"}


SENT = """
import json, sys
from service.app.factory import open_app
from service.cli import main
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.sql import migrations

file, first, last = sys.argv[1], *map(int, sys.argv[2:4])
settings = Settings(database="sqlite:///" + file, replay_processes=0)
app = open_app(settings)
drawn = list(draw_pass(app.missions["XTE"], app.sky, Pass(batches=12, seed=5)))
for each in drawn[first:last]:
    print(app.submissions.submit(submission_from_json(json.dumps(each.batch))).body.decode())
app.close()
print(json.dumps(migrations.check(settings.database)))
if sys.argv[4:]:
    sys.exit(main([*sys.argv[4:], "--database", settings.database]))
"""


def sent(file, first, last, *command, path=()):
    """The answers of a process that records some batches, how the schema differs, and what a
    command prints then."""
    run = subprocess.run(
        [sys.executable, "-c", SENT, str(file), str(first), str(last), *command],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    lines = run.stdout.splitlines()
    answers, differs = lines[: last - first], lines[last - first]
    return [json.loads(each) for each in answers], json.loads(differs), lines[last - first + 1 :]


def test_a_brought_feature_has_its_tables_and_follows_the_record(tmp_path, site, acquire):
    """The database was there before the package, and is given its tables as it is opened."""
    file = tmp_path / "acquire.db"
    sent(file, 0, 4)
    answers, differs, printed = sent(file, 4, 12, "dwell", "XTE", path=(site,))
    assert differs == []
    bands = bands_of(answers)
    assert sum(bands) >= 6
    assert printed == [" ".join(map(str, bands))]
    # Without the package the service goes on, and the numbers stay for its return.
    sent(file, 0, 0)
    database = f"sqlite:///{file}"
    assert migrations.check(database) == []
    assert migrations.unknown_tables(database) == ["dwell_bands"]
    for command in ("check --database", "copy"):
        target = [f"sqlite:///{tmp_path / 'copy.db'}"] * (command == "copy")
        code, out, _ = acquire("database", *command.split(), database, *target)
        assert (code, "dwell_bands" in out) == (0, True)
    *_, printed = sent(file, 0, 0, "dwell", "XTE", path=(site,))
    assert printed == [" ".join(map(str, bands))]

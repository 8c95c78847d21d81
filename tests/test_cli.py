"""The command: help that teaches, one clear line a mistake, exit codes that scripts can use."""

import argparse
import csv
import gzip
import json
import os
import re
import shlex
import signal
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing

import httpx
import pytest

from service import __version__
from service.acquire import kernel_build
from service.cli import build_parser
from service.cli.arguments import MOST_FIRST, MOST_OPTIONS
from service.simulate.telemetry import read_objects
from service.times import parse_utc
from tests.fresh_databases import sqlite_at
from tests.missions.stated_files import STATED_FOLDER
from tests.sky.test_sky2000 import SIRIUS, written
from tests.waiting import wait_until
from tests.web.serving import free_port, served

COMMANDS = [
    "serve",
    "replay",
    "advise",
    "calibrate",
    "history",
    "reprocess",
    "smooth",
    "frame",
    "catalog",
    "catalog build",
    "catalog import",
    "catalog export",
    "catalog rejected",
    "simulate",
    "simulate telemetry",
    "simulate paper",
    "simulate frames",
    "database",
    "database upgrade",
    "database check",
    "database backup",
    "database restore",
    "database verify",
    "database copy",
    "database prune",
    "database forget",
    "archive",
    "archive verify",
    "archive restore",
    "openapi",
    "demo",
    "version",
    "completion",
    "mission",
    "mission check",
    "mission estimate",
    "export",
    "export attitude",
    "camera",
    "camera calibrate",
    "token",
    "token create",
    "token list",
    "simulate imaging",
    "simulate mission",
]


def telemetry(acquire, path, spacecraft="XTE", batches=6, *more):
    code, _, complaint = acquire(
        "simulate", "telemetry", "--spacecraft", spacecraft, "--batches", batches, path, *more
    )
    assert code == 0, complaint
    return path


# ---- help --------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_tells_what_a_command_does_and_gives_examples(acquire, command):
    code, out, _ = acquire(*command.split(), "--help")
    assert code == 0
    assert out.startswith(f"usage: acquire {command}".rstrip())
    assert "examples:" in out
    assert max(len(line) for line in out.splitlines()) <= 100


def test_every_example_in_the_help_is_understood(acquire):
    """What the help shows can be typed."""
    parser = build_parser()
    for command in ["", *COMMANDS]:
        _, out, _ = acquire(*command.split(), "--help")
        for line in out.split("examples:\n")[1].split("\n\n")[0].splitlines():
            words = shlex.split(line.split("  ")[1]) if line.startswith("  ") else []
            words = [word for word in words if not word.startswith("ACQUIRE_")]
            if "COMMAND" not in words and words and words[0] != "curl":
                assert words[0] == "acquire"
                assert parser.parse_args(words[1:]).function


def test_the_help_of_all_begins_with_the_commands_of_a_first_day(acquire):
    out = acquire("--help")[1]
    first, _, more = out.partition("commands to begin with:\n")[2].partition("\nmore commands:\n")
    shown = re.findall(r"^  ([a-z]+) ", first, re.MULTILINE)
    assert shown == ["mission", "simulate", "serve", "replay", "frame", "export", "demo"]
    others = re.findall(r"^  ([a-z]+) ", more.partition("\noptions:")[0], re.MULTILINE)
    assert {*shown, *others} == {*build_parser().commands.choices}
    assert len(out.splitlines()) < 75


def parsers_of(parser, words=()):
    """Every command that has no commands of its own, with its words."""
    if parser.commands is None:
        yield " ".join(words), parser
        return
    for name, each in parser.commands.choices.items():
        yield from parsers_of(each, (*words, name))


@pytest.mark.parametrize(("command", "parser"), [*parsers_of(build_parser())])
def test_help_shows_first_what_most_people_need(command, parser):
    arguments = [each for each in parser._actions if each.help != argparse.SUPPRESS][1:]
    _, _, listed = parser.format_help().partition("\narguments:\n")
    first, _, rest = listed.partition("\nmore options:\n")
    assert bool(listed) == bool(parser.first)
    assert set(parser.first) <= set(parser._option_string_actions)
    if not listed:
        assert len(arguments) <= MOST_OPTIONS
        return
    rest = rest.partition("\nexamples:\n")[0]
    starts = [line.split()[0].rstrip(",") for line in first.splitlines() if line[2:3].strip()]
    assert 1 < len(starts) <= MOST_FIRST
    for each in arguments:
        name = each.option_strings[0] if each.option_strings else each.metavar
        in_first = re.search(rf"^  {re.escape(name)}(?![\w-])", first, re.MULTILINE) is not None
        in_rest = re.search(rf"^  {re.escape(name)}(?![\w-])", rest, re.MULTILINE) is not None
        assert in_first != in_rest, f"{command}: {name} stands in one of the two lists"
        assert in_first or not each.required


def loaded_by(code, *arguments):
    """The modules that a process has loaded when it has run some code."""
    code += "\nimport sys; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return set(done.stdout.splitlines()[-1].split())


def packages(modules):
    """The packages of modules, without those of Python, and those that hold compiled modules."""
    found = {each.partition(".")[0] for each in modules} - sys.stdlib_module_names
    return {each for each in found if not each.startswith("_") and "cython" not in each}


def test_help_loads_nothing_that_takes_time():
    loaded = loaded_by("from service.cli import build_parser; build_parser().format_help()")
    assert packages(loaded) <= {"service", "studies", "msgspec", "typing_extensions"}
    assert {each for each in loaded if each.startswith("service.") and each.count(".") == 1} == {
        *("service.cli", "service.compiled", "service.csv_cells", "service.errors"),
        *("service.extras", "service.feature", "service.features", "service.logs"),
        *("service.missions", "service.settings", "service.table_files"),
    }


READY = """
import sys
from service.app.factory import open_app
from service.settings import Settings
from service.web.app import create_app
import service.cli.commands.serve, service.web.server

app = open_app(Settings(database=sys.argv[1], replay_processes=0), serving=True)
create_app(app)
app.service.ready()
app.close()
"""


def test_a_service_is_ready_without_what_is_used_later(tmp_path):
    """What is listed here is what each start pays for."""
    loaded = loaded_by(READY, sqlite_at(tmp_path / "acquire.db"))
    of_uvicorn = {"click", "dotenv", "h11", "httptools", "watchfiles", "websockets", "yaml"}
    # numba loads it, .04 s, where the extra `nats` has brought it: its keys come by PyNaCl.
    of_nats = {"cffi", "pycparser"}
    assert packages(loaded) - of_uvicorn - of_nats - {"idna", "sniffio"} <= {
        *("annotated_doc", "annotated_types", "anyio", "erfa", "fastapi", "greenlet"),
        *("jinja2", "llvmlite", "markupsafe", "msgspec", "numba", "numpy", "opentelemetry"),
        *("prometheus_client", "pydantic", "pydantic_core", "scipy", "service", "sqlalchemy"),
        *("starlette", "typing_extensions", "typing_inspection", "uvicorn", "uvloop"),
        "zstandard",
    }
    # numba asks scipy for its version, and nothing else.
    assert not {each for each in loaded if each.startswith(("scipy.l", "scipy.s", "scipy.o"))}
    for late in (
        *("service.demo", "service.replay", "service.simulate", "studies"),
        *("service.features.pictures.blind", "service.features.pictures.detection"),
        *("service.features.pictures.frames.fits", "service.features.pictures.overlay"),
        *("service.features.products.ck", "service.features.products.scoring"),
        *("service.identify.triangles", "service.features.archive.archiving", "acquire_client"),
    ):
        assert late not in loaded


@pytest.mark.slow
def test_the_sky_is_prepared_once_and_one_that_cannot_be_kept_is_said(
    acquire, monkeypatch, tmp_path
):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel_build, "_is_complete", lambda: True)
    code, out, _ = acquire("prepare", "--time", "1999-03-01T00:00:00Z")
    assert code == 0
    # Run catalogs of two limits, an index for each limit and field of view, and the catalog if
    # no test before has opened it in this process.
    assert re.search(r"^kernels: compiled already\nsky: [56] files built in [\d.]+ s\n", out)
    assert str(tmp_path / "cache") in out
    code, out, _ = acquire("prepare", "--time", "1999-03-01T00:00:00Z")
    assert (code, "sky: built already\n" in out) == (0, True)
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert acquire("prepare")[0] == 1
    assert acquire("prepare", "--time", "yesterday")[0] == 2


def test_the_version_is_the_packages(acquire):
    assert acquire("version") == acquire("--version") == (0, f"acquire {__version__}\n", "")


# ---- mistakes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("frob", "invalid choice: 'frob'"),
        ("reply a.ndjson", "invalid choice: 'reply'; did you mean replay? (see `acquire --help`)"),
        ("database verfy", "did you mean verify? (see `acquire database --help`)"),
        ("history --spacecrft XTE", "no option --spacecrft; did you mean --spacecraft? (see"),
        ("replay a --sped=2", "there is no option --sped; did you mean --speed?"),
        ("serve --xyzzy", "there is no option --xyzzy (see `acquire serve --help`)"),
        ("mission check none.toml", "none.toml: No such file or directory"),
        ("replay", "FILE: is required, or else --packets FILE --xtce FILE (see `acquire replay"),
        ("replay a.ndjson --packets b --xtce c", "FILE: is required, or else --packets"),
        ("replay --packets b", "--xtce: goes with --packets, and --packets needs it"),
        ("replay --packets none.dat --xtce c", "none.dat: is not there, or is no file"),
        ("replay a.ndjson --spacecraft XTE", "--spacecraft: goes with --packets"),
        ("replay none.ndjson", "none.ndjson: cannot be opened: No such file or directory"),
        ("replay . --run x", ".: cannot be opened: Is a directory"),
        ("replay a --speed 0", "argument --speed: must be a number above 0, or max (got '0')"),
        ("replay a --speed nan", "must be a number above 0, or max (got 'nan')"),
        ("replay a --concurrency 0", "must be a whole number of at least 1 (got '0')"),
        ("replay a --in-process --url http://x", "--url: not allowed with argument --in-process"),
        ("database backup", "required: FILE (see `acquire database backup --help`)"),
        ("database backup copy.db", "acquire.db: there is no such file"),
        ("database restore copy.db", "copy.db: cannot be read: No such file or directory"),
        ("database verify", "acquire.db: there is no such file"),
        ("database copy", "required: FROM, TO (see `acquire database copy --help`)"),
        ("database copy no.db new.db", "FROM: must be sqlite:///FILE or postgresql://USER@HOST"),
        ("database prune", "required: --before"),
        ("database prune --before noon", "--before: must be UTC as"),
        ("reprocess --spacecraft NO", "no spacecraft 'NO'; there are IMAGER, SOHO"),
        ("reprocess --run live", "run: must be another run than the one"),
        ("reprocess --run a/b", "run: must be letters, digits"),
        ("reprocess --track --archive /", "--track: cannot be used with --archive: each batch"),
        ("reprocess --track --processes 2", "--processes: leave it out with --track, which"),
        ("reprocess --mission none.toml", "none.toml: cannot be read: "),
        ("reprocess --from 1996-02-01T00:00:00Z --to 1996-01-01T00:00:00Z", "--end: must not"),
        ("advise", "required: --spacecraft (see `acquire advise --help`)"),
        ("advise --spacecraft NO", "ACQUIRE_DATABASE: acquire.db: there is no such file"),
        ("advise --spacecraft XTE --start noon", "--start: must be UTC as"),
        ("advise --spacecraft XTE --try septol=1", "--try.septol: there is no such field"),
        ("simulate telemetry --spacecraft XTE --batches 1 --stars 300 o", "stars: must be from 1"),
        (
            "simulate telemetry --spacecraft NO --batches 1 o",
            "no spacecraft 'NO'; there are IMAGER, SOHO",
        ),
        ("simulate telemetry --spacecraft XTE --batches 1 no/o", "no/o.truth.ndjson: cannot be"),
        ("simulate telemetry --spacecraft XTE --batches 1 --start x o", "start: must be UTC as"),
        (
            "simulate telemetry --spacecraft XTE --batches 1 --aberration ignore=much o",
            "--aberration: must be a word, or words with shares",
        ),
        ("simulate paper --table 1", "table: must be from 2 to 14 (got 1)"),
        ("catalog export --spacecraft XTE --epoch 96 o", "--epoch: must be from 1972 to 2100"),
        ("catalog export --spacecraft XTE --epoch nan o", "--epoch: must be from 1972 to 2100"),
        ("catalog import none.csv", "none.csv: "),
        ("catalog build .", "missing: download package"),
        ("openapi --check none.yaml", "none.yaml: No such file or directory"),
        ("serve --host http://here", "must be an address or a name"),
        ("serve --port 70000", "must be from 0 to 65535"),
        ("serve --port 0 --database no://where", "--database: "),
        ("database check --database sqlite:///no/such/folder.db", "--database: "),
        ("demo --seed -1 --once", "seed: must not be negative (got -1)"),
        ("demo --port 0 --once", "--port: must be a port that can be named"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(acquire, arguments, complaint):
    code, out, err = acquire(*arguments.split())
    assert code == 2
    assert out == ""
    assert complaint in err
    lines = [line for line in err.splitlines() if line.startswith("acquire: ")]
    assert len(lines) == 1
    assert "Traceback" not in err


def test_a_setting_that_is_misspelt_is_refused(acquire, monkeypatch):
    monkeypatch.setenv("ACQUIRE_DATABSE", "sqlite:///a.db")
    code, _, err = acquire("database", "check")
    assert code == 2
    assert "ACQUIRE_DATABSE: no such setting" in err


@pytest.mark.parametrize(
    ("words", "reader", "said"),
    [
        ("--help", "true", ""),
        pytest.param("openapi", "head -1", "openapi: 3.1", marks=pytest.mark.slow),
    ],
)
def test_output_that_nobody_reads_to_its_end_is_no_error(words, reader, said):
    command = f"{sys.executable} -m service.cli {words} | {reader}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stdout.startswith(said)
    assert done.stderr == ""


# ---- telemetry and replay ----------------------------------------------------------------------


def test_telemetry_is_drawn_as_asked_with_its_truth_beside_it(acquire, tmp_path):
    path = tmp_path / "soho.ndjson"
    code, out, _ = acquire(
        *("simulate", "telemetry", "--spacecraft", "SOHO", "--batches", 10, "--seed", 3, path),
        *("--start", "1996-010T12:00:00Z", "--cadence", 60, "--stars", 3, "--serious"),
        *("--prior", "direction", "--angles", 1, "--aberration", "to_correct=0.5,ignore=0.5"),
    )
    assert code == 0
    assert "10 batches of SOHO" in out
    batches, truths = list(read_objects(path)), list(read_objects(tmp_path / "soho.truth.ndjson"))
    assert [each["batch"] for each in batches] == [each["batch"] for each in truths]
    assert batches[0]["time"] == "1996-01-10T12:00:00.000Z"
    assert batches[1]["time"] == "1996-01-10T12:01:00.000Z"
    assert all(each["a_priori"] == {"sun_pointed": True} for each in batches)
    stars = [each["observations"][0]["stars"] for each in batches]
    assert all(len(each) <= 3 and "h_deg" in each[0] for each in stars)
    assert {each["aberration"] for each in batches} == {"to_correct", "ignore"}
    assert {each["stretch"] for each in truths} == {
        "nominal",
        "attitude_error",
        "spurious",
        "magnitude_error",
        "position_error",
    }


@pytest.mark.parametrize(
    ("arguments", "stretches"),
    [
        ("--nominal", {"nominal"}),
        ("", {"nominal", "attitude_error", "spurious"}),
        ("--nominal --magnitude-error-share 0.5", {"nominal", "magnitude_error"}),
        (
            "--position-error-arcsec 20 --spurious-share 0",
            {"nominal", "attitude_error", "position_error"},
        ),
    ],
)
def test_stretches_come_as_asked(acquire, tmp_path, arguments, stretches):
    telemetry(acquire, tmp_path / "x.ndjson", "XTE", 20, *arguments.split())
    truths = read_objects(tmp_path / "x.truth.ndjson")
    assert {each["stretch"] for each in truths} == stretches


def test_replay_in_process_records_answers_and_sums_up(acquire, tmp_path):
    path = telemetry(acquire, tmp_path / "night.ndjson")
    code, out, err = acquire("replay", path, "--in-process", "--results", "out.ndjson")
    assert code == 0, err
    table = dict(line.strip().split(None, 1) for line in out.splitlines())
    assert table["run"] == "night"
    assert table["batches"] == table["new"] == "6"
    assert table["refused"] == "0"
    assert len(list(read_objects(tmp_path / "out.ndjson"))) == 6
    # The default database, made and migrated on the way.
    assert (tmp_path / "acquire.db").exists()
    code, out, _ = acquire("replay", path, "--in-process")
    assert code == 0
    assert "already recorded  6" in out


def test_the_history_of_a_run_is_printed_as_a_table(acquire, tmp_path):
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 3, "--nominal")
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    code, out, _ = acquire("history", "--spacecraft", "XTE", "--run", "r")
    rows = list(csv.DictReader(out.splitlines()))
    assert (code, len(rows)) == (0, 3)
    assert {"time", "batch", "id", "ambiguous_share"} <= set(rows[0])
    file = tmp_path / "history.csv"
    assert acquire("history", "--spacecraft", "XTE", "--run", "r", "--output", file) == (0, "", "")
    assert file.read_text().splitlines() == out.splitlines()


def test_advice_is_printed_in_sentences_or_as_the_api_answers_it(acquire, tmp_path):
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 30, "--nominal")
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    asked = ("advise", "--spacecraft", "XTE", "--run", "r", "--quiet")
    code, out, complaint = acquire(*asked, "--try", "separation_deg=0.01")
    assert (code, "batches" in complaint) == (0, False)
    assert "30 of 30 batches were examined." in out
    assert "ok  separation_deg is not used by the identifier verified" in out
    assert "?   zone.radius_deg: 10.66° leaves room for an a priori error of 6.66°" in out
    assert "ok  pair_separation_max_deg fits: 8° beside a field of view of 8°." in out
    assert "separation_deg = 0.01, asked for" in out
    code, out, _ = acquire(*asked, "--json")
    assert code == 0
    assert json.loads(out)["batches_sampled"] == 30


def test_batches_are_run_again_with_another_mission_file_and_compared(acquire, tmp_path):
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 8, "--nominal")
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    shipped = (STATED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    narrow = tmp_path / "narrow.toml"
    votes = re.sub(r'identifier = "\w+"', 'identifier = "starid"', shipped)
    narrow.write_text(votes.replace("separation_deg = 0.0066", "separation_deg = 1e-7"))
    asked = ("reprocess", "--source", "r", "--quiet", "--processes", "1")
    code, out, _ = acquire(*asked, "--mission", narrow, "--run", "narrow")
    assert code == 0
    assert "8 recorded, 0 there already, 0 refused" in out
    assert "unique before, unmatched after" in out
    code, out, _ = acquire(*asked, "--mission", narrow, "--run", "narrow", "--json")
    assert (code, json.loads(out)["before"], json.loads(out)["recorded"]) == (0, 8, 0)
    code, out, _ = acquire(*asked)
    assert (code, "every star came out alike" in out) == (0, True)


def test_a_bad_line_in_the_middle_gives_exit_code_1_and_the_rest_goes_on(acquire, tmp_path):
    path = telemetry(acquire, tmp_path / "night.ndjson")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], '{"spacecraft": ', *lines[3:]]))
    code, out, err = acquire(
        "replay", path, "--in-process", "--run", "trial", "--results", "out.ndjson"
    )
    assert code == 1
    assert f"{path}:4: " in err
    results = list(read_objects(tmp_path / "out.ndjson"))
    assert [result.get("line") for result in results] == [None, None, None, 4, None, None, None]
    assert {result.get("run") for result in results} == {"trial", None}
    assert "refused           1" in out


def test_a_csv_file_with_a_wrong_header_is_refused_before_anything_is_sent(acquire, tmp_path):
    good = telemetry(acquire, tmp_path / "good.ndjson")
    bad = telemetry(acquire, tmp_path / "bad.csv")
    bad.write_text(bad.read_text().replace("magnitude", "brightness", 1))
    code, _, err = acquire("replay", good, bad, "--in-process")
    assert code == 2
    assert "column brightness: there is no such column" in err
    assert not (tmp_path / "acquire.db").exists()


def test_results_are_never_written_over_what_is_replayed(acquire, tmp_path):
    path = telemetry(acquire, tmp_path / "night.ndjson")
    before = path.read_bytes()
    code, _, err = acquire("replay", path, "--in-process", "--results", path)
    assert code == 2
    assert "--results: must not be a file that is replayed" in err
    assert path.read_bytes() == before


def test_the_server_serves_takes_a_replay_and_stops_when_told(acquire, tmp_path, monkeypatch):
    """The real process: `serve`, probes at a port of their own, `replay` to it, then SIGTERM."""
    path = telemetry(acquire, tmp_path / "night.ndjson", "SOHO", 4)
    probes = free_port()
    monkeypatch.setenv("ACQUIRE_PROBE_PORT", str(probes))
    with served(f"sqlite:///{tmp_path / 'acquire.db'}") as (server, url):
        code, out, err = acquire("replay", path, "--url", url)
        assert code == 0, err
        assert "new               4" in out
        for path in ("/livez", "/readyz", "/metrics"):
            assert httpx.get(f"http://127.0.0.1:{probes}{path}").status_code == 200
        for path in ("/", "/api/v1/about"):
            assert httpx.get(f"http://127.0.0.1:{probes}{path}").status_code == 404
        server.send_signal(signal.SIGTERM)
        assert server.wait(60) in (0, -signal.SIGTERM)


# ---- catalogs, database, description -----------------------------------------------------------


def test_an_export_holds_exactly_what_the_identifier_uses(acquire, missions, sky, tmp_path):
    code, out, _ = acquire(
        "catalog", "export", "--spacecraft", "XTE", "--epoch", "1995.7", tmp_path / "x.csv"
    )
    assert code == 0
    assert "epoch 1996" in out
    used = sky.run_catalog(missions["XTE"], parse_utc("1996-01-10T12:00:00Z"))
    with (tmp_path / "x.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == list(used.star_id)
    for column in ("ra_deg", "dec_deg", "magnitude"):
        exact = getattr(used, column if column != "magnitude" else "magnitude_mag").tolist()
        assert [float(row[column]) for row in rows] == exact


def test_rejected_stars_are_listed_with_their_reasons(acquire, tmp_path):
    code, out, _ = acquire(
        "catalog", "rejected", "--spacecraft", "SOHO", "--epoch", 1996, tmp_path / "r.csv"
    )
    assert code == 0
    with (tmp_path / "r.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert f"{len(rows)} stars left out" in out
    assert all(row["reason"].startswith("merged into ") for row in rows)


def test_a_site_brings_its_own_catalog(acquire, tmp_path, monkeypatch):
    lines = ["id,ra_deg,dec_deg,magnitude", "SKYMAP 1,10.5,-20.25,3.5", "SKYMAP 2,11.5,-21,2.5"]
    (tmp_path / "site.csv").write_text("\n".join(lines))
    code, out, _ = acquire("catalog", "import", "site.csv")
    assert code == 0
    assert "site.npz: 2 stars" in out
    monkeypatch.setenv("ACQUIRE_CATALOG", "site.npz")
    acquire("catalog", "export", "--spacecraft", "SWAS", "--epoch", 2000, "out.csv")
    with (tmp_path / "out.csv").open(newline="") as file:
        assert [row["id"] for row in csv.DictReader(file)] == ["SKYMAP 2", "SKYMAP 1"]


def test_a_site_that_has_skymap_brings_its_records(acquire, tmp_path, monkeypatch):
    stars = [SIRIUS | {"ID": k, "RAm": k % 60, "Vmag": 1.0 + k / 100} for k in range(1, 50)]
    stars.append(SIRIUS | {"ID": 50, "Vmag": None})
    text = "".join(written(**star) + "\n" for star in stars)
    (tmp_path / "sky2kv4.dat.gz").write_bytes(gzip.compress(text.encode()))
    code, out, _ = acquire("catalog", "import", "sky2kv4.dat.gz")
    assert code == 0
    assert "sky2kv4.npz: 49 stars" in out
    assert "left out: 1 stars that have no visual magnitude (SKYMAP 50)" in out
    monkeypatch.setenv("ACQUIRE_CATALOG", str(tmp_path / "sky2kv4.npz"))
    used = tmp_path / "used.csv"
    assert acquire("catalog", "export", "--spacecraft", "XTE", "--epoch", 2000, used)[0] == 0
    assert used.read_text().splitlines()[1].startswith("SKYMAP 1,")
    code, _, complaint = acquire("catalog", "import", "sky2kv4.dat.gz", "--format", "csv")
    assert code == 2
    assert "is not UTF-8" in complaint or "NUL byte" in complaint


def test_a_damaged_site_catalog_is_refused_with_line_and_column(acquire, tmp_path):
    (tmp_path / "site.csv").write_text("id,ra_deg,dec_deg,magnitude\nA,10,20,3\nB,10,200,3\n")
    code, _, err = acquire("catalog", "import", "site.csv")
    assert code == 2
    assert "3" in err
    assert "dec_deg" in err
    assert not (tmp_path / "site.npz").exists()


def test_the_database_is_made_checked_and_its_migrations_are_whole(acquire, tmp_path):
    url = f"sqlite:///{tmp_path / 'a.db'}"
    assert acquire("database", "upgrade", "--database", url)[0] == 0
    assert acquire("database", "check", "--database", url)[0] == 0
    assert acquire("database", "check", "--fresh")[0] == 0
    code, _, complaint = acquire("database", "check", "--database", "sqlite:///none.db")
    assert (code, "there is no such file" in complaint) == (2, True)
    assert not (tmp_path / "none.db").exists()
    (tmp_path / "empty.db").touch()
    code, out, _ = acquire("database", "check", "--database", "sqlite:///empty.db")
    assert code == 1
    assert "acquire database upgrade" in out


def sound(batches):
    """What `verify` says of a sound record without the key of its heads."""
    accidents = "without --public-key and --head this finds accidents, not intruders"
    return f"nothing is wrong with {batches} batches\n{accidents}\n"


def test_records_are_copied_verified_and_pruned(acquire, tmp_path):
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 8, "--nominal")
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    code, out, _ = acquire("database", "backup", "copy.db")
    size, head = out.splitlines()
    assert (code, size) == (0, f"copy.db: {(tmp_path / 'copy.db').stat().st_size} bytes")
    assert head.startswith("record head ")
    before = ("database", "prune", "--before", "1999-060T00:01:30Z")
    told = "3 batches are before 1999-03-01T00:01:30.000Z; nothing was deleted\n"
    assert acquire(*before, "--dry-run")[:2] == (0, told)
    told = "3 batches before 1999-03-01T00:01:30.000Z were deleted\n"
    assert acquire(*before)[:2] == (0, told)
    assert acquire("database", "verify")[:2] == (0, sound(5))
    with closing(sqlite3.connect(tmp_path / "acquire.db")) as connection:
        # The dry run left none.
        (entry,) = connection.execute("SELECT action, body FROM audit").fetchall()
        assert entry == ("prune", '{"before": "1999-03-01T00:01:30.000Z", "run": null}')
    copy = ("--database", "sqlite:///copy.db")
    assert acquire("database", "verify", *copy)[:2] == (0, sound(8))
    with closing(sqlite3.connect(tmp_path / "copy.db")) as connection:
        # As after an upgrade.
        for table in ("record_leaves", "record_facts", "record_heads"):
            connection.execute(f"DELETE FROM {table}")
        connection.execute("UPDATE results SET digest = NULL, seq = 0")
        connection.execute("UPDATE seals SET digests = 0")
        connection.commit()
    assert "8 results have no digest yet" in acquire("database", "verify", *copy)[1]
    with closing(sqlite3.connect(tmp_path / "copy.db")) as connection:
        connection.execute("DELETE FROM solutions")
        connection.commit()
    code, out, _ = acquire("database", "verify", *copy)
    assert code == 1
    assert "its attitude is missing" in out


def test_old_batches_are_archived_verified_and_restored(acquire, tmp_path):
    cadence = ("--nominal", "--cadence", 3600)
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 4, *cadence)
    replay = ("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")
    assert acquire(*replay)[0] == 0
    code, _, err = acquire("archive", "--before", "1999-061T00:00:00Z", "--to", "away")
    assert (code, "away: there is no such folder" in err) == (2, True)
    (tmp_path / "away").mkdir()
    code, _, err = acquire("archive", "--before", "2098-001T00:00:00Z", "--to", "away")
    assert (code, "--before: must not be in the future" in err) == (2, True)
    assert "--before: must be given" in acquire("archive", "--to", "away")[2]
    code, out, _ = acquire("archive", "--before", "1999-061T00:00:00Z", "--to", "away")
    assert code == 0
    assert out.startswith("3 batches before 1999-03-02T00:00:00.000Z were archived\n1 files, ")
    assert acquire("database", "verify")[:2] == (0, sound(1))
    verify = ("archive", "verify", "--archive", "away")
    assert acquire(*verify)[:2] == (0, "nothing is wrong with 3 batches\n")
    again = ("archive", "restore", "--archive", "away", "--database", "sqlite:///again.db")
    code, out, _ = acquire(*again)
    assert (code, out) == (0, "3 batches were restored; 0 were recorded already\n")
    needed = ("--database", "sqlite:///acquire.db")
    assert acquire(*verify, *needed)[0] == 0
    (part,) = (tmp_path / "away").rglob("part-1.parquet")
    part.unlink()
    code, out, _ = acquire(*verify, *needed)
    assert (code, "cannot be read" in out) == (1, True)


@pytest.mark.parametrize(
    "command",
    [
        "advise --spacecraft XTE",
        "advise --spacecraft XTE --json",
        "reprocess",
        "smooth XTE",
        "token list",
        "token revoke nobody",
        "database verify",
        "database check",
        "database backup copy.db",
        "database prune --before 1999-060T00:00:00Z --dry-run",
        "archive --before 1999-060T00:00:00Z --to .",
    ],
)
def test_no_command_that_reads_makes_a_database(acquire, tmp_path, command):
    code, out, err = acquire(*command.split(), "--database", "sqlite:///no.db")
    assert (code, out) == (2, "")
    assert "--database: no.db: there is no such file" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["advise --spacecraft XTE", "reprocess", "token list"])
def test_no_command_that_reads_makes_tables_in_another_file(acquire, tmp_path, command):
    (tmp_path / "empty.db").touch()
    (tmp_path / "text.db").write_text("no database, but a text of some length\n" * 40)
    with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
        connection.execute("CREATE TABLE theirs (id INTEGER)")
        connection.commit()
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    for name, complaint in (
        ("empty", "holds no records of this service"),
        ("other", "holds no records of this service"),
        ("text", "file is not a database"),
    ):
        code, out, err = acquire(*command.split(), "--database", f"sqlite:///{name}.db")
        assert (code, out) == (2, "")
        assert f"{name}.db: {complaint}" in err
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.slow
def test_what_writes_keeps_off_a_file_that_a_service_is_at_work_on(acquire, tmp_path):
    """Killed, the service leaves nothing behind that stands in the way."""
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 4, "--nominal")
    assert acquire("replay", tmp_path / "pass.ndjson", "--in-process", "--run", "r")[0] == 0
    again = ("reprocess", "--source", "r", "--run", "again", "--processes", 1)
    with served(f"sqlite:///{tmp_path / 'acquire.db'}") as (process, _):
        code, out, err = acquire(*again)
        assert (code, out) == (2, "")
        assert "(service.cli serve --port" in err
        assert acquire("smooth", "XTE", "--run", "r")[2] == err
        # Reading does no harm beside it.
        assert acquire("advise", "--spacecraft", "XTE", "--run", "r")[0] == 0
        process.kill()
        process.wait()
    # The process that writes ends with the one that was killed, a moment later.
    codes = []
    wait_until(lambda: codes.append(acquire(*again)[0]) or codes[-1] != 2, why="it is still there")
    assert codes[-1] == 0


PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + bytes(range(256)) * 20
CSV_TEXT = b"spacecraft,batch,time,tracker,x,y,z\nXTE,b1,1999-060T00:00:00Z,STARTRACKER_1,0,0,1\n"


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.ndjson", PNG, "is a binary file; telemetry is NDJSON, one batch a line, or CSV"),
        ("a.csv", PNG, "is a binary file; telemetry is NDJSON, one batch a line, or CSV"),
        ("a.ndjson", CSV_TEXT, "is no NDJSON but looks like CSV: name it .csv"),
        ("a.csv", b'{"spacecraft": "XTE"}\n', "is no CSV but looks like NDJSON: name it .ndjson"),
        ("a.ndjson", b"", "is empty: there is no batch in it"),
        ("a.csv", b"", "is empty: there is no batch in it"),
        ("a.ndjson", b"\n \n", "is empty: there is no batch in it"),
        ("a.ndjson", b"dear reader,\nthis is a letter\n", "is no NDJSON, which has one batch a"),
        ("a.ndjson", b'[{"spacecraft": "XTE"}]\n', "is JSON, but not NDJSON"),
        ("a.ndjson", b'{\n  "spacecraft": "XTE"\n}\n', "is JSON, but not NDJSON"),
        (
            "a.ndjson.gz",
            gzip.compress(b"{}\n", mtime=0),
            "is packed with gzip: unpack it first (gunzip)",
        ),
        ("a.csv", b"name,age\nX,3\n", "line 1: is no header of batches or gyro samples"),
    ],
)
@pytest.mark.parametrize("way", ["--in-process", "--url=http://127.0.0.1:9"])
def test_a_file_that_is_no_telemetry_is_told_as_what_it_is(
    acquire, tmp_path, name, content, complaint, way
):
    (tmp_path / name).write_bytes(content)
    code, out, err = acquire("replay", name, "--run", "r", way)
    assert (code, out) == (2, "")
    assert complaint in err
    assert all(line.startswith(f"acquire: {name}: ") for line in err.splitlines())
    assert not (tmp_path / "acquire.db").exists()


def test_a_port_in_use_is_named_with_its_remedy(acquire, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, out, err = acquire("serve", "--port", port)
    assert (code, out) == (2, "")
    assert f"acquire: http://127.0.0.1:{port}: Address already in use" in err
    assert "choose another port with --port" in err
    assert list(tmp_path.iterdir()) == []


def test_an_address_of_another_machine_is_named_with_its_remedy(acquire):
    code, _, err = acquire("serve", "--host", "192.0.2.1", "--port", 8123)
    assert code == 2
    assert "acquire: http://192.0.2.1:8123: Cannot assign requested address" in err
    assert "--host" in err


def test_the_description_is_printed_written_and_checked(acquire, tmp_path):
    code, out, _ = acquire("openapi")
    assert code == 0
    assert out.startswith("openapi: 3.1")
    assert acquire("openapi", "--output", "openapi.yaml")[0] == 0
    assert (tmp_path / "openapi.yaml").read_text() == out
    assert acquire("openapi", "--check")[0] == 0
    (tmp_path / "openapi.yaml").write_text(out.replace("/api/v1/zones", "/api/v1/places"))
    code, out, _ = acquire("openapi", "--check")
    assert code == 1
    assert "run `make openapi`" in out


def test_what_is_read_back_is_json_one_object_a_line(acquire, tmp_path):
    path = telemetry(acquire, tmp_path / "x.ndjson", "SWAS", 3)
    for line in path.read_text().splitlines():
        assert json.loads(line)["spacecraft"] == "SWAS"


def test_a_run_that_was_recorded_wrongly_is_forgotten_once_its_name_is_typed(
    acquire, tmp_path, monkeypatch
):
    path = telemetry(acquire, tmp_path / "night.ndjson")
    acquire("replay", path, "--in-process", "--run", "wrong")
    monkeypatch.setattr("builtins.input", lambda asked: "another")
    code, out, err = acquire("database", "forget", "--run", "wrong")
    assert (code, err.strip()) == (1, "nothing was removed")
    assert "from run wrong will be removed:\n  6 batches with their results" in out
    monkeypatch.setattr("builtins.input", lambda asked: "wrong")
    code, out, _ = acquire("database", "forget", "--run", "wrong")
    assert (code, out.splitlines()[-1]) == (0, "it was removed")
    code, _, err = acquire("database", "forget", "--run", "wrong", "--yes")
    assert (code, "nothing is recorded in run wrong" in err) == (2, True)
    code, out, _ = acquire("replay", path, "--in-process", "--run", "wrong")
    assert "  new               6" in out
    code, out, _ = acquire(
        "database", "forget", "--run", "wrong", "--batch", "1999-060-0001", "--yes", "--json"
    )
    assert json.loads(out)["batches"] == 1
    with closing(sqlite3.connect(tmp_path / "acquire.db")) as database:
        entries = database.execute("SELECT who, action, about FROM audit ORDER BY id").fetchall()
    assert [(who.partition(":")[0], *rest) for who, *rest in entries] == [
        ("command", "forget_run", "wrong")
    ] * 2


def test_a_locale_that_has_no_sign_for_a_name_hides_no_result(tmp_path):
    """Here the name of a file; of stars many are Greek."""
    command = [sys.executable, "-m", "service.cli", "mission", "check", str(tmp_path / "ν.toml")]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    found = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert found.returncode == 2
    assert "\\u03bd.toml: No such file" in found.stderr


def test_the_service_is_looked_for_where_the_settings_have_it_listen(
    acquire, tmp_path, monkeypatch
):
    (tmp_path / "pass.ndjson").write_text("{}\n")
    monkeypatch.setenv("ACQUIRE_HOST", "127.0.0.2")
    monkeypatch.setenv("ACQUIRE_PORT", "1")
    for where, options in (
        ("http://127.0.0.2:1", ()),
        ("http://127.0.0.3:1", ("--url", "http://127.0.0.3:1")),
    ):
        code, _, err = acquire("replay", "pass.ndjson", "--concurrency", "1", *options)
        assert code == 2
        assert where in err

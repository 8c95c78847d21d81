"""Input formats stand in one list: what replays and uploads read, and the page, follow from it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.acquire import acquire
from service.ephemerides.files import read_attitudes, read_ephemeris
from service.errors import BadInput
from service.gyro.blocks import block_from_line
from service.observations.csv_rows import COLUMNS
from service.observations.input_formats import (
    CSV_COLUMNS,
    INPUT_FORMATS,
    input_format,
    input_formats,
)
from service.observations.schema import submission_from_json
from service.observations.telemetry import read_lines
from service.times import parse_utc

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "input-formats.md").read_text(encoding="utf-8")
NOON = parse_utc("1996-01-10T12:54:30.000Z")


def example_file(name, folder):
    suffixes = INPUT_FORMATS[name].suffixes
    file = folder / f"example{suffixes[0] if suffixes else f'.{name}'}"
    file.write_text(INPUT_FORMATS[name].example, encoding="utf-8")
    return file


def test_every_column_of_csv_is_described_once():
    assert sorted(" ".join(names for names, _, _ in CSV_COLUMNS).split()) == sorted(COLUMNS)


def test_the_page_has_every_format_column_and_example():
    rows = dict(re.findall(r"^\| `([\w-]+)` \| `([^|]+)` \|", PAGE, re.MULTILINE))
    assert rows == {name: each.given for name, each in input_formats().items()}
    for names, unit, meaning in CSV_COLUMNS:
        cells = ", ".join(f"`{name}`" for name in names.split())
        assert f"| {cells} | {unit} | {meaning} |" in PAGE
    for each in input_formats().values():
        assert f"## {each.title}\n" in PAGE
        assert each.example in PAGE


def test_the_batch_and_the_gyro_block_of_the_examples_are_read(tmp_path, missions, sky):
    (line, block), (row,) = (
        [each.body for each in read_lines(example_file(name, tmp_path))]
        for name in ("ndjson", "csv")
    )
    solved = [
        acquire(submission_from_json(each).batch, missions["XTE"], sky) for each in (line, row)
    ]
    assert [each.counts["unique"] for each in solved] == [4, 4]
    by_line, by_row = (np.array(each.solution.quaternion) for each in solved)
    # The rows have no velocity: the aberration of the orbit is what they differ by.
    assert 1.0 < 2.0 * 206_264.8 * np.linalg.norm(by_line - by_row) < 10.0
    assert len(block_from_line(block, "live").rates_rad_per_s) == 2


def test_the_files_beside_telemetry_of_the_examples_are_read(tmp_path):
    body = json.loads(INPUT_FORMATS["ndjson"].example.splitlines()[0])
    for name in ("aem", "attitude-csv"):
        attitudes = read_attitudes(example_file(name, tmp_path), "--a-priori")
        (prior,) = attitudes.at(np.array([NOON.tai_ns])).tolist()
        assert prior == pytest.approx(body["a_priori"]["quaternion"], abs=1e-9)
    orbit = read_ephemeris(example_file("oem", tmp_path), "--ephemeris").at(NOON)
    assert orbit[3:].tolist() == pytest.approx(body["velocity_km_per_s"], abs=1e-6)


def test_the_set_of_elements_of_the_example_is_in_low_orbit(tmp_path):
    pytest.importorskip("sgp4")
    orbit = read_ephemeris(example_file("tle", tmp_path), "--ephemeris")
    state = orbit.at(parse_utc("2008-09-20T12:25:40Z"))
    assert 6_700 < (state[:3] ** 2).sum() ** 0.5 < 6_760
    assert 7.5 < (state[3:] ** 2).sum() ** 0.5 < 7.8


def test_the_list_and_each_format_are_printed(acquire):
    code, out, _ = acquire("replay", "--formats")
    assert code == 0
    formats = input_formats()
    assert [line.split()[0] for line in out.splitlines()[: len(formats)]] == [*formats]
    for name, each in formats.items():
        code, out, _ = acquire("replay", "--formats", name)
        assert (code, each.example in out, each.given in out) == (0, True, True)
    assert max(len(line) for line in acquire("replay", "--formats")[1].splitlines()) <= 100


def test_an_unknown_format_is_refused_with_all_named():
    with pytest.raises(BadInput, match=r"--formats: must be one of ndjson, csv, .* \(got 'xls'\)"):
        input_format("xls")


# ---- a format of another package ----------------------------------------------------------------

STARS = {
    "stars/__init__.py": """
from service.feature import Feature
FEATURE = Feature("stars", __name__, ("formats",))
""",
    "stars/formats.py": """
import json
from service.observations.decompress import Line
from service.observations.input_formats import InputFormat

PRIOR = {"quaternion": [0.6330424085, -0.333721514, 0.5945872171, 0.3665423597]}

def read(stream):
    for number, line in enumerate(stream, 1):
        time, *numbers = line.decode().split()
        stars = [
            {"h_deg": float(h), "v_deg": float(v), "magnitude": float(m)}
            for h, v, m in zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True)
        ]
        batch = {"spacecraft": "XTE", "batch": f"line-{number}", "time": time, "a_priori": PRIOR}
        batch["observations"] = [{"tracker": "STARTRACKER_1", "stars": stars}]
        yield Line(number, json.dumps(batch).encode())

INPUT_FORMATS = {
    "stars": InputFormat(
        "Star lines", "batches, one a line", "FILE.stars", "time, then h, v, magnitude of stars",
        suffixes=(".stars",), media_types=("text/x-stars",), read=read, uploaded="A batch a line.",
    )
}
""",
    "stars-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: stars\nVersion: 1\n",
    "stars-1.dist-info/entry_points.txt": "[acquire.features]\nstars = stars:FEATURE\n",
}
"""A package that brings an input format, in one file beside its declaration."""

UPLOADED = """
import sys, time
import httpx
from service.app.factory import open_app
from service.settings import Settings
from service.web.app import create_app
from tests.web.serving import Server

file, database = sys.argv[1:]
settings = Settings(database="sqlite:///" + database, replay_processes=0)
with Server(create_app(open_app(settings, serving=True))) as url:
    body, kind = open(file, "rb").read(), {"content-type": "text/x-stars"}
    begun = httpx.post(url + "/api/v1/replays?run=up", content=body, headers=kind, timeout=120)
    assert begun.status_code == 202, begun.text
    def got(path):
        return httpx.get(url + path, timeout=120).json()

    while (state := got(begun.headers["location"]))["state"] == "running":
        time.sleep(0.1)
    print(state["state"], state["counts"]["new"], state["counts"]["unique"])
    described = got("/api/v1/openapi.json")["paths"]["/api/v1/replays"]["post"]
    print(described["requestBody"]["content"]["text/x-stars"]["schema"]["description"])
"""


def test_a_format_of_another_package_is_listed_replayed_and_uploaded(tmp_path):
    for name, text in STARS.items():
        file = tmp_path / "site" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    rows = [row.split(",") for row in INPUT_FORMATS["csv"].example.splitlines()[1:]]
    stars = " ".join(" ".join(row[-3:]) for row in rows)
    sent = tmp_path / "pass.stars"
    sent.write_text(f"{NOON.text} {stars}\n")

    def run(*words):
        place = os.pathsep.join(map(str, (tmp_path / "site", ROOT)))
        done = subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": place},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    replay = "-m", "service.cli", "replay"
    assert re.search(r"^stars +FILE\.stars", run(*replay, "--formats"), re.M)
    database = f"sqlite:///{tmp_path / 'in.db'}"
    told = json.loads(run(*replay, sent, "--in-process", "--json", "--database", database))
    assert (told["batches"], told["stars"]["unique"]) == (1, 4)
    uploaded = run("-c", UPLOADED, sent, tmp_path / "up.db").splitlines()
    assert uploaded == ["done 1 4", "A batch a line."]

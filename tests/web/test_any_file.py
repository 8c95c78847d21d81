"""Damaged files of every format, over HTTP and by the command: refused in words, or read."""

import random
import re
from pathlib import Path

import httpx
import numpy as np
import pytest

from service.cli import main
from tests.features.pictures.hostile_headers import absurd_files
from tests.fresh_databases import sqlite_at
from tests.mutations import NAMES, Readers, mutated, with_right_sums
from tests.scale import size
from tests.web.serving import ended

MUTATIONS = 2_000
"""Damaged files of each format that are sent by each way."""
MAX_GROWTH_MB = 400
TELEMETRY = {
    "ndjson": {"Content-Type": "application/x-ndjson"},
    "csv": {"Content-Type": "text/csv"},
    "ndjson_gzip": {"Content-Type": "application/x-ndjson", "Content-Encoding": "gzip"},
    "ndjson_zstd": {"Content-Type": "application/x-ndjson", "Content-Encoding": "zstd"},
    "packet_archive": {"Content-Type": "application/x-tar"},
}
FRAMES = [name for name in NAMES if re.match("fits|tiff|png|jpeg|bmp|raw|npy", name)]
COMMANDS = {
    **dict.fromkeys(FRAMES, ("frame", "FILE")),
    **dict.fromkeys(("ndjson", "csv"), ("replay", "FILE", "--in-process", "--run", "x")),
    **dict.fromkeys(("catalog_csv", "sky2000", "sky2000_gzip"), ("catalog", "import", "FILE")),
    **dict.fromkeys(("aem", "aem_of_version_1", "aem_xml"), ("score", "FILE", "--spacecraft=XTE")),
    "mission": ("mission", "show", "FILE"),
}
ABSURD = absurd_files(np.random.default_rng(4))
SUFFIXES = {"csv": ".csv", "mission": ".toml", "catalog_csv": ".csv"}


def held_mb():
    (held,) = re.findall(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(held) / 1024


@pytest.fixture
def damaged(tmp_path, seed):
    """Damaged files of a format, none of which may make this process grow beyond a bound."""

    def files(name):
        good, _ = getattr(Readers(tmp_path), name)()
        draw = random.Random(f"{name} {seed}")
        yield good
        before_mb = held_mb()
        for _ in range(size(MUTATIONS, 3)):
            data = mutated(good, draw)
            yield with_right_sums(data) if name.startswith("png_") else data
        assert held_mb() - before_mb < MAX_GROWTH_MB

    return files


def refused_in_words(answer):
    assert answer.status_code < 500 or "Retry-After" in answer.headers, answer.text
    if answer.status_code >= 400:
        problem = answer.json()
        assert problem["status"] == answer.status_code
        assert problem["detail"]


@pytest.mark.parametrize("name", ABSURD)
def test_a_picture_with_an_absurd_header_is_refused(client, name):
    headers = {"Content-Type": "application/octet-stream"}
    answer = client.post("/api/v1/pictures", content=ABSURD[name][0], headers=headers)
    assert answer.status_code == 422
    assert [each["field"] for each in answer.json()["errors"]] == ["frame"]


@pytest.mark.torture
@pytest.mark.parametrize("name", FRAMES)
def test_a_damaged_picture_is_refused_or_read(client, damaged, name, figures):
    headers, met = {"Content-Type": "application/octet-stream"}, {}
    for data in damaged(name):
        try:
            answer = client.post("/api/v1/pictures", content=data, headers=headers)
        except httpx.TransportError as error:
            pytest.fail(f"{error!r}: {data!r}"[:4_000])
        refused_in_words(answer)
        met[answer.status_code] = met.get(answer.status_code, 0) + 1
    figures(**{str(status): count for status, count in met.items()})


@pytest.mark.torture
@pytest.mark.parametrize("name", TELEMETRY)
def test_a_damaged_upload_is_refused_or_ends(client, damaged, name, seed, figures):
    met = {}
    for number, data in enumerate(damaged(name)):
        where = f"/api/v1/replays?run=any-{name}-{seed}-{number}"
        answer = client.post(where, content=data, headers=TELEMETRY[name])
        refused_in_words(answer)
        told = answer.status_code
        if told == 202:
            told = ended(client, answer)["state"]
        met[str(told)] = met.get(str(told), 0) + 1
    assert met.keys() <= {"done", "failed", "400", "413", "415", "422"}
    figures(**met)


@pytest.mark.torture
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_says_in_a_line_what_is_wrong_with_a_file(
    damaged, tmp_path, monkeypatch, capsys, name, figures
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ACQUIRE_DATABASE", sqlite_at(tmp_path / "any.db"))
    file, codes = tmp_path / f"damaged{SUFFIXES.get(name, '')}", {}
    for data in damaged(name):
        file.write_bytes(data)
        code = main([str(file) if each == "FILE" else each for each in COMMANDS[name]])
        told = capsys.readouterr()
        assert code in (0, 1, 2)
        assert "Traceback" not in told.err + told.out
        if code == 2:
            assert told.err.startswith("acquire: ")
        codes[str(code)] = codes.get(str(code), 0) + 1
    figures(**codes)

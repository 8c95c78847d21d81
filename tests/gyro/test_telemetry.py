"""Gyro blocks in telemetry files: sent beside batches, each way the same."""

import json
import time

import pytest
from acquire_client import Client

from service.access import Caller
from service.app.factory import open_app
from service.errors import BadBatch, BadFile
from service.features.products.part import Products
from service.gyro.blocks import block_from_json, block_from_line, is_gyro_line, json_of_block
from service.observations import gyro_rows
from service.observations.telemetry import read_lines
from service.replay.in_process import replay_in_process
from service.replay.items import Pace, items_of
from service.replay.over_http import replay_in_bulk, replay_over_http
from service.replay.summary import ReplaySummary
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.times import parse_utc, shifted
from service.web.app import create_app
from tests.gyro.blocks import START, body
from tests.web.serving import Server

HEADER = "spacecraft,run,block,time,rate_1_rad_per_s,rate_2_rad_per_s,rate_3_rad_per_s\n"


def later(seconds):
    return shifted(parse_utc(START), seconds).text


def line(block="g1", **wanted):
    return {"spacecraft": "XTE"} | body(block, **wanted)


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """An app and its address."""
    folder = tmp_path_factory.mktemp("served")
    app = open_app(Settings(database=f"sqlite:///{folder / 'acquire.db'}", replay_processes=1))
    with Server(create_app(app)) as address:
        yield app, address


@pytest.fixture
def mixed(missions, sky, tmp_path, rng):
    """A file with six batches, and after each a gyro block; two lines of it are bad."""
    drawn = draw_pass(missions["XTE"], sky, Pass(6, 5))
    lines = []
    for k, each in enumerate(drawn):
        lines += [each.batch, line(f"g{k}", start=later(k), samples=10, rng=rng)]
    lines.insert(4, line("bad", start=later(100.0)) | {"rates_rad_per_s": [[0, 100.0, 0]]})
    lines.append(line("late", start=later(5.5)))
    file = tmp_path / "mixed.ndjson"
    file.write_text("".join(f"{json.dumps(each)}\n" for each in lines))
    return file


def names(app, run):
    return [each.block for each in app.gyro.page("XTE", run=run).items]


@pytest.mark.parametrize("way", ["posts", "bulk", "in process"])
def test_a_file_with_batches_and_gyro_blocks_is_recorded_whole(service, mixed, tmp_path, way):
    """The same in every way: what is new, what is there already, and which lines are bad."""
    app, address = service
    run, told = way.replace(" ", "-"), []
    for _ in range(2):
        refused = []
        with ReplaySummary([mixed], None, progress=False) as summary:

            def report(outcome, refused=refused, summary=summary):
                if outcome.answer is None:
                    refused.append((outcome.item.number, outcome.problem["detail"]))
                summary.add(outcome)

            if way == "bulk":
                replay_in_bulk(address, [mixed], run, report, summary.follow)
            elif way == "posts":
                # One at a time: of two blocks that share a time the first that arrives is recorded.
                replay_over_http(address, items_of([mixed], run), report, concurrency=1)
            else:
                replay_in_process(app, items_of([mixed], run), report)
        told.append(summary.counts())
        assert [number for number, _ in sorted(refused)] == [5, 14]
        details = dict(refused)
        assert "rates_rad_per_s.0.1: is beyond the largest rate of XTE" in details[5]
        assert "'late' has a sample at" in details[14]
    first, again = told
    assert (first["new"], first["refused"], first["attitudes"]) == (6, 2, again["attitudes"])
    assert first["gyro_blocks"] == {"new": 6, "already_recorded": 0}
    assert again["gyro_blocks"] == {"new": 0, "already_recorded": 6}
    assert names(app, run) == [f"g{k}" for k in range(6)]
    assert "gyro blocks         6" in summary.table()


def test_every_way_records_the_same_samples(service, mixed):
    app, address = service
    runs = ("same-posts", "same-bulk", "same-here")
    ignore = lambda _: None  # noqa: E731
    replay_over_http(address, items_of([mixed], runs[0]), ignore, concurrency=1)
    replay_in_bulk(address, [mixed], runs[1], ignore, ignore)
    replay_in_process(app, items_of([mixed], runs[2]), ignore)
    found = []
    for run in runs:
        ids = [each.id for each in app.gyro.page("XTE", run=run).items]
        read = [app.gyro.get("XTE", id) for id in ids]
        found.append([(e.block, e.start, e.step_s, e.times_s, e.rates_rad_per_s) for e in read])
    assert found[0] == found[1] == found[2]
    assert len(found[0]) == 6


def test_the_results_have_a_line_for_each_block(service, mixed, tmp_path):
    app, _ = service
    results = tmp_path / "results.ndjson"
    with ReplaySummary([mixed], results, progress=False) as summary:
        replay_in_process(app, items_of([mixed], "results"), summary.add)
    written = [json.loads(each) for each in results.read_text().splitlines()]
    assert len(written) == 14
    assert (written[1]["block"], written[1]["samples"]) == ("g0", 10)


def test_a_bound_token_replays_the_blocks_of_its_spacecraft_alone(service, rng):
    app, _ = service
    mine = line("mine", rng=rng)
    other = line("other", rng=rng) | {"spacecraft": "SWAS"}
    caller = Caller("a", frozenset(["submit"]), frozenset(["XTE"]), "A")
    lines = [f"{json.dumps(each)}\n".encode() for each in (mine, other)]
    id = app.replays.start(lines, "bound", check=caller.require)
    while (replay := app.replays.get(id)).finished is None:
        time.sleep(0.02)
    assert (replay.counts.gyro_new, replay.lines.refused) == (1, 1)
    assert "bound to XTE, not to SWAS" in replay.errors[0].problem.detail
    assert app.gyro.page("SWAS", run="bound").items == []


def test_the_progress_of_a_replay_counts_blocks_for_clients(service, mixed):
    _, address = service
    with Client(address) as client, mixed.open("rb") as lines:
        replay = client.replay(lines, run="counted")
    assert (replay.counts.gyro_new, replay.counts.new) == (6, 6)


def test_a_block_is_due_when_its_last_sample_is(tmp_path):
    file = tmp_path / "two.ndjson"
    two = [line("a", samples=11), line("b", start=later(2.0), samples=11)]
    file.write_text("\n".join(map(json.dumps, two)))
    pace = Pace(1.0)
    waits = [pace.wait_s(item, 100.0) for item in items_of([file], "run")]
    assert waits == pytest.approx([0.0, 2.0])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (json.dumps(line()), True),
        ('{"rates_rad_per_s": 3}', True),
        ('{"spacecraft": "XTE", "batch": "rates_rad_per_s", "observations": []}', False),
        ('{"options": {"rates_rad_per_s": []}}', False),
        ('"rates_rad_per_s"', False),
        ('{"rates_rad_per_s": [', False),
        ("[" * 100_000 + '"rates_rad_per_s"', False),
    ],
)
def test_a_line_is_a_gyro_block_by_its_own_field(text, found):
    assert is_gyro_line(text.encode()) is found


def test_a_block_is_sent_as_it_was_read(rng):
    for told in (body(rng=rng), body(times_s=[0.0, 0.1, 0.7], rng=rng)):
        block = block_from_json(json.dumps(told), "XTE")
        assert block_from_json(json_of_block(block), "XTE").fingerprint == block.fingerprint


# ---- comma-separated values ----------------------------------------------------------------------


def csv_of(*rows):
    return HEADER + "".join(f"{row}\n" for row in rows)


def read(tmp_path, text):
    file = tmp_path / "gyro.csv"
    file.write_text(text)
    return list(read_lines(file))


def test_rows_of_samples_are_the_blocks_that_lines_would_be(tmp_path):
    text = csv_of(
        "XTE,,a,1998-12-31T23:59:59.500Z,0.001,-2e-5,0",
        "XTE,,a,1998-12-31T23:59:60.500Z,0.0011,-3e-5,1e-5",
        "XTE,,a,1999-01-01T00:00:00.500Z, 0.0012 ,-4e-5,2e-5",
        "XTE,pass-7,a,1999-060T00:00:00Z,0.5e-3,0,0",
    )
    first, second = (block_from_line(each.body) for each in read(tmp_path, text))
    assert (first.block, first.run, second.run) == ("a", "live", "pass-7")
    assert first.start.text == "1998-12-31T23:59:59.500Z"
    assert first.times_s.tolist() == [0.0, 1.0, 2.0]
    assert first.rates_rad_per_s[2].tolist() == [0.0012, -4e-5, 2e-5]
    assert second.rates_rad_per_s.tolist() == [[0.0005, 0.0, 0.0]]


def test_rows_and_samples_that_are_there_twice_count_once(tmp_path):
    """A file appended to itself, and a body whose every sample is sent twice."""
    rows = [f"XTE,,a,1999-03-01T00:00:0{k}Z,0.00{k},0,1e-5" for k in range(5)]
    (once,) = read(tmp_path, csv_of(*rows))
    (twice,) = read(tmp_path, csv_of(*rows, *rows))
    assert twice.body == once.body
    block = block_from_line(once.body)
    told = json.loads(once.body)
    told |= {
        name: [each for each in told[name] for _ in "ab"] for name in ("times_s", "rates_rad_per_s")
    }
    assert block_from_line(json.dumps(told)).fingerprint == block.fingerprint
    told["rates_rad_per_s"][1] = [0.5, 0.0, 1e-5]
    with pytest.raises(BadBatch, match=r"times_s.1: must be at least 1e-06 s after"):
        block_from_line(json.dumps(told))


def test_an_export_can_be_read_with_a_column_for_the_spacecraft(service, tmp_path, rng):
    app, _ = service
    told = line("round", rng=rng, samples=50, run="round")
    app.gyro.record(block_from_line(json.dumps(told)))
    table = app.part(Products).table("XTE", "gyro", run="round")
    (page,) = table.pages
    times, _, blocks, *rates = page
    rows = [
        f"XTE,again,{block},{at},{','.join(map(repr, three))}"
        for at, block, three in zip(times, blocks, zip(*rates, strict=True), strict=True)
    ]
    (found,) = read(tmp_path, csv_of(*rows))
    assert block_from_line(found.body).rates_rad_per_s.tolist() == told["rates_rad_per_s"]


@pytest.mark.parametrize(
    ("row", "field", "message"),
    [
        ("XTE,,b,noon,0,0,0", "line 3, column time", "must be UTC"),
        (
            "XTE,,b,1999-03-01T00:00:01Z,0,nan,0",
            "line 3, column rate_2_rad_per_s",
            "must be a number",
        ),
        ("XTE,,b,1999-03-01T00:00:01Z,0,,0", "line 3, column rate_2_rad_per_s", "is empty"),
    ],
)
def test_a_bad_cell_refuses_its_block_by_line_and_column(tmp_path, row, field, message):
    good = "XTE,,b,1999-03-01T00:00:00Z,0,0,0"
    after = "XTE,,c,1999-03-01T00:00:09Z,0,0,0"
    bad, fine = read(tmp_path, csv_of(good, row, after))
    assert (bad.number, bad.fault.field) == (3, field)
    assert message in bad.fault.message
    assert block_from_line(fine.body).block == "c"


def test_a_damaged_row_refuses_the_blocks_on_both_sides(tmp_path):
    row = "XTE,,{},1999-03-01T00:00:0{}Z,0,0,0"
    text = csv_of(row.format("a", 0), "XTE,,a", row.format("a", 2), row.format("b", 3))
    before, stray, after, fine = read(tmp_path, text)
    assert [each.fault and each.fault.field for each in (before, stray, after)] == [
        "line 2",
        "line 3",
        "line 4",
    ]
    assert block_from_line(fine.body).block == "b"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER.replace("time", "start"), "line 1, column start: there is no such column"),
        (HEADER.replace(",rate_3_rad_per_s", ""), "line 1, column rate_3_rad_per_s: is missing"),
        (HEADER.replace("run", "block"), "line 1, column block: occurs twice"),
    ],
)
def test_a_bad_header_refuses_the_file(tmp_path, header, message):
    with pytest.raises(BadFile, match=message):
        read(tmp_path, header)


def test_rows_that_are_there_again_do_not_count_towards_the_most(tmp_path, monkeypatch):
    """As of a file that was written to its own end."""
    monkeypatch.setattr(gyro_rows, "MAX_ROWS", 3)
    rows = [f"XTE,,a,{later(k)},0.001,0,{k}e-5" for k in range(4)]
    (block,) = read(tmp_path, csv_of(*rows[:3], *rows[:3]))
    assert len(block_from_line(block.body).times_s) == 3
    (block,) = read(tmp_path, csv_of(*rows, *rows))
    assert "has more than 3 rows" in block.fault.message

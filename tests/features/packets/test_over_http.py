"""Space packets enter over HTTP as on the command line; the replay shows what was in them."""

import dataclasses
import io
import json
import tarfile
from contextlib import closing

import httpx
import pytest
from sqlalchemy import update

from service.app.factory import open_app
from service.cli import build_parser
from service.features.packets.reader import file_lines
from service.features.packets.telemetry import files_of
from service.ingest.spool import Spool, SpooledReplay
from service.missions.mission import SHIPPED_FOLDER
from service.observations.schema import checked_from_json
from service.replay.in_process import replay_in_process
from service.replay.items import item_of
from service.replay.over_http import replay_in_bulk
from service.replay.summary import ReplaySummary
from service.storage.sql.tables import replays
from service.web.app import create_app
from tests.features.packets.packing import ANGLES, TABLE, mission_of_pass, packed, packet, xtce
from tests.features.packets.test_reader import reader_of
from tests.storage.samples import without_accidents
from tests.web.conformance import check
from tests.web.serving import Server, ended, in_process_settings

API = "/api/v1"
HEADERS = {"Content-Type": "application/x-tar"}


@pytest.fixture(scope="module")
def missions_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("missions")
    text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    (folder / "xte.toml").write_text(text + TABLE.format(directions=ANGLES))
    return folder


@pytest.fixture(scope="module")
def packet_app(chosen_database, missions_folder):
    return open_app(in_process_settings(chosen_database(), missions=missions_folder))


@pytest.fixture(scope="module")
def packet_address(packet_app):
    with Server(create_app(packet_app)) as url:
        yield url


@pytest.fixture(scope="module")
def packet_client(packet_address):
    hooks = {"response": [check]}
    with httpx.Client(base_url=packet_address, timeout=60, event_hooks=hooks) as client:
        yield client


@pytest.fixture(scope="module")
def batches(drawn):
    return drawn("XTE", 12, seed=5, angles_share=1.0)


@pytest.fixture(scope="module")
def content(batches):
    """Twelve batches; a gap of two, two packets of an unknown APID, and one that is too short."""
    data = packed(batches[:6]) + packet(b"\0" * 9, 0, apid=77) + packet(b"\0" * 9, 1, apid=77)
    return data + packet(b"\0" * 5, 8) + packed(batches[6:], first=9)


def archive(**files):
    found = io.BytesIO()
    with tarfile.open(fileobj=found, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(name.replace("_", "."))
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return found.getvalue()


def test_an_archive_gives_the_results_of_the_same_batches_and_counts_its_packets(
    packet_client, packet_app, batches, content, run
):
    data = archive(test_xml=xtce(), pass_dat=content)
    begun = packet_client.post(f"{API}/replays?run={run}", content=data, headers=HEADERS)
    state = ended(packet_client, begun)
    assert state["state"] == "done"
    assert state["counts"]["new"] == 12
    packets = state["packets"]
    assert (packets["packets"], packets["batches"], packets["unknown"]) == (15, 12, 2)
    assert (packets["gaps"], packets["missing"], packets["refused"]) == (1, 2, 1)
    assert {each["apid"]: each["described"] for each in packets["apids"]} == {301: True, 77: False}
    (refused,) = state["errors"]
    assert refused["line"] == 9
    assert "pass.dat, packet 9 at byte" in refused["problem"]["detail"]
    assert "ST_BATCH" in refused["problem"]["detail"]

    # The same batches as lines are the same: nothing is recorded twice.
    lines = b"\n".join(json.dumps(each).encode() for each in batches)
    ndjson = {"Content-Type": "application/x-ndjson"}
    again = packet_client.post(f"{API}/replays?run={run}", content=lines, headers=ndjson)
    state = ended(packet_client, again)
    assert state["packets"] is None
    assert (state["counts"]["repeated"], state["counts"]["new"]) == (12, 0)


def test_the_page_of_the_replay_shows_gaps_and_unknown_apids(packet_client, content, run):
    data = archive(test_xml=xtce(), pass_dat=content)
    begun = packet_client.post(f"{API}/replays?run={run}", content=data, headers=HEADERS)
    state = ended(packet_client, begun)
    page = packet_client.get(f"/replays/{state['id']}").text
    assert "Packets by APID" in page
    assert "missing packets" in page
    assert '<th scope="row" class="number">77</th><td>no</td>' in page
    assert "Refused packets" in page


def test_a_replay_of_lines_shows_no_packets(packet_client, batches, run):
    ndjson = {"Content-Type": "application/x-ndjson"}
    body = json.dumps(batches[0])
    begun = packet_client.post(f"{API}/replays?run={run}", content=body, headers=ndjson)
    page = packet_client.get(f"/replays/{ended(packet_client, begun)['id']}").text
    assert "APID" not in page
    assert "No line was refused" in page


def test_the_command_uploads_packets_and_reports_their_counts(
    packet_address, content, run, tmp_path
):
    (tmp_path / "pass.dat").write_bytes(content)
    (tmp_path / "test.xml").write_bytes(xtce())
    options = ["--packets", str(tmp_path / "pass.dat"), "--xtce", str(tmp_path / "test.xml")]
    files, outcomes = files_of(build_parser().parse_args(["replay", *options])), []
    with ReplaySummary([], None, False) as summary:
        replay_in_bulk(packet_address, files, run, outcomes.append, summary.follow)
    assert summary.packets["missing"] == 2
    assert "unknown APIDs     77" in summary.table()
    assert [each.item.number for each in outcomes] == [9]


def test_in_this_process_packets_give_the_answers_of_the_batches(
    packet_app, batches, content, run, tmp_path
):
    (tmp_path / "pass.dat").write_bytes(content)
    outcomes = []
    reader = reader_of(mission_of_pass())
    items = (item_of(*each, run) for each in file_lines(reader, [tmp_path / "pass.dat"]))
    replay_in_process(packet_app, items, outcomes.append)
    answers = [json.loads(each.answer) for each in outcomes if each.answer is not None]
    assert [each["batch"] for each in answers] == [each["batch"] for each in batches]
    lines = [checked_from_json(json.dumps(each), f"{run}-lines") for each in batches]
    for answer, line in zip(answers, lines, strict=True):
        alone = packet_app.submissions.submit_many([_submission(line)])[0]
        assert _plain(answer) == _plain(json.loads(alone.body))


def _submission(line):
    from service.observations.schema import submission_from_checked

    return submission_from_checked(line)


def _plain(answer):
    return {key: value for key, value in without_accidents(answer).items() if key != "run"}


def bomb(name, kind, size=b"00000000000"):
    header = bytearray(tarfile.TarInfo(name).tobuf(tarfile.USTAR_FORMAT))
    header[124:135], header[156:157] = size, kind
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return bytes(header)


WRONG = [
    (b"", "has no lines"),
    (b"x", "no tar archive"),
    (b"\0" * 1024, "must hold one XTCE file"),
    (archive(pass_dat=b"\0" * 8), "must hold one XTCE file"),
    (archive(test_xml=xtce()), "it holds test.xml"),
    (archive(a_xml=xtce(), b_xml=xtce(), pass_dat=b"x"), "it holds a.xml, b.xml"),
    (archive(test_xml=b"<a/>", pass_dat=b"x"), "SpaceSystem"),
    (archive(test_xml=xtce(doctype="<!DOCTYPE a>\n"), pass_dat=b"x"), "test.xml, line 2"),
    (archive(test_xml=xtce().replace(b"ST_US", b"ST_UX"), pass_dat=b"x"), "packets.time"),
    (archive(test_xml=xtce(), pass_dat=b"x" * 40000)[:-20000], "ends within the member"),
    (bomb("link", b"2"), "no plain file"),
    (bomb("sparse", b"S"), "no plain file"),
    (bomb("large", b"0", b"77777777777"), "ends within the member"),
    (bomb("binary", b"0", b"\x80\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff"), "no tar archive"),
]


@pytest.mark.parametrize(("data", "why"), WRONG)
def test_an_archive_that_makes_no_sense_is_refused_in_words(data, why, packet_client, run):
    answer = packet_client.post(f"{API}/replays?run={run}", content=data, headers=HEADERS)
    assert answer.status_code == 422, answer.text
    assert why in answer.json()["detail"]


def test_packets_of_a_mission_without_a_table_are_refused(packet_client, client, run):
    data = archive(test_xml=xtce(), pass_dat=b"x")
    query = f"{API}/replays?run={run}"
    named = packet_client.post(f"{query}&spacecraft=SOHO", content=data, headers=HEADERS)
    assert named.status_code == 422
    assert "there is XTE" in named.json()["detail"]
    none = client.post(query, content=data, headers=HEADERS)
    assert none.status_code == 422
    assert "no mission has a table [packets]" in none.json()["detail"]


def test_a_spacecraft_goes_with_packets_alone(packet_client, batches, run):
    ndjson = {"Content-Type": "application/x-ndjson"}
    body = json.dumps(batches[0])
    query = f"{API}/replays?run={run}&spacecraft=XTE"
    answer = packet_client.post(query, content=body, headers=ndjson)
    assert answer.status_code == 422
    assert "spacecraft" in answer.json()["detail"]


def test_a_file_that_ends_within_a_packet_is_recorded_up_to_there(packet_client, batches, run):
    data = archive(test_xml=xtce(), pass_dat=packed(batches[:4])[:-30])
    begun = packet_client.post(f"{API}/replays?run={run}", content=data, headers=HEADERS)
    state = ended(packet_client, begun)
    assert (state["state"], state["counts"]["new"]) == ("done", 3)
    assert "packet 4 at byte" in state["errors"][0]["problem"]["detail"]


@pytest.fixture
def off_client(tmp_path, missions_folder):
    settings = in_process_settings(f"sqlite:///{tmp_path}/off.db", missions=missions_folder)
    app = open_app(dataclasses.replace(settings, features_off="packets"))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        yield client


def test_switched_off_neither_uploads_nor_the_command_take_packets(off_client, capsys, run):
    data = archive(test_xml=xtce(), pass_dat=b"x")
    answer = off_client.post(f"{API}/replays?run={run}", content=data, headers=HEADERS)
    assert answer.status_code == 415
    with pytest.raises(SystemExit):
        build_parser(features_off="packets").parse_args(["replay", "--packets", "a"])
    assert "there is no option --packets" in capsys.readouterr().err


def test_an_archive_left_from_before_it_was_switched_off_does_not_keep_the_service(
    tmp_path, missions_folder
):
    settings = in_process_settings(f"sqlite:///{tmp_path}/left.db", missions=missions_folder)
    settings = dataclasses.replace(settings, features_off="packets")
    with closing(open_app(settings)) as app:
        spool = Spool(settings.spool_folder)
        replay = app.replays.start([], "left")
        app.replays.stop()
        file = spool.new_file()
        file.write(archive(test_xml=xtce(), pass_dat=b"x"))
        spool.keep(file, SpooledReplay(replay, "identity", 1000, None, "local", None, "XTE"))
        file.close()
        spool.release(replay)
        mark = update(replays).where(replays.c.id == replay).values(state="interrupted")
        app.context.change(lambda connection: connection.execute(mark))
    with closing(open_app(settings)) as app:
        app.replays.resume()
        assert app.replays.at_work == []
        assert app.replays.get(replay).state != "running"

"""Attitudes of a file as a priori knowledge of a replay, and as the truth that it is scored by."""

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from service.app.factory import open_app
from service.cli import main
from service.ephemerides.rows import AttitudeRows
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass, read_objects
from service.times import parse_utc
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from service.web.app import create_app
from tests.features.products.series import rows, written
from tests.web.serving import Server

N = 12


@pytest.fixture(scope="module")
def passing(missions, sky):
    drawn = list(draw_pass(missions["XTE"], sky, Pass(N, 5)))
    return [{**each.batch, "a_priori": None} for each in drawn], [each.truth for each in drawn]


@pytest.fixture
def files(passing, tmp_path):
    """The telemetry, its truth as AEM in both forms and as C-kernel, and a database."""
    lines, truths = passing
    (tmp_path / "pass.ndjson").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    (tmp_path / "pass.truth.ndjson").write_text("".join(f"{json.dumps(t)}\n" for t in truths))
    page = truth_page(lines, truths)
    for form, name in (("aem", "truth.aem"), ("aem-xml", "truth.xml"), ("ck", "truth.zip")):
        (tmp_path / name).write_bytes(written(form, page))
    return tmp_path


def truth_page(lines, truths) -> AttitudeRows:
    times = [parse_utc(line["time"]) for line in lines]
    return rows([each["quaternion"] for each in truths], times)


def replayed(files, *options, run="here"):
    database = f"sqlite:///{files / 'a.db'}"
    where = ["--in-process", "--database", database, "--run", run, "--json"]
    out = files / f"{run}.ndjson"
    code = main(
        ["replay", str(files / "pass.ndjson"), *where, "--results", str(out), *map(str, options)]
    )
    return code, list(read_objects(out)) if out.exists() else []


@pytest.mark.parametrize("name", ["truth.aem", "truth.xml", "truth.zip"])
def test_the_attitude_of_a_file_is_the_prior_of_each_batch(files, passing, name, capsys):
    code, answers = replayed(files, "--a-priori", files / name)
    assert code == 0
    assert json.loads(capsys.readouterr().out)["a_priori_from_file"] == N
    # Without any prior the whole sky was searched.
    assert {each["path"] for each in answers} == {"zone"}
    app = open_app(Settings(database=f"sqlite:///{files / 'a.db'}"))
    try:
        stored = [app.results.get(each["id"]).input for each in answers]
    finally:
        app.close()
    for one, truth in zip(stored, passing[1], strict=True):
        prior = matrix_from_quaternion(one["a_priori"]["quaternion"])
        error = attitude_error_arcsec(prior, matrix_from_quaternion(truth["quaternion"]))
        assert np.linalg.norm(error) < 1e-3


def test_batches_outside_the_file_keep_their_own_prior(files, passing, capsys):
    lines, truths = passing
    (files / "half.aem").write_bytes(written("aem", truth_page(lines[:5], truths[:5])))
    code, answers = replayed(files, "--a-priori", files / "half.aem")
    assert code == 0
    assert json.loads(capsys.readouterr().out)["a_priori_from_file"] == 5
    assert [each["path"] for each in answers] == ["zone"] * 5 + ["lost_in_space"] * (N - 5)


def test_the_prior_is_sent_over_http_too(files, capsys):
    app = open_app(Settings(database=f"sqlite:///{files / 'b.db'}"))
    with Server(create_app(app)) as address:
        told = ["--url", address, "--json", "--a-priori", str(files / "truth.aem")]
        assert main(["replay", str(files / "pass.ndjson"), *told]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts["a_priori_from_file"] == counts["attitudes"] == N


def test_a_file_that_is_no_attitude_and_one_for_two_spacecraft_are_refused(files, passing, capsys):
    (files / "cut.aem").write_bytes((files / "truth.aem").read_bytes()[:-200])
    assert replayed(files, "--a-priori", files / "cut.aem") == (2, [])
    assert "cut.aem, line " in capsys.readouterr().err
    lines = [*passing[0][:2], {**passing[0][2], "spacecraft": "SWAS"}]
    (files / "pass.ndjson").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    assert replayed(files, "--a-priori", files / "truth.aem")[0] == 2
    assert "the batches are of XTE and others (got 'SWAS')" in capsys.readouterr().err


@pytest.fixture
def scored(files, capsys):
    assert replayed(files)[0] == 0
    capsys.readouterr()

    def score(name, *options):
        where = ["--database", f"sqlite:///{files / 'a.db'}", "--run", "here"]
        told = ["score", str(files / name), "--spacecraft", "XTE", *where, *map(str, options)]
        return main(told), capsys.readouterr()

    return score


def test_a_replay_is_scored_against_its_truth(scored, files):
    found = {}
    for name in ("truth.aem", "truth.xml", "truth.zip"):
        code, told = scored(name, "--json", "--plot", files / "errors.svg", "--status", "all")
        assert code == 0
        found[name] = json.loads(told.out)
    # What `simulate telemetry` wrote is read as it stands.
    code, told = scored("pass.truth.ndjson", "--json", "--status", "all")
    assert code == 0
    assert json.loads(told.out)["axes"]["x"] == pytest.approx(found["truth.aem"]["axes"]["x"])
    assert found["truth.aem"]["attitudes"] == N
    for axis in "xyz":
        for name in ("truth.xml", "truth.zip"):
            one, other = (found[each]["axes"][axis]["rms_arcsec"] for each in ("truth.aem", name))
            assert one == pytest.approx(other, abs=1e-3)
    assert 0.0 < found["truth.aem"]["total"]["rms_arcsec"] < 60.0
    ET.parse(files / "errors.svg")


def test_predicted_attitudes_of_an_acm_are_no_truth(scored, files, passing):
    page = truth_page(*passing)
    text = written("acm", page).decode()
    assert text.count("ATT_START\n") == 1
    (files / "p.acm").write_text(text.replace("ATT_START\n", "ATT_START\nATT_BASIS = predicted\n"))
    code, told = scored("p.acm")
    assert code == 2
    assert "must be of attitudes with ATT_BASIS DETERMINED_GND" in told.err
    determined = text.replace("ATT_START\n", "ATT_START\nATT_BASIS = DETERMINED_OBC\n")
    (files / "d.acm").write_text(determined)
    assert scored("d.acm", "--json")[0] == 0
    assert replayed(files, "--a-priori", files / "p.acm", run="predicted")[0] == 0


def test_a_score_is_a_table_for_people(scored):
    code, told = scored("truth.aem")
    assert code == 0
    for words in ("12 attitudes; 0 outside the truth", "about x", "predicted rms", "normalized"):
        assert words in told.out


def test_a_truth_of_another_time_is_refused(scored, files, passing):
    lines = [{**each, "time": each["time"].replace("1999", "1998")} for each in passing[0]]
    (files / "later.aem").write_bytes(written("aem", truth_page(lines, passing[1])))
    code, told = scored("later.aem", "--plot", files / "errors.svg")
    assert code == 2
    assert "no attitude for the time of any of 12 good attitudes of XTE in run here" in told.err
    assert not (files / "errors.svg").exists()

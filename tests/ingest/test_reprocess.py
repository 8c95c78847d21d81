"""Reprocessing: every batch once, with the settings asked for, however often it is begun."""

import json

import numpy as np
import pytest
from msgspec.structs import asdict
from sqlalchemy import func, select

from service.errors import BadBatch, NotFound
from service.missions.mission import Mission
from service.observations.schema import OptionsIn, submission_from_json
from service.simulate.stretches import Pass, Trouble, Troubles
from service.simulate.telemetry import draw_pass
from service.sky.catalog.star_catalog import save
from service.storage.sql.tables import batches, results
from service.times import parse_utc
from service.vectors import attitude_error_arcsec, matrix_from_quaternion
from tests.storage.samples import without_accidents

BATCHES, CHUNK = 46, 20
"""More than two transactions' worth, of the size that they have here."""


@pytest.fixture(autouse=True)
def _short_transactions(monkeypatch):
    monkeypatch.setattr("service.ingest.reprocess.CHUNK", CHUNK)


@pytest.fixture(scope="module")
def noisy(missions, sky):
    """A pass of XTE, drawn once.

    It has so much noise that votes lose many stars; the attitudes are good a priori.
    """
    troubles = Troubles(Trouble(), Trouble(), Trouble(), Trouble(1.0, 12.0))
    wanted = Pass(BATCHES, 1, stars=4, troubles=troubles)
    return [each.batch for each in draw_pass(missions["XTE"], sky, wanted)]


def record(app, bodies):
    for first in range(0, len(bodies), 100):
        part = [submission_from_json(json.dumps(b)) for b in bodies[first : first + 100]]
        assert all(not isinstance(each, Exception) for each in app.submissions.submit_many(part))


def by_votes(missions, **tolerances):
    """XTE, identified by votes with other tolerances."""
    settings = missions["XTE"].model_dump()
    settings["identifier"] = "starid"
    settings["tolerances"].update(tolerances)
    return Mission.model_validate(settings)


def wider(missions):
    return by_votes(missions, separation_deg=0.016)


def answers_of(app, run):
    with app.store.reading() as connection:
        query = (
            select(batches.c.batch, results.c.answer)
            .join_from(results, batches, results.c.batch_id == batches.c.id)
            .where(results.c.run == run, results.c.current)
        )
        return {name: json.loads(answer) for name, answer in connection.execute(query)}


@pytest.fixture
def recorded(app, noisy):
    record(app, noisy)
    return noisy


@pytest.mark.both_databases
def test_with_the_same_settings_everything_comes_out_alike(app, recorded):
    progress = app.runs.reprocess("again", processes=1)
    compared = app.runs.compare("live", "again")
    assert (progress.total, progress.before, progress.recorded, progress.refused) == (
        BATCHES,
        0,
        BATCHES,
        0,
    )
    before, after = answers_of(app, "live"), answers_of(app, "again")
    assert before.keys() == after.keys()
    for name in before:
        one, other = without_accidents(before[name]), without_accidents(after[name])
        assert (one.pop("run"), other.pop("run")) == ("live", "again")
        assert one == other
    assert compared.batches == BATCHES
    assert all(each.before == each.after for each in compared.stars.transitions)
    assert compared.attitudes.angle_arcsec.max == 0.0


def test_live_results_and_rates_stay_as_they_are(app, recorded):
    before = app.results.page(limit=500).items, app.spacecraft.rates("XTE", bucket="day")
    app.runs.reprocess("again", processes=1)
    assert (app.results.page(limit=500).items, app.spacecraft.rates("XTE", bucket="day")) == before


def test_another_mission_file_decides_and_the_comparison_counts_star_by_star(
    opened, missions, noisy
):
    """Held against both answers of each batch."""
    first = opened(mission=by_votes(missions))
    record(first, noisy)
    first.close()
    app = opened(mission=wider(missions))
    app.runs.reprocess("wider", processes=1)
    compared = app.runs.compare("live", "wider")
    before, after = answers_of(app, "live"), answers_of(app, "wider")
    assert {each["provenance"]["mission"] for each in after.values()} == {wider(missions).digest}
    stars = {"unique": 0, "ambiguous": 0, "unmatched": 0}
    otherwise = lost = 0
    angles = []
    for name, new in after.items():
        old = before[name]
        for one, other in zip(
            old["observations"][0]["stars"], new["observations"][0]["stars"], strict=True
        ):
            stars[other["outcome"]] += 1
            both = (one["outcome"], other["outcome"])
            otherwise += both == ("unique", "unique") and one["star"] != other["star"]
            lost += both == ("ambiguous", "unique")
        if old["attitude"] and new["attitude"]:
            matrices = [
                matrix_from_quaternion(each["attitude"]["quaternion"]) for each in (old, new)
            ]
            angles.append(np.linalg.norm(attitude_error_arcsec(*matrices)))
    transitions = compared.stars.transitions

    def counted(*what):
        keys = ("before", "after", "same_star")
        return sum(
            each.stars for each in transitions if tuple(getattr(each, key) for key in keys) == what
        )

    assert asdict(compared.stars.after) == stars
    assert counted("unique", "unique", False) == otherwise
    assert counted("ambiguous", "unique", False) == lost > 0
    assert compared.attitudes.in_both == len(angles)
    found = compared.attitudes.angle_arcsec
    assert found.max == pytest.approx(max(angles), abs=1e-6)
    assert found.p95 == pytest.approx(np.quantile(angles, 0.95), abs=1e-6)


class _Stopped(Exception):
    pass


def test_what_was_stopped_goes_on_where_it_was(app, recorded):
    """After each transaction in turn; nothing is there twice and nothing is missing."""
    seen = []

    def stop_after_one(progress):
        seen.append(progress.before + progress.recorded)
        if progress.recorded:
            raise _Stopped

    for _ in range(2):
        with pytest.raises(_Stopped):
            app.runs.reprocess("again", processes=1, step=stop_after_one)
    progress = app.runs.reprocess("again", processes=1)
    compared = app.runs.compare("live", "again")
    assert seen == [0, CHUNK, CHUNK, 2 * CHUNK]
    assert (progress.before, progress.recorded) == (2 * CHUNK, BATCHES - 2 * CHUNK)
    assert compared.batches == len(answers_of(app, "again")) == BATCHES
    progress = app.runs.reprocess("again", processes=1)
    assert (progress.before, progress.recorded) == (BATCHES, 0)


def test_many_workers_record_what_one_does(app, recorded):
    """On one database: the workers never see it."""
    if app.store.url.drivername != "sqlite":
        pytest.skip("as on SQLite")
    app.runs.reprocess("one", processes=1)
    app.runs.reprocess("many", processes=2)
    one, many = answers_of(app, "one"), answers_of(app, "many")
    assert one.keys() == many.keys()
    for name in one:
        plain, spread = without_accidents(one[name]), without_accidents(many[name])
        del plain["run"], spread["run"]
        assert plain == spread


def test_only_the_stretch_and_the_spacecraft_that_were_asked_for(app, noisy, make):
    xte = noisy[:12]
    soho = [make(f"soho-{k}", spacecraft="SOHO", after_s=60.0 * k).text for k in range(3)]
    record(app, [*xte, *map(json.loads, soho)])
    start, end = parse_utc(xte[3]["time"]), parse_utc(xte[7]["time"])
    app.runs.reprocess("part", spacecraft="XTE", start=start, end=end, processes=1)
    assert sorted(answers_of(app, "part")) == [body["batch"] for body in xte[3:7]]
    app.runs.reprocess("all", processes=1)
    assert len(answers_of(app, "all")) == 15


def test_an_adopted_what_if_is_run_again_with_its_own_options(app, make):
    first = app.submissions.submit(make(kind="suspect"))
    tight = {"identifier": "starid", "tolerances": {"separation_deg": 1e-5}}
    options = OptionsIn.model_validate(tight)
    adopted = json.loads(app.results.what_if(first.id, options, adopt=True).body)
    app.runs.reprocess("again", processes=1)
    (answer,) = answers_of(app, "again").values()
    assert answer["counts"] == adopted["counts"]
    assert answer["counts"]["unmatched"] == 1


def test_a_run_of_other_settings_is_not_mixed_with_these(opened, missions, make):
    first = opened()
    first.submissions.submit(make())
    first.runs.reprocess("again", processes=1)
    with pytest.raises(BadBatch, match="must be another run"):
        first.runs.reprocess("live", processes=1)
    with pytest.raises(NotFound):
        first.runs.reprocess("again", spacecraft="NOPE")
    first.close()
    with pytest.raises(BadBatch, match="run: holds results of XTE with another mission"):
        opened(mission=wider(missions)).runs.reprocess("again", processes=1)


def test_a_run_of_another_catalog_is_not_mixed_with_this_one(opened, sky, tmp_path, make):
    """Also where the missions' settings are the same."""
    first = opened()
    first.submissions.submit(make())
    first.runs.reprocess("again", processes=1)
    first.close()
    file = tmp_path / "other.npz"
    save(sky.catalog, file)
    other = opened(catalog=file)
    assert other.sky.catalog.digest != first.sky.catalog.digest
    with pytest.raises(BadBatch, match="run: holds results of XTE with another catalog"):
        other.runs.reprocess("again", processes=1)
    assert len(answers_of(other, "again")) == 1


def test_a_run_without_a_name_is_named_after_the_settings(opened, missions, make):
    """The same settings find it again, others do not."""
    first = opened()
    first.submissions.submit(make())
    names = [first.runs.reprocess(None, processes=1).run for _ in range(2)]
    first.close()
    other = opened(mission=wider(missions))
    names.append(other.runs.reprocess(None, processes=1).run)
    assert names[0] == names[1] != names[2]
    assert len(answers_of(other, names[0])) == 1


def test_a_batch_that_no_longer_fits_is_refused_by_name_and_the_rest_goes_on(
    opened, missions, make
):
    first = opened()
    for name in ("b1", "b2"):
        first.submissions.submit(make(name))
    first.close()
    settings = missions["XTE"].model_dump()
    settings["trackers"][0]["name"] = "OTHER"
    renamed = opened(mission=Mission.model_validate(settings))
    progress = renamed.runs.reprocess("again", processes=1)
    compared = renamed.runs.compare("live", "again")
    assert (progress.recorded, progress.refused) == (0, 2)
    assert progress.refusals[0].startswith("b1: observations.0.tracker: XTE has OTHER")
    assert compared.batches == 0
    with renamed.store.reading() as connection:
        assert connection.scalar(select(func.count()).select_from(batches)) == 2

"""Grades in the records: revisions, faults that are named, pruning, and the command."""

import json
from dataclasses import replace

import pytest
from sqlalchemy import func, select, update

from service.attitude.definitive import packed, unpacked
from service.cli import main
from service.errors import NotFound
from service.features.archive.archiving import PartFilter, archive, restore
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.part import Definitive
from service.storage.sql.definitive_tables import graded_blocks, graded_days
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import parse_utc
from tests.features.definitive.passes import NOON_NS, later
from tests.features.definitive.records import put_attitudes, put_pass
from tests.missions.without_gyro import text_without_gyro

DAY_NS = 86_400 * 10**9


def blocks_of(app, id):
    query = select(graded_blocks).where(graded_blocks.c.day_id == id)
    with app.context.reading() as connection:
        return [dict(row) for row in connection.execute(query).mappings()]


def faults(database):
    """What is wrong with the grades; the batches of these tests have no stars."""
    return [each for each in verify(database) if each.startswith("definitive day")]


def rows(app, table):
    with app.context.reading() as connection:
        return connection.scalar(select(func.count()).select_from(table))


def some(attitudes, places):
    return AttitudeMeasurements(
        attitudes.tai_ns[places], attitudes.quaternion[places], attitudes.covariance_rad2[places]
    )


@pytest.fixture
def filled(app, half_hour):
    """The half hour without its last ten batches."""
    recorded = half_hour[1]
    put_pass(app, replace(recorded, attitudes=some(recorded.attitudes, slice(0, -10))))
    return app


def test_a_second_run_over_the_same_record_changes_nothing(filled, opened, database):
    first = filled.part(Definitive).days.smooth("XTE")
    (day,) = first.days
    assert (day.day, day.revision, first.new) == ("1999-03-01", 1, {day.id})
    assert day.summary.measurements["accepted"] == 215
    kept = blocks_of(filled, day.id)
    assert {each["grade"] for each in kept} == {"filtered", "smoothed", "innovations"}
    # Another service, another period.
    filled.close()
    reopened = opened()
    again = reopened.part(Definitive).days.smooth("XTE", start=parse_utc("1999-03-01T12:20:00Z"))
    assert (again.days, again.new) == ([day], set())
    assert blocks_of(reopened, day.id) == kept
    assert faults(database) == []


def test_the_same_record_gives_the_same_bytes(filled, opened):
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    kept = {(each["grade"], each["position"]): each["packed"] for each in blocks_of(filled, day.id)}
    # Forgotten and computed again by another service.
    prune(filled.store, parse_utc("1999-02-01T00:00:00Z"))
    change = update(graded_days).values(inputs="sha256:" + "0" * 64)
    filled.context.change(lambda connection: connection.execute(change))
    filled.close()
    reopened = opened()
    (again,) = reopened.part(Definitive).days.smooth("XTE").days
    assert again.revision == 2
    assert again.digest == day.digest
    new = blocks_of(reopened, again.id)
    assert {(each["grade"], each["position"]): each["packed"] for each in new} == kept


def test_a_day_whose_batches_are_archived_stays_as_it_is(filled, half_hour, tmp_path):
    attitudes = some(half_hour[1].attitudes, slice(-10, None))
    put_attitudes(filled, replace(attitudes, tai_ns=attitudes.tai_ns + DAY_NS // 8), name="later")
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    archive(filled.store, tmp_path, parse_utc("1999-03-01T13:00:00Z"))
    again = filled.part(Definitive).days.smooth("XTE")
    assert (again.archived, again.days, again.done) == (1, [], again.total)
    assert rows(filled, graded_days) == 1
    assert blocks_of(filled, day.id) != []
    restore(filled.store, tmp_path, PartFilter())
    assert filled.part(Definitive).days.smooth("XTE").days == [day]


def test_late_batches_make_a_new_revision(filled, half_hour, database):
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    put_attitudes(filled, some(half_hour[1].attitudes, slice(-10, None)), name="late")
    later_on = filled.part(Definitive).days.smooth("XTE")
    (new,) = later_on.days
    assert (new.revision, later_on.new) == (2, {new.id})
    assert new.summary.measurements["accepted"] == 225
    # The revision before is still told of, without its samples.
    assert rows(filled, graded_days) == 2
    assert blocks_of(filled, day.id) == []
    assert faults(database) == []


def test_suspect_attitudes_are_no_measurements(filled, half_hour):
    late = some(half_hour[1].attitudes, slice(-10, None))
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    put_attitudes(filled, late, name="late", status="suspect")
    assert filled.part(Definitive).days.smooth("XTE").days == [day]


def test_other_settings_of_the_gyro_make_a_new_revision(filled, opened):
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    noisier = {"sigma_v_rad_s0_5": 1e-6, "sigma_u_rad_s1_5": 1e-9}
    filled.close()
    (new,) = opened(gyro=noisier).part(Definitive).days.smooth("XTE").days
    assert new.revision == 2
    assert new.digest != day.digest


def test_runs_and_days_stand_by_themselves(app, half_hour):
    recorded = half_hour[1]
    put_pass(app, recorded)
    put_pass(app, recorded, run="pass-7")
    put_pass(app, later(recorded, 3 * DAY_NS))
    period = {"start": parse_utc("1999-03-04T00:00:00Z"), "end": parse_utc("1999-03-05T00:00:00Z")}
    assert [each.day for each in app.part(Definitive).days.smooth("XTE", **period).days] == [
        "1999-03-04"
    ]
    found = app.part(Definitive).days.smooth("XTE")
    assert [each.day for each in found.days] == ["1999-03-01", "1999-03-04"]
    assert found.new == {found.days[0].id}
    assert [each.run for each in app.part(Definitive).days.smooth("XTE", run="pass-7").days] == [
        "pass-7"
    ]


def test_a_period_without_batches_is_named(filled):
    with pytest.raises(NotFound, match="XTE has no batch in run live in the period"):
        filled.part(Definitive).days.smooth("XTE", start=parse_utc("1999-03-02T00:00:00Z"))


def test_a_day_without_attitudes_is_counted(app, half_hour):
    put_attitudes(app, some(half_hour[1].attitudes, slice(0, 2)))
    found = app.part(Definitive).days.smooth("XTE")
    assert (found.total, found.empty, found.days) == (1, 1, [])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"packed": b"no"}, "its samples cannot be read"),
        ({"samples": 99}, "its samples cannot be read"),
        ({"end_ns": NOON_NS}, "its times are not those of its samples"),
        ({"position": 7}, None),
    ],
)
def test_damage_to_a_block_is_named(filled, database, change, told):
    filled.part(Definitive).days.smooth("XTE")
    statement = update(graded_blocks).where(graded_blocks.c.grade == "filtered").values(**change)
    filled.context.change(lambda connection: connection.execute(statement))
    problems = faults(database)
    if told is None:
        assert problems == []
    else:
        assert any(told in each for each in problems), problems


def test_other_samples_than_those_digested_are_named(filled, database):
    (day,) = filled.part(Definitive).days.smooth("XTE").days
    block = blocks_of(filled, day.id)[0]
    found = unpacked(block["packed"], block["samples"])
    bent = packed(replace(found, quaternion=-found.quaternion))
    c = graded_blocks.c
    chosen = c.grade == block["grade"], c.position == block["position"]
    statement = update(graded_blocks).where(*chosen).values(packed=bent)
    filled.context.change(lambda connection: connection.execute(statement))
    assert any("not those that were digested" in each for each in faults(database))
    statement = update(graded_days).values(samples=1)
    filled.context.change(lambda connection: connection.execute(statement))
    assert any("not as many samples as it says" in each for each in faults(database))


def test_samples_of_an_earlier_revision_are_named(filled, database):
    filled.part(Definitive).days.smooth("XTE")
    statement = update(graded_days).values(current=False)
    filled.context.change(lambda connection: connection.execute(statement))
    assert any("it is not the current revision" in each for each in faults(database))


def test_days_that_end_by_the_time_are_pruned(app, half_hour, database):
    put_pass(app, half_hour[1])
    put_pass(app, later(half_hour[1], DAY_NS))
    app.part(Definitive).days.smooth("XTE")
    before = parse_utc("1999-03-02T00:00:00Z")
    dry = prune(app.store, before, dry_run=True)
    assert (dry.total_graded_days, dry.graded_days) == (1, 0)
    assert prune(app.store, before).graded_days == 1
    assert [each.day for each in app.part(Definitive).days.smooth("XTE").days] == ["1999-03-02"]
    assert faults(database) == []


def test_the_command_smooths_and_tells_what_it_did(filled, database, capsys, tmp_path, monkeypatch):
    """With the gyro of the shipped mission; then with a site's mission, which describes none."""
    filled.close()
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "xte.toml").write_text(text_without_gyro("XTE"), encoding="utf-8")
    asked = ["smooth", "XTE", "--database", database, "--quiet"]
    for revision, model in ((1, "gyro"), (2, "constant_rate")):
        if model == "constant_rate":
            monkeypatch.setenv("ACQUIRE_MISSIONS", str(tmp_path / "site"))
        assert main([*asked, "--json"]) == 0
        (day,) = json.loads(capsys.readouterr().out)["days"]
        assert [each["model"] for each in day["summary"]["stretches"]] == [model]
        assert (day["revision"], day["new"]) == (revision, True)
        assert main(asked) == 0
        told = capsys.readouterr().out
        assert f"1999-03-01 revision {revision} (unchanged)" in told
        assert f": {model.replace('_', ' ')}, " in told


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["smooth", "NONE"], 2, "NONE"),
        (["smooth", "XTE", "--start", "noon"], 2, "--start"),
        (["smooth", "XTE", "--run", "none"], 2, "XTE has no batch in run none"),
    ],
)
def test_the_command_refuses_what_there_is_not(filled, database, capsys, words, code, said):
    filled.close()
    assert main([*words, "--database", database]) == code
    assert said in capsys.readouterr().err

"""Gyro blocks in the records: verified, pruned, copied, exported; and what two services do."""

import threading

import pytest
from sqlalchemy import update

from service.app.factory import open_app
from service.errors import AcquisitionError
from service.gyro.blocks import GyroBlockIn, block_from_model, pack
from service.settings import Settings
from service.storage.sql.tables import gyro_blocks
from service.storage.upkeep.backup import back_up
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import parse_utc, shifted
from tests.gyro.blocks import START, body


def later(seconds):
    return shifted(parse_utc(START), seconds).text


def block(*names, **told):
    return block_from_model(GyroBlockIn.model_validate(body(*names, **told)), "XTE")


@pytest.fixture
def filled(app, rng):
    """Six blocks of ten seconds, of two runs."""
    for run in ("live", "pass-7"):
        for k in range(3):
            app.gyro.record(block(f"g{k}", run=run, start=later(10.0 * k), samples=100, rng=rng))
    return app


def names(app, run="live"):
    return [each.block for each in app.gyro.page("XTE", run=run).items]


@pytest.mark.parametrize("year", [1972, 1999, 2032, 2098])
def test_pages_of_blocks_go_on_in_any_year(app, year):
    starts = [f"{year}-03-01T00:00:{k:02d}.000Z" for k in range(3)]
    for start in starts:
        app.gyro.record(block(start, start=start))
    found, cursor = [], None
    while not found or cursor is not None:
        page = app.gyro.page("XTE", limit=1, cursor=cursor)
        found += [each.start for each in page.items]
        cursor = page.next_cursor
    assert found == starts


def test_of_sound_blocks_nothing_is_wrong(filled, database):
    assert verify(database) == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"rates_rad_per_s": b"no"}, "its samples cannot be read"),
        ({"samples": 99}, "its samples cannot be read"),
        ({"rates_rad_per_s": pack(block(samples=100).rates_rad_per_s)}, "not those that were"),
        ({"step_s": 0.05}, "its times are not those of its samples"),
        ({"step_s": 0.2, "end": later(19.8), "end_ns": None}, "shares a time with gyro block"),
        ({"end": later(9.8)}, "its times are not those of its samples"),
    ],
)
def test_damage_to_a_block_is_named(filled, database, change, told):
    (first, *_) = filled.gyro.page("XTE").items
    if "end_ns" in change:
        change = change | {"end_ns": parse_utc(change["end"]).tai_ns}
    statement = update(gyro_blocks).where(gyro_blocks.c.id == first.id).values(**change)
    filled.context.change(lambda connection: connection.execute(statement))
    problems = verify(database)
    assert any(told in each for each in problems), problems


def test_blocks_that_end_before_the_time_are_pruned(filled, database):
    before = parse_utc(later(19.9))
    dry = prune(filled.store, before, dry_run=True)
    assert (dry.total_gyro_blocks, dry.gyro_blocks) == (2, 0)
    assert len(names(filled)) == 3
    assert prune(filled.store, before).gyro_blocks == 2
    assert names(filled) == names(filled, "pass-7") == ["g1", "g2"]
    assert prune(filled.store, parse_utc(later(20.0)), "pass-7").gyro_blocks == 1
    assert (names(filled), names(filled, "pass-7")) == (["g1", "g2"], ["g2"])
    assert verify(database) == []


def test_a_pruned_block_may_be_sent_again(filled):
    prune(filled.store, parse_utc(later(15.0)))
    assert not filled.gyro.record(block("g0", samples=100)).replayed


def test_a_backup_holds_the_blocks(rng, tmp_path):
    """Of SQLite: of PostgreSQL its own tool copies every table."""
    here, copy = f"sqlite:///{tmp_path / 'acquire.db'}", tmp_path / "copy.db"
    apps = [open_app(Settings(database=here, replay_processes=0))]
    try:
        recorded = apps[0].gyro.record(block(samples=100, rng=rng)).row
        back_up(here, copy)
        assert verify(f"sqlite:///{copy}") == []
        apps.append(open_app(Settings(database=f"sqlite:///{copy}", replay_processes=0)))
        one, other = (app.gyro.get("XTE", recorded.id) for app in apps)
        assert one == other
    finally:
        for app in apps:
            app.close()


def test_an_export_writes_the_samples(acquire, opened, database):
    app = opened()
    app.gyro.record(block(samples=3))
    code, out, _ = acquire("export", "gyro", "--spacecraft", "XTE", "--database", database)
    assert code == 0
    assert out.splitlines()[1].startswith("1999-03-01T00:00:00.000Z,")
    assert len(out.splitlines()) == 4


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_services_record_no_time_twice(opened, rng):
    """Both send blocks that may share a time at the same moment: each time is recorded once."""
    apps = [opened(), opened()]
    outcomes = [[], []]
    barrier = threading.Barrier(2)
    blocks = [
        [block(f"{who}-{k}", start=later(k + 0.1 * who), samples=10) for k in range(15)]
        for who in (0, 1)
    ]

    def send(who):
        for each in blocks[who]:
            barrier.wait()
            try:
                apps[who].gyro.record(each)
                outcomes[who].append(True)
            except AcquisitionError:
                outcomes[who].append(False)

    threads = [threading.Thread(target=send, args=(who,)) for who in (0, 1)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    recorded = names(apps[0])
    held = [
        ns
        for who in (0, 1)
        for each, taken in zip(blocks[who], outcomes[who], strict=True)
        for ns in each.tai_ns.tolist()
        if taken
    ]
    assert len(recorded) == sum(map(sum, outcomes))
    assert len(set(held)) == len(held)
    assert sum(map(sum, outcomes)) >= 8

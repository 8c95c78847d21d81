"""Holds a database against what was acknowledged: nothing lost, nothing torn, nothing doubled."""

import hashlib

from sqlalchemy import func, select

from service.storage.projections.heads import last_head
from service.storage.sql.chain_tables import record_leaves
from service.storage.sql.engines import reading_engine
from service.storage.sql.tables import batches, results, solutions, star_results
from service.storage.upkeep.verify_chain import faults_of_the_chain
from tests.storage.recount import assert_equal_to_a_recount


def assert_chain_is_whole(app):
    """Every result has its leaf, every head its leaves, and the last head has all."""
    app.store.progress.catch_up()
    app.projector.make_heads()
    with app.store.reading() as connection:
        newest = connection.scalar(select(func.max(results.c.seq)))
        assert connection.scalar(select(func.max(record_leaves.c.seq))) == newest
        assert last_head(connection).last == (newest or 0)
    engine = reading_engine(app.store.url)
    try:
        assert list(faults_of_the_chain(engine)) == []
    finally:
        engine.dispose()


def assert_whole(app, acknowledged):
    assert_chain_is_whole(app)
    with app.store.reading() as connection:
        stored = {
            id: hashlib.sha256(answer.encode()).hexdigest()
            for id, answer in connection.execute(select(results.c.id, results.c.answer))
        }
        assert acknowledged.items() <= stored.items()
        assert connection.scalar(select(func.count()).select_from(batches)) == len(stored)
        stars = dict(
            connection.execute(
                select(star_results.c.result_id, func.count()).group_by(star_results.c.result_id)
            ).all()
        )
        solved = set(connection.scalars(select(solutions.c.result_id)))
        for row in connection.execute(select(results)).mappings():
            assert stars[row["id"]] == row["observed"]
            assert (row["id"] in solved) == (row["status"] is not None)
        assert_equal_to_a_recount(connection)
        if connection.dialect.name == "sqlite":
            assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"
            assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []

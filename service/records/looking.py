"""Looking closer at one result: its batch as the core sees it, and what is next to it in time."""

import msgspec
from sqlalchemy import Connection, select

from service.missions.mission import Mission
from service.observe.batch import ObservationBatch
from service.observe.wire import OptionsIn, submission_from_json
from service.records.draft import Row
from service.records.pages import Stretch, newest_first, oldest_first
from service.records.reading import one_result, summaries, summary_of
from service.records.tables import missions, results


def recorded_batch(connection: Connection, id: str) -> tuple[ObservationBatch, Row]:
    """The batch that a result was made of, with the result's own options, and the answer."""
    row = one_result(connection, id)
    options = OptionsIn.model_validate_json(row["options"]).to_options()
    batch = submission_from_json(row["input"]).batch
    return msgspec.structs.replace(batch, options=options), msgspec.json.decode(row["answer"])


def recorded_mission(connection: Connection, digest: str) -> Mission:
    """A mission as its settings were when their digest was recorded."""
    query = select(missions.c.settings).where(missions.c.digest == digest)
    return Mission.model_validate_json(connection.execute(query).scalar_one())


def neighbours(connection: Connection, id: str) -> Row:
    """The results next to one in time, of its spacecraft and run: `earlier`, `later`, or None.

    `current` is the id of the result that stands for its batch.
    """
    here = connection.execute(select(results).where(results.c.id == id)).one()
    standing = select(results.c.id).where(results.c.batch_id == here.batch_id, results.c.current)
    same = Stretch(here.run, here.spacecraft).conditions()
    earlier = newest_first(summaries().where(*same, results.c.time_ns < here.time_ns))
    later = oldest_first(summaries().where(*same, results.c.time_ns > here.time_ns))
    found: Row = {"current": connection.execute(standing).scalar()}
    for name, asked in (("earlier", earlier), ("later", later)):
        row = connection.execute(asked.limit(1)).mappings().first()
        found[name] = None if row is None else summary_of(row)
    return found

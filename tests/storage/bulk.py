"""Many results at once, through the writer's own statements, without their stars."""

from service.storage.projections import rollups
from service.storage.recording.ids import Ulids
from service.storage.sql.statements import insert_all, insert_runs
from service.storage.sql.tables import MEASURED, batches, results
from service.times import HOUR_S, parse_utc


def result_row(app, time, *, spacecraft="XTE", run="live", name="b", **values):
    """A batch and its result of that time; `values` take the place of an undistinguished one's."""
    mission = app.missions[spacecraft]
    id = Ulids().new()
    batch = {
        "id": id,
        "spacecraft": spacecraft,
        "run": run,
        "batch": f"{name}-{id}",
        "time": time.text,
        "time_ns": time.tai_ns,
        "received": time.text,
        "fingerprint": "0" * 64,
        "input": "{}",
    }
    result = {
        "id": id,
        "batch_id": id,
        "parent_id": None,
        "current": True,
        "seq": 0,
        "digest": None,
        "created": time.text,
        "spacecraft": spacecraft,
        "run": run,
        "time_ns": time.tai_ns,
        "identifier": "starid",
        "options": "{}",
        "mission_digest": mission.digest,
        "catalog_digest": app.sky.catalog.digest,
        "observed": 5,
        "unique": 5 - values.get("ambiguous", 0) - values.get("unmatched", 0),
        "ambiguous": 0,
        "unmatched": 0,
        "status": "good",
        "reason": None,
        **dict.fromkeys(MEASURED),
        "residual_rms_arcsec": 2.0,
        "predicted_rms_arcsec": 2.0,
        "magnitude_offset_mag": 0.0,
        "a_priori_angle_deg": 1.0,
        "scale_offset_ppm": 0.0,
        "answer": "{}",
    } | values
    return batch, result


def put(app, rows):
    """Record the rows as if they were projected already: their part in the trends included."""

    def write(connection):
        names = {batch["run"]: batch["received"] for batch, _ in rows}
        insert_runs(connection, names)
        insert_all(connection, batches, [batch for batch, _ in rows])
        insert_all(connection, results, [result for _, result in rows])
        rollups.add(connection, [(_hour(batch), result) for batch, result in rows])

    app.store.writer.change(write)


def _hour(batch):
    return batch["spacecraft"], batch["run"], parse_utc(batch["time"]).bucket(HOUR_S)

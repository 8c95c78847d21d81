"""What a person with access to the database changes is found and named, also after a repair."""

from contextlib import contextmanager, nullcontext

import pytest
from sqlalchemy import text

from service.storage.recording.signing import PublicKey
from service.storage.upkeep.verify import faults_in
from service.storage.upkeep.verify_chain import faults_of_the_chain
from tests.storage.sealed import chain_anew, changing, digest_anew, heads_of, leaves_anew, rows_in

pytestmark = pytest.mark.both_databases

_FIRST = "(SELECT min(id) FROM results WHERE status = 'good')"
_WHAT_IF = "(SELECT max(id) FROM results WHERE parent_id IS NOT NULL)"
_OF_IMAGER = "(SELECT id FROM results WHERE spacecraft = 'IMAGER')"
_HAS_CURRENT = "batch_id IN (SELECT batch_id FROM results WHERE current)"
_REMOVE = [f"DELETE FROM {name} WHERE result_id = {{0}}" for name in ("star_results", "solutions")]

CHANGES = {
    # ---- results and batches
    "a digest that is missing": "UPDATE results SET digest = NULL WHERE status = 'good'",
    "a place that is missing": "UPDATE results SET seq = 0, digest = NULL WHERE status = 'suspect'",
    "an answer": "UPDATE results SET reason = 'x' WHERE status IS NULL",
    "the options": "UPDATE results SET options = '{}'",
    "the identifier": "UPDATE results SET identifier = 'x'",
    "a mean residual": "UPDATE results SET residual_rms_arcsec = residual_rms_arcsec + 1e-9",
    "the settings of a result": "UPDATE results SET mission_digest = 'sha256:0'",
    "the catalog of a result": "UPDATE results SET catalog_digest = 'sha256:0'",
    "the time of computing": "UPDATE results SET created = '2001-01-01T00:00:00.000Z'",
    "the origin of a what-if": "UPDATE results SET parent_id = NULL WHERE parent_id IS NOT NULL",
    "the current result": (
        "UPDATE results SET current = NOT current WHERE current AND parent_id IS NOT NULL",
        f"UPDATE results SET current = NOT current WHERE id = batch_id AND NOT {_HAS_CURRENT}",
    ),
    "an attitude": "UPDATE solutions SET q1 = q1 + 1e-9",
    "a covariance": "UPDATE solutions SET p11 = p11 * 1.000000000001",
    "the frame of an attitude": "UPDATE solutions SET frame = 'x'",
    "the noise of an attitude": "UPDATE solutions SET predicted_rms_arcsec = 1",
    "the method of an attitude": "UPDATE solutions SET method = 'x'",
    "a star": "UPDATE star_results SET votes = votes + 1",
    "the name of a star": "UPDATE star_results SET star_id = 'HIP 1' WHERE star_id IS NOT NULL",
    "a probability": "UPDATE star_results SET probability = 1 WHERE probability < 1",
    "a residual": "UPDATE star_results SET residual_arcsec = 0 WHERE residual_arcsec > 0",
    "an outcome": "UPDATE star_results SET outcome = 'unmatched' WHERE outcome = 'unique'",
    "the tracker of a star": "UPDATE star_results SET tracker = 'x'",
    "a star that is removed": "DELETE FROM star_results WHERE position = 0",
    "the time of receipt": "UPDATE batches SET received = '2001-01-01T00:00:00Z'",
    "the time of a batch": "UPDATE batches SET time = '2001-01-01T00:00:00.000Z'",
    "the name of a batch": "UPDATE batches SET batch = batch || 'x'",
    "an input": "UPDATE batches SET input = '{}'",
    "a fingerprint": "UPDATE batches SET fingerprint = 'x'",
    "the stars of a frame": "UPDATE frames SET detections = detections || ' '",
    "the summary of a frame": "UPDATE frames SET summary = summary || ' '",
    "the picture of a frame": "UPDATE frames SET preview = :bytes",
    "a frame that is removed": "DELETE FROM frames",
    "an attitude that is removed": f"DELETE FROM solutions WHERE result_id = {_FIRST}",
    "a what-if that is removed": (
        *(each.format(_WHAT_IF) for each in _REMOVE),
        f"DELETE FROM results WHERE id = {_WHAT_IF}",
    ),
    "a spacecraft that is removed": (
        *(each.format(_OF_IMAGER) for each in _REMOVE),
        f"DELETE FROM frames WHERE batch_id = {_OF_IMAGER}",
        "DELETE FROM results WHERE spacecraft = 'IMAGER'",
        *(
            f"DELETE FROM {table} WHERE spacecraft = 'IMAGER'"
            for table in ("batches", "rollups_hourly", "rollups_daily", "seals", "events")
        ),
    ),
    # ---- missions and catalogs
    "a mission": "UPDATE missions SET settings = settings || ' '",
    "a mission and its digest": "UPDATE missions SET spacecraft = 'X', row_digest = NULL",
    "a mission that is removed": "DELETE FROM missions",
    "a use of a mission": "UPDATE mission_uses SET since = '1990-01-01', row_digest = NULL",
    "the digest of a use": "UPDATE mission_uses SET row_digest = NULL",
    "a use that is removed": "DELETE FROM mission_uses",
    "a catalog": "UPDATE catalogs SET name = 'x', row_digest = NULL",
    "the first use of a catalog": "UPDATE catalogs SET first_used = '1990-01-01'",
    "a catalog that is removed": "DELETE FROM catalogs",
    # ---- what people do
    "the audit list": "UPDATE audit SET who = 'B'",
    "the time of an entry": "UPDATE audit SET moment = '1990-01-01'",
    "an entry that is removed": "DELETE FROM audit",
    "a token's scopes": "UPDATE access_tokens SET scopes = 'read operate'",
    "a token's end": "UPDATE access_tokens SET expires = '2100-01-01T00:00:00Z'",
    "a token's spacecraft": "UPDATE access_tokens SET spacecraft = 'XTE'",
    "a token that is valid again": "UPDATE access_tokens SET revoked = NULL",
    "a token that is removed": "DELETE FROM access_tokens",
    "a limit": "UPDATE limits SET settings = '{}'",
    "who set a limit": "UPDATE limits SET who = 'B'",
    "the end of a limit": "UPDATE limits SET until = '1990-01-01' WHERE until IS NOT NULL",
    "a limit that is removed": "DELETE FROM limits",
    "an action on an alarm": "UPDATE alarm_actions SET who = 'B'",
    "an action that is removed": "DELETE FROM alarm_actions",
    "a note": "UPDATE annotations SET text = 'another'",
    "a note that is removed": "DELETE FROM annotations",
    "an address": "UPDATE webhooks SET url = 'https://y.example/'",
    "the events that are sent": "UPDATE webhooks SET kinds = 'gyro'",
    "a webhook that is removed": "DELETE FROM webhooks",
    "a calibration": "UPDATE calibrations SET result = '{{}}'",
    "the end of a calibration": "UPDATE calibrations SET ended = '1990-01-01'",
    "a calibration that is removed": "DELETE FROM calibrations",
    "an adoption": "UPDATE calibration_adoptions SET who = 'B'",
    "what was adopted": "UPDATE calibration_adoptions SET trackers = '[]'",
    "an adoption that is removed": "DELETE FROM calibration_adoptions",
    # ---- gyro blocks and definitive days
    "the rates of a gyro block": "UPDATE gyro_blocks SET rates_rad_per_s = :bytes",
    "the receipt of a gyro block": "UPDATE gyro_blocks SET received = '1990-01-01'",
    "a gyro block that is removed": "DELETE FROM gyro_blocks",
    "the summary of a day": "UPDATE graded_days SET summary = '{}'",
    "the inputs of a day": "UPDATE graded_days SET inputs = 'sha256:0'",
    "the samples of a day": "UPDATE graded_blocks SET packed = :bytes",
    "the samples and the digest of a day": (
        "UPDATE graded_blocks SET packed = :bytes",
        "UPDATE graded_days SET digest = 'sha256:0'",
    ),
    "the rates and the fingerprint of a gyro block": (
        "UPDATE gyro_blocks SET rates_rad_per_s = :bytes, fingerprint = 'x'"
    ),
    "the model of samples": "UPDATE graded_blocks SET model = 'x'",
    "a day that is removed": ("DELETE FROM graded_blocks", "DELETE FROM graded_days"),
    # ---- the chain itself
    "a fact": "UPDATE record_facts SET sha256 = 'x' WHERE kind = 'audit'",
    "a fact that is removed": "DELETE FROM record_facts WHERE kind = 'audit'",
    "a leaf": "UPDATE record_leaves SET leaf = (SELECT leaf FROM record_leaves LIMIT 1)",
    "a leaf that is removed": (
        "DELETE FROM record_leaves WHERE seq = (SELECT min(seq) FROM results)"
    ),
    "a head": "UPDATE record_heads SET statement = replace(statement, 'results', 'audit')",
    "a head that is removed": "DELETE FROM record_heads WHERE number = 1",
    "a signature": "UPDATE record_heads SET signature = NULL",
}
"""What a person does to the tables; each is one statement, or several."""


class Held:
    """Stands for an engine: each of its transactions is the one that is not committed."""

    def __init__(self, connection):
        self.dialect, self._connection = connection.dialect, connection

    def begin(self):
        return nullcontext(self._connection)


@contextmanager
def undone(connection):
    connection.exec_driver_sql("SAVEPOINT change")
    try:
        yield
    finally:
        connection.exec_driver_sql("ROLLBACK TO SAVEPOINT change")


def make(connection, change):
    for each in (change,) if isinstance(change, str) else change:
        parameters = {"bytes": b"x"} if ":bytes" in each else {}
        assert connection.execute(text(each), parameters).rowcount, each


def test_each_change_is_found_and_each_repair_of_it(signed, database, key, figures):
    """By one with access, and by one who knows every algorithm but not the key.

    The latter computes digests and seals anew, then leaves and facts, then all heads.
    """
    public, kept = PublicKey(key[1]), heads_of(database)
    missed = []
    with changing(database) as connection:
        held = Held(connection)
        assert faults_in(held, public_key=public, anchors=kept) == []
        rows = rows_in(connection)

        def found(**given):
            return "\n".join(faults_of_the_chain(held, **given))

        for name, change in CHANGES.items():
            with undone(connection):
                make(connection, change)
                told = faults_in(held, public_key=public)
                by_all = [each for each in told if "sign" not in each]
                seen = {"without the key": bool(by_all), "with the key": bool(told)}
                digest_anew(connection)
                # A digest that was missing is there again: that undoes the change.
                is_undone = rows_in(connection) == rows
                seen["digests anew"] = is_undone or bool(faults_in(held, public_key=public))
                leaves_anew(connection)
                seen["leaves anew"] = "leaves or facts that it binds were changed" in found()
                chain_anew(connection)
                # As SECURITY.md says: nobody finds this without the key and without a head.
                seen["heads anew, seen alone"] = found() == ""
                seen["heads anew"] = "it is not signed" in found(public_key=public)
                seen["heads anew, a head kept"] = "is another than the one" in found(anchors=kept)
            missed += [f"{name}, {repair}" for repair, is_seen in seen.items() if not is_seen]
        connection.rollback()
    assert missed == ["a signature, without the key"]
    assert len(CHANGES) >= 60
    figures(changes=len(CHANGES), repairs=3)

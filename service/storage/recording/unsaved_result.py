"""A computed result that is not recorded yet: complete but for `timings_us.record`.

The rows are taken from the answer itself, so that lists and trends cannot differ from the client's
answer.  The answer is converted to JSON where it is computed: a worker sends it to the writer as
one text instead of a hundred small objects.
"""

import json
import time
from collections.abc import Sequence

import msgspec
from msgspec import UNSET, Struct, structs

from service.acquire import Acquisition
from service.contract.answers import Answer, Attitude, FrameSummary, FrameTimings
from service.observations.frame_record import FrameRecord
from service.observations.schema import LIVE, Submission
from service.storage.recording.answer import answer_of, rows_of_stars
from service.storage.recording.chain import leaf_of
from service.storage.recording.identity import digest_of_encoded, encoded_rows
from service.storage.recording.result_metrics import metrics_of, values_of_trackers
from service.storage.sql.columns import Row
from service.times import Utc
from service.trends.measures import MeasuredStars

AHEAD_NS = 3600 * 10**9
"""Limit in nanoseconds: a live batch dated further in the future is never shown as the latest."""
STARS = ("observed", "unique", "ambiguous", "unmatched")
"""Names of the four counts of a result's stars: all, and by outcome."""

_RECORD = b'"record":'
_NOT_RECORDED = _RECORD + b"null"
"""JSON text at which a stored answer gets the time that recording took."""


class Answered(Struct, frozen=True):
    """Stored answer as sent; `replayed` is True if it was stored before this request."""

    id: str | None
    """Id of the result; None for a what-if that was not to be recorded."""
    body: bytes
    replayed: bool


class PredictedFrom(Struct, frozen=True):
    """Period before a prediction and its last good results, from which the prediction starts."""

    spacecraft: str
    run: str
    since_ns: int
    until_ns: int
    results: tuple[str, ...]


class UnsavedResult(Struct, eq=False):
    """A result that is computed and not yet recorded.

    `batch` is the row of a first submission and None for a what-if.  `answer` is JSON
    and lacks the time that recording took.
    """

    identity: tuple[str, str, str]
    """Identity of the batch, unique among submissions: (spacecraft, run, batch)."""
    answer: bytes
    batch: Row | None
    result: Row
    stars: list[Row]
    solution: Row | None
    key: tuple[str, str] | None
    frame: Row | None = None
    handed_over_ns: int | None = None
    """Time of `time.perf_counter_ns` when the result was handed to the writer."""
    trackers: Sequence[Row] = ()
    """Rows of `tracker_values`, one for each tracker of a mission with several."""
    audit: Row | None = None
    """Audit entry that is stored with a recorded what-if."""
    predicted_from: "PredictedFrom | None" = None
    """Results that a prediction started from, if other services record attitudes too."""

    @property
    def id(self) -> str:
        """Id of the result."""
        return str(self.result["id"])

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of observed, unique, ambiguous and unmatched stars of the result."""
        return {name: self.result[name] for name in STARS}

    def to_json(self, together: int) -> bytes:
        """JSON of the answer, with the result's share of the recording time in `timings_us.record`.

        The time since the writer got the result is divided by `together`, the number of results in
        its transaction: none is recorded before the last.
        """
        if self.handed_over_ns is None:
            return self.answer
        waited_ns = time.perf_counter_ns() - self.handed_over_ns
        head, _, tail = self.answer.rpartition(_NOT_RECORDED)
        assert head
        return b"%b%b%d%b" % (head, _RECORD, waited_ns // (1000 * together), tail)

    def result_row(self, body: bytes, seq: int = 0) -> Row:
        """Row of `results`, with the answer, its place in the record and its digest."""
        return self.rows(body, seq)[0]

    def rows(self, body: bytes, seq: int) -> tuple[Row, Row]:
        """Rows of a result in `results` and `record_leaves`."""
        row = self.result | {"answer": body.decode(), "seq": seq}
        content = encoded_rows(row, self.stars, self.solution, self.batch, self.frame)
        row["digest"] = digest_of_encoded(content)
        leaf = leaf_of(self.id, row["answer"], content, bool(row["current"]))
        return row, {"seq": seq, "leaf": leaf}


def unsaved_submission(
    submission: Submission,
    acquisition: Acquisition,
    *,
    id: str,
    received: Utc,
    key: tuple[str, str] | None = None,
) -> UnsavedResult:
    """Build the first result of a batch, which is current and gives the batch its id."""
    batch = acquisition.batch
    row = {
        "id": id,
        "spacecraft": batch.spacecraft,
        "run": batch.run,
        "batch": batch.batch,
        "time": batch.time.text,
        "time_ns": batch.time.tai_ns,
        "received": received.text,
        "fingerprint": submission.fingerprint,
        "input": submission.text,
    }
    is_ahead = batch.run == LIVE and batch.time.tai_ns > received.tai_ns + AHEAD_NS
    warning = (
        f"dated_ahead: the batch is dated {batch.time.text} and came at {received.text}; it is "
        "not shown as the latest"
    )
    answer = answer_of(
        acquisition,
        id=id,
        frame=UNSET if submission.frame is None else _frame_of(submission.frame),
        warnings=[warning] if is_ahead else (),
    )
    unsaved = _unsaved_result(
        acquisition, answer, batch_id=id, parent=None, current=True, created=received
    )
    unsaved.batch, unsaved.key = row, key
    if submission.frame is not None:
        unsaved.frame = _frame_row(submission.frame, id)
    return unsaved


def unsaved_what_if(
    acquisition: Acquisition,
    *,
    id: str,
    batch_id: str,
    parent: str,
    adopt: bool,
    created: Utc,
) -> UnsavedResult:
    """Build a further result of a batch, current if it is adopted."""
    answer = answer_of(acquisition, id=id, parent=parent, recorded=True)
    return _unsaved_result(
        acquisition, answer, batch_id=batch_id, parent=parent, current=adopt, created=created
    )


def _unsaved_result(
    acquisition: Acquisition,
    answer: Answer,
    *,
    batch_id: str,
    parent: str | None,
    current: bool,
    created: Utc,
) -> UnsavedResult:
    batch, attitude = acquisition.batch, answer.attitude
    named = structs.asdict(batch.options)
    stars = MeasuredStars.of_all(acquisition)
    result = {
        "id": answer.id,
        "batch_id": batch_id,
        "parent_id": parent,
        "current": current,
        "created": created.text,
        "spacecraft": batch.spacecraft,
        "run": batch.run,
        "time_ns": batch.time.tai_ns,
        "identifier": answer.identifier,
        # Store only the options that the batch named.
        "options": json.dumps({k: value for k, value in named.items() if value not in (None, {})}),
        "mission_digest": answer.provenance.mission,
        "catalog_digest": answer.provenance.catalog,
        **structs.asdict(answer.counts),
        "status": attitude and attitude.status,
        "reason": answer.reason,
        **metrics_of(acquisition, stars),
    }
    return UnsavedResult(
        identity=(batch.spacecraft, batch.run, batch.batch),
        answer=msgspec.json.encode(answer),
        batch=None,
        result=result,
        stars=rows_of_stars(answer),
        solution=None if attitude is None else _solution_row(attitude, answer.id),
        key=None,
        trackers=values_of_trackers(acquisition, answer, batch_id, stars.batch),
    )


def _frame_of(frame: FrameRecord) -> FrameSummary:
    """Summary of a frame for the answer."""
    summary = frame.summary()
    return FrameSummary(**(summary | {"timings_us": FrameTimings(**summary["timings_us"])}))


def _frame_row(frame: FrameRecord, batch_id: str) -> Row:
    return {
        "batch_id": batch_id,
        "digest": frame.digest,
        "summary": json.dumps(frame.summary()),
        "detections": json.dumps({"stars": list(frame.stars), "hot_or_cosmic_px": frame.sharp}),
        "preview": frame.preview,
        "preview_step": frame.preview_step,
    }


def _solution_row(attitude: Attitude, result_id: str | None) -> Row:
    covariance = attitude.covariance_arcsec2
    return {
        "result_id": result_id,
        **dict(zip(("q1", "q2", "q3", "qc"), attitude.quaternion, strict=True)),
        "frame": attitude.frame,
        **{f"p{i + 1}{k + 1}": covariance[i][k] for i in range(3) for k in range(i, 3)},
        # Unknown for a measured attitude; the columns allow no null.
        "residual_rms_arcsec": attitude.residual_rms_arcsec or 0.0,
        "predicted_rms_arcsec": attitude.predicted_rms_arcsec or 0.0,
        "taste": attitude.taste or 0.0,
        "method": attitude.method,
        "status": attitude.status,
    }

"""Frames of star trackers: submission, and overlays of recorded frames."""

import json
from concurrent.futures import Future
from typing import IO, Any

from sqlalchemy import Connection, select

from service.access import Caller
from service.app.context import Context, known_id
from service.errors import NotFound, shown_value
from service.features.pictures.frames.files import frame_digest
from service.features.pictures.tracker.overlay import draw_overlay, marks_of
from service.features.pictures.tracker.submit import FrameIn
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, mission_named
from service.observations.schema import FromLastIn, Submission, submission_from_json
from service.storage.queries.results import answer_from_json, read_result
from service.storage.recording.unsaved_result import Answered
from service.storage.sql import tables
from service.times import utc_now

FRAME_WAIT_S = 30.0
"""Longest wait of a frame for a thread in seconds: other frames may take seconds."""


def _asks_for_last(known: FrameIn, mission: Mission) -> bool:
    """True if the batch from a frame may ask for the last attitude."""
    prior, settings = known.a_priori, mission.tracking
    is_default = settings is not None and settings.default
    return isinstance(prior, FromLastIn) or (prior is None and is_default)


class Frames:
    """Service that finds stars on frames, in the solver pool: about twenty bytes a pixel."""

    def __init__(self, context: Context, submissions: SubmissionService) -> None:
        self._context = context
        self._submissions = submissions

    def submit(
        self,
        spacecraft: str,
        known: FrameIn,
        file: IO[bytes],
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Find the stars on a frame, then submit the batch made from them; see `tracker.submit`.

        The same frame with the same fields is a repeat and is not searched again.  The file is
        closed at the end.  Raises `NotFound` for an unknown spacecraft, `BadInput` for a file that
        is no frame of its tracker, and the errors of `submit`.
        """
        self._submissions.require_kernels()
        with file:
            mission = mission_named(self._context.missions, spacecraft)
            digest = frame_digest(file)
            max_pixels = self._context.settings.frame_megapixels * 1_000_000

            def make() -> Submission:
                # Imported here, since the import takes a third of the service's starting time.
                from service.features.pictures.tracker.frame_submission import submit_frame

                catalog = self._context.sky.catalog
                return submit_frame(file, digest, known, mission, catalog, max_pixels)

            return self._submissions.queue_made(
                (mission.name, known.run, known.batch_of(digest)),
                known.fingerprint(mission.name, digest),
                make,
                idempotency_key,
                caller,
                Future(),
                is_long=True,
                wait_s=FRAME_WAIT_S,
                tracked_ns=utc_now().tai_ns if _asks_for_last(known, mission) else None,
            ).result()

    def overlay(self, id: str) -> bytes:
        """Draw the frame of a result with its stars, names and residuals; returns a PNG."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            row = _frame_of_result(connection, id)
        # The mission at the time of the result, which may differ from the present file.
        mission = Mission.model_validate_json(row["settings"])
        answer, batch = answer_from_json(row["answer"]), submission_from_json(row["input"]).batch
        tracker, camera = mission.camera_tracker(batch.observations[0].tracker, "tracker")
        run_catalog = None
        if row["catalog_digest"] == self._context.sky.catalog.digest:
            run_catalog = self._context.sky.run_catalog(mission, batch.time)
        detections = json.loads(row["detections"])
        marks = marks_of(answer, batch, tracker, camera, detections, run_catalog)
        state = answer.attitude.status if answer.attitude else answer.reason
        title = f"{mission.name} {tracker.name}  {batch.batch}  {batch.time.text}  {state}"
        return draw_overlay(row["preview"], row["preview_step"], marks, title)


def _frame_of_result(connection: Connection, id: str) -> dict[str, Any]:
    """Data for the overlay on a result's frame; raises `NotFound`, also without a frame.

    The `settings` are those of the mission at the time of the result.
    """
    read_result(connection, id)
    results, batches, frames = tables.results, tables.batches, tables.frames
    query = (
        select(
            results.c.answer,
            results.c.catalog_digest,
            batches.c.input,
            frames.c.detections,
            frames.c.preview,
            frames.c.preview_step,
            tables.missions.c.settings,
        )
        .select_from(
            results.join(batches, results.c.batch_id == batches.c.id)
            .join(frames, frames.c.batch_id == batches.c.id)
            .join(tables.missions, tables.missions.c.digest == results.c.mission_digest)
        )
        .where(results.c.id == id)
    )
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"batch {shown_value(id)} was not made of a frame")
    return dict(row)

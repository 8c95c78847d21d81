"""Frames of star trackers: submission, pictures, and overlays of recorded frames."""

import base64
import json
import re
import threading
from concurrent.futures import Future
from typing import IO

from msgspec.structs import replace

from service.access import Caller
from service.app.context import Context, known_id
from service.contract.pictures import Picture, picture_of
from service.errors import Busy
from service.imaging.frames.files import frame_digest, read_frame
from service.imaging.frames.frame import FrameLimits
from service.imaging.overlay import draw_overlay, marks_of
from service.imaging.submit import FrameIn
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, mission_named
from service.observations.schema import FromLastIn, Submission, submission_from_json
from service.storage.queries.results import answer_from_json, frame_of_result
from service.storage.recording.unsaved_result import Answered
from service.times import utc_now
from service.vectors import Projection

FRAME_WAIT_S = 30.0
"""Longest wait of a frame for a thread in seconds: other frames may take seconds."""
_COMMAND_OPTION = re.compile(r" \(--[^)]*\)")


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
        self._picture_turn = threading.BoundedSemaphore(1)

    def submit(
        self,
        spacecraft: str,
        known: FrameIn,
        file: IO[bytes],
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Find the stars on a frame, then submit the batch made from them; see `imaging.submit`.

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
                from service.acquire.frame_submission import submit_frame

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

    def picture(
        self,
        file: IO[bytes],
        *,
        spacecraft: str | None = None,
        field_of_view_deg: float | None = None,
        projection: Projection | None = None,
        image: str | None = None,
        draws: bool = False,
    ) -> Picture:
        """Solve the attitude and the lens of a picture from any camera; nothing is recorded.

        With a `spacecraft` the picture must have the size of its camera's frames, whose focal
        length is the first guess.  The file is closed at the end.  One picture is solved at a time.
        Raises `Busy` if others take too long, `NotFound` for an unknown spacecraft, and `BadInput`
        for a file that is no picture.
        """
        self._submissions.require_kernels()
        # Imported here, since the import takes a third of the service's starting time.
        from service.acquire.picture import blind_sky, overlay_of, solve_picture
        from service.acquire.picture_remarks import doubt_of_exposure
        from service.identify.blind.solver import focal_px_of

        with file:
            shape, guess_px, zero_point_mag = None, None, None
            if spacecraft is not None:
                mission = mission_named(self._context.missions, spacecraft)
                _, camera = mission.camera_tracker(None, "spacecraft")
                shape, guess_px = camera.shape, camera.focal_length_px
                zero_point_mag = camera.zero_point_mag
            max_pixels = self._context.settings.frame_megapixels * 1_000_000
            limits = FrameLimits(max_pixels, shape, spacecraft or "the camera", image)
            if not self._picture_turn.acquire(timeout=FRAME_WAIT_S):
                raise Busy("other pictures are being solved", 10)
            try:
                frame = read_frame(file, limits)
                if field_of_view_deg is not None:
                    side_px = max(frame.width_px, frame.height_px)
                    guess_px = focal_px_of(side_px, field_of_view_deg, projection or "gnomonic")
                sky, solver = blind_sky(self._context.sky.catalog)
                result = solve_picture(frame, sky, solver, guess_px, projection=projection)
                drawn = overlay_of(result, "") if draws else None
            finally:
                self._picture_turn.release()
        found = picture_of(result)
        return replace(
            found,
            # Remarks name options of the command.
            remarks=[
                *(_COMMAND_OPTION.sub("", remark) for remark in found.remarks),
                *doubt_of_exposure(result, zero_point_mag),
            ],
            overlay_png=base64.b64encode(drawn).decode() if drawn is not None else None,
        )

    def overlay(self, id: str) -> bytes:
        """Draw the frame of a result with its stars, names and residuals; returns a PNG."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            row = frame_of_result(connection, id)
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

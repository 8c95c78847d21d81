"""The part of the app for frames of spacecraft and pictures of any camera."""

import base64
import dataclasses
import re
import threading
from typing import IO

from msgspec.structs import replace

from service.app.factory import App
from service.errors import Busy
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import FrameLimits
from service.features.pictures.records import Picture, picture_of
from service.features.pictures.tracker.part import Frames
from service.missions.mission import mission_named
from service.vectors import Projection

WAIT_S = 30.0
"""Longest wait of a picture for its turn, in seconds: each one before it may take seconds."""
_COMMAND_OPTION = re.compile(r" \(--[^)]*\)")


class Pictures:
    """Takes frames of spacecraft; finds attitude, lens and stars of pictures, and records nothing.

    `frames` submits frames and draws recorded ones.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self.frames = Frames(app.context, app.submissions)
        self._turn = threading.BoundedSemaphore(1)

    def close(self) -> None:
        """Do nothing on closing: this part has no file and no thread."""

    def solve(
        self,
        file: IO[bytes],
        *,
        spacecraft: str | None = None,
        field_of_view_deg: float | None = None,
        projection: Projection | None = None,
        pixel_ratio: float | None = None,
        image: str | None = None,
        draws: bool = False,
    ) -> Picture:
        """Solve the attitude and the lens of a picture from any camera; nothing is recorded.

        With a `spacecraft` the picture must have the size of its camera's frames, whose focal
        length is the first guess.  The file is closed at the end.  One picture is solved at a
        time.  Raises `Busy` if others take too long, `NotFound` for an unknown spacecraft, and
        `BadInput` for a file that is no picture.
        """
        self._app.submissions.require_kernels()
        # Imported here, since the import takes a third of the service's starting time.
        from service.features.pictures.blind.picture import (
            blind_sky,
            focal_px_of_field,
            solve_picture,
        )
        from service.features.pictures.blind.picture_remarks import doubt_of_exposure
        from service.features.pictures.overlay import overlay_of

        with file:
            shape, guess_px, zero_point_mag = None, None, None
            if spacecraft is not None:
                mission = mission_named(self._app.missions, spacecraft)
                _, camera = mission.camera_tracker(None, "spacecraft")
                shape, guess_px = camera.shape, camera.focal_length_px
                zero_point_mag = camera.zero_point_mag
            max_pixels = self._app.settings.frame_megapixels * 1_000_000
            limits = FrameLimits(max_pixels, shape, spacecraft or "the camera", image)
            if not self._turn.acquire(timeout=WAIT_S):
                raise Busy("other pictures are being solved", 10)
            try:
                frame = read_frame(file, limits)
                if pixel_ratio is not None:
                    frame = dataclasses.replace(frame, pixel_ratio=pixel_ratio)
                if field_of_view_deg is not None:
                    side_px = max(frame.width_px, frame.height_px)
                    guess_px = focal_px_of_field(
                        side_px, field_of_view_deg, projection, "field_of_view_deg"
                    )
                sky, solver = blind_sky(self._app.sky.catalog)
                result = solve_picture(frame, sky, solver, guess_px, projection=projection)
                drawn = overlay_of(result, "") if draws else None
            finally:
                self._turn.release()
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


def open_part(app: App) -> Pictures:
    """Create the service for pictures of an open app."""
    return Pictures(app)

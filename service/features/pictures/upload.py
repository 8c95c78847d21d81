"""Uploads of frames and pictures."""

from typing import IO

from starlette.requests import Request

from service.settings import Settings
from service.web.requests.request_body import BINARY, file_body

FRAMES = (
    BINARY,
    *("application/fits", "image/fits", "image/tiff", "image/png", "image/jpeg"),
    "application/x-npy",
)
"""Media types of frames; the first bytes determine the format."""


async def frame_body(request: Request, settings: Settings) -> IO[bytes]:
    """Read a frame or picture into a temporary file, up to the size in the settings."""
    return await file_body(request, FRAMES, settings.frame_mb << 20)

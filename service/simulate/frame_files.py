"""Drawn frames as files: the frame, what is known of it beside it, and the truth of all."""

import io
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from service.errors import BadFile, Fault
from service.imaging.frames.fits import write_fits
from service.simulate.frames import DrawnFrame
from service.times import shifted

FrameWriter = Callable[[DrawnFrame, BinaryIO], None]
FrameFormat = Literal["fits", "tiff", "png", "npy"]
TRUTH = "truth.ndjson"


def write_frames(
    drawn: Iterable[DrawnFrame], folder: Path, file_format: FrameFormat = "fits"
) -> int:
    """Write frame-BATCH.FORMAT and frame-BATCH.json of each, and truth.ndjson; how many."""
    count = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / TRUTH).open("w", encoding="utf-8") as truth:
            for each in drawn:
                count += 1
                stem = f"frame-{each.known['batch']}"
                (folder / f"{stem}.{file_format}").write_bytes(frame_bytes(each, file_format))
                text = json.dumps(each.known, indent=1) + "\n"
                (folder / f"{stem}.json").write_text(text, encoding="utf-8")
                truth.write(json.dumps(each.truth, separators=(",", ":")) + "\n")
    except OSError as error:
        raise BadFile(Fault(str(folder), f"cannot be written: {error.strerror}")) from None
    return count


def frame_bytes(drawn: DrawnFrame, file_format: FrameFormat = "fits") -> bytes:
    """The frame as a file."""
    file = io.BytesIO()
    _WRITERS[file_format](drawn, file)
    return file.getvalue()


def _fits(drawn: DrawnFrame, file: BinaryIO) -> None:
    start = shifted(drawn.time, -drawn.exposure_s / 2.0)
    cards: dict[str, bool | int | float | str] = {
        "TIMESYS": "UTC",
        "DATE-OBS": start.text.removesuffix("Z"),
        "DATE-AVG": drawn.time.text.removesuffix("Z"),
        "EXPTIME": drawn.exposure_s,
        "INSTRUME": str(drawn.known["tracker"]),
    }
    write_fits(file, drawn.counts, cards)


def _picture(file_format: str) -> FrameWriter:
    def write(drawn: DrawnFrame, file: BinaryIO) -> None:
        from PIL import Image

        Image.fromarray(drawn.counts).save(file, file_format)

    return write


def _npy(drawn: DrawnFrame, file: BinaryIO) -> None:
    np.save(file, drawn.counts)


_WRITERS: Mapping[FrameFormat, FrameWriter] = {
    "fits": _fits, "tiff": _picture("TIFF"), "png": _picture("PNG"), "npy": _npy,
}  # fmt: skip

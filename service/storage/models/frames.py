"""The frame of a batch, and the stars that were measured in it."""

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.storage.models.base import Count, DescribedAs, Digest, Record, doc


class FrameTimings(Record, frozen=True, kw_only=True):
    """Microseconds per step from file to stars."""

    component: ClassVar[str] = "FrameTimingsOut"
    read: Count
    detect: Count
    centroid: Count


class FrameSummary(Record, frozen=True, kw_only=True):
    """The frame of a batch, and the numbers of detected stars."""

    component: ClassVar[str] = "FrameOut"
    digest: Digest
    format: Annotated[str, DescribedAs(Literal["FITS", "TIFF", "PNG", "NPY", "JPEG", "BMP"])]
    tracker: str
    width_px: Count
    height_px: Count
    exposure_s: float
    centroid: Annotated[str, DescribedAs(Literal["window", "scan", "matched", "recursive"])]
    background_counts: Annotated[float, doc("Median background above the bias.")]
    noise_counts: Annotated[float, doc("Standard deviation of a background pixel.")]
    candidates: Annotated[Count, doc("Detections above the threshold, without hot pixels.")]
    measured: Annotated[Count, doc("The brightest of these, whose positions were measured.")]
    used: Annotated[Count, doc("Of these, the stars in the batch.")]
    hot_or_cosmic: Annotated[Count, doc("Detections that are sharper than a star.")]
    timings_us: FrameTimings
    remarks: (
        Annotated[list[str], doc("What was fitted, chosen of the file, or turned, in words.")]
        | UnsetType
    ) = UNSET


class Detection(Record, frozen=True, kw_only=True):
    """One measured candidate.  The centre of the first pixel is (0, 0); u counts columns."""

    component: ClassVar[str] = "DetectionOut"
    u_px: Annotated[
        float | None,
        doc("null if the position could not be measured; `left_out` states the reason."),
    ]
    v_px: float | None
    sigma_u_px: Annotated[float | None, doc("Predicted, one standard deviation.")]
    sigma_v_px: float | None
    flux_counts: float | None
    magnitude: float | None
    signal_ratio: Annotated[float | None, doc("Signal divided by its noise.")]
    flags: list[
        Annotated[
            str,
            DescribedAs(
                Literal[
                    "saturated",
                    "edge",
                    "blended",
                    "too_faint",
                    "outside_hump",
                    "masked_pixels",
                    "truncated",
                    "not_converged",
                ]
            ),
        ]
    ]
    used: Annotated[bool, doc("Whether it is in the batch. The batch has the same order.")]
    left_out: Annotated[str | None, doc("Why it is not in the batch.")]


class FrameWithStars(FrameSummary, frozen=True, kw_only=True):
    """A frame with every candidate."""

    component: ClassVar[str] = "FrameRecordOut"
    stars: Annotated[list[Detection], doc("The stars in the batch come first.")]
    hot_or_cosmic_px: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]],
        doc("Positions (u, v) of rejected hot pixels and cosmic rays; the first 500."),
    ]

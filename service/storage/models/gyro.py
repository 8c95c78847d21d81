"""Gyro blocks as they are recorded, and their samples."""

from typing import Annotated, ClassVar

from pydantic import Field

from service.storage.models.base import Components, Id, Moment, Record, Stamp, doc, page_record


class GyroBlockRow(Record, frozen=True, kw_only=True):
    """A recorded gyro block."""

    component: ClassVar[str] = "GyroBlock"
    id: Id
    spacecraft: str
    run: str
    block: str
    start: Annotated[Moment, doc("Time of the first sample.")]
    end: Annotated[Moment, doc("Time of the last sample.")]
    samples: Annotated[int, Field(ge=1)]
    step_s: float | None
    """From each sample to the next; null: the block has times of its own."""
    received: Stamp


GyroBlockPage = page_record("GyroBlockPage", GyroBlockRow, "A page of gyro blocks.")


class GyroSamples(GyroBlockRow, frozen=True, kw_only=True):
    """A recorded gyro block with its samples."""

    times_s: Annotated[list[float], doc("Of each sample, in seconds of TAI after `start`.")]
    rates_rad_per_s: list[Components]
    """Of each sample, as it was sent: about the three axes of the mission's gyro."""

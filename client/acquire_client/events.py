"""The kinds of events that this version knows."""
# Written by `make client` from service/contract/events.py.

from typing import Literal

from . import models
from .base import Model


class _Numbered(Model, frozen=True):
    id: int


class BatchesEvent(_Numbered, frozen=True):
    """An event `batches`."""

    kind: Literal["batches"]
    data: models.Recorded


class AdoptedEvent(_Numbered, frozen=True):
    """An event `adopted`."""

    kind: Literal["adopted"]
    data: models.Adopted


class AlarmEvent(_Numbered, frozen=True):
    """An event `alarm`."""

    kind: Literal["alarm"]
    data: models.Alarm


class LimitEvent(_Numbered, frozen=True):
    """An event `limit`."""

    kind: Literal["limit"]
    data: models.Limit


class AnnotationEvent(_Numbered, frozen=True):
    """An event `annotation`."""

    kind: Literal["annotation"]
    data: models.AnnotationChange


class ReplayEvent(_Numbered, frozen=True):
    """An event `replay`."""

    kind: Literal["replay"]
    data: models.ReplayProgress


class GyroEvent(_Numbered, frozen=True):
    """An event `gyro`."""

    kind: Literal["gyro"]
    data: models.GyroBlock


class TrackingEvent(_Numbered, frozen=True):
    """An event `tracking`."""

    kind: Literal["tracking"]
    data: models.TrackingChange


class CalibrationEvent(_Numbered, frozen=True):
    """An event `calibration`."""

    kind: Literal["calibration"]
    data: models.CalibrationChange


class HeadEvent(_Numbered, frozen=True):
    """An event `head`."""

    kind: Literal["head"]
    data: models.RecordHead


KnownEvent = (
    BatchesEvent
    | AdoptedEvent
    | AlarmEvent
    | LimitEvent
    | AnnotationEvent
    | ReplayEvent
    | GyroEvent
    | TrackingEvent
    | CalibrationEvent
    | HeadEvent
)

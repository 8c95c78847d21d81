"""A client of the attitude service: submit batches, read results, follow events.

It imports nothing of the service, and is built alone.
"""

from . import models
from ._async.client import AsyncClient, AsyncEvents
from ._async.connection import AsyncItems
from ._sync.client import Client, Events
from ._sync.connection import Items
from .errors import (
    BadInput,
    Busy,
    ClientError,
    Conflict,
    EventsLost,
    Forbidden,
    InvalidArgument,
    KeyReused,
    NoAnswer,
    NotAvailable,
    NotFound,
    PackageMissing,
    Problem,
    RateLimited,
    ReplayEnded,
    ServiceFailed,
    Unauthenticated,
    UnexpectedAnswer,
    WrongState,
)
from .event_lines import (
    AdoptedEvent,
    AlarmEvent,
    AnnotationEvent,
    BatchesEvent,
    CalibrationEvent,
    Event,
    GyroEvent,
    LimitEvent,
    OtherEvent,
    ReplayEvent,
    TrackingEvent,
)
from .operations import BatchOutcome, RecordedAnswer
from .retrying import Repeat

__version__ = "0.2.0"

__all__ = [
    "AdoptedEvent",
    "AlarmEvent",
    "AnnotationEvent",
    "AsyncClient",
    "AsyncEvents",
    "AsyncItems",
    "BadInput",
    "BatchOutcome",
    "BatchesEvent",
    "Busy",
    "CalibrationEvent",
    "Client",
    "ClientError",
    "Conflict",
    "Event",
    "Events",
    "EventsLost",
    "Forbidden",
    "GyroEvent",
    "InvalidArgument",
    "Items",
    "KeyReused",
    "LimitEvent",
    "NoAnswer",
    "NotAvailable",
    "NotFound",
    "OtherEvent",
    "PackageMissing",
    "Problem",
    "RateLimited",
    "RecordedAnswer",
    "Repeat",
    "ReplayEnded",
    "ReplayEvent",
    "ServiceFailed",
    "TrackingEvent",
    "Unauthenticated",
    "UnexpectedAnswer",
    "WrongState",
    "models",
]

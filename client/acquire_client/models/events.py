"""Records of events' data, as sent by the event stream and webhooks."""
# Written by `make client` from service/contract/events.py.

from ..base import Model
from ..words import Status
from .answers import StarCounts


class LatestBatch(Model, frozen=True, kw_only=True):
    """The latest batch among those of an event."""

    id: str
    batch: str
    time: str
    status: Status | None
    reason: str | None
    counts: StarCounts


class Recorded(Model, frozen=True, kw_only=True):
    """Data of an event about newly recorded batches."""

    spacecraft: str
    run: str
    batches: int
    """How many."""
    latest: LatestBatch


class Adopted(Model, frozen=True, kw_only=True):
    """Data of an event about an adopted what-if."""

    spacecraft: str
    run: str
    id: str
    """The result that stands for the batch now."""
    batch_id: str
    """The batch, by the id of its first result."""


class TrackingChange(Model, frozen=True, kw_only=True):
    """Data of an event about a change of a spacecraft's tracking state."""

    spacecraft: str
    run: str
    id: str
    batch: str
    time: str
    state: str | None
    """None: not tracked."""
    before: str | None


class CalibrationChange(Model, frozen=True, kw_only=True):
    """Data of an event about a change of the calibration in force."""

    id: str
    spacecraft: str
    adopted: str
    who: str
    note: str
    calibration: str | None
    """None: back to the mission file."""
    version: int | None
    mission: str
    """The settings in force since then."""


class RecordHead(Model, frozen=True, kw_only=True):
    """Head of the record's chain, to be stored where nobody who can change the record can write."""

    number: int
    sha256: str
    """SHA-256 of the statement."""
    made: str
    statement: str
    """JSON, byte for byte as it is hashed and signed."""
    signature: str | None
    """Ed25519, in hexadecimal digits; None: the service has no key."""

"""The data of events, one model a kind; those of other modules are the data of events, too."""

from collections.abc import Mapping
from typing import Any

from ..base import Model, Status
from .answers import StarCounts


class LatestBatch(Model, frozen=True, kw_only=True):
    """The latest of the batches of an event; `status` is None without an attitude."""

    id: str
    batch: str
    time: str
    status: Status | None
    reason: str | None
    counts: StarCounts


class Recorded(Model, frozen=True, kw_only=True):
    """Batches that were recorded: how many, and the latest of them."""

    spacecraft: str
    run: str
    batches: int
    latest: LatestBatch


class Adopted(Model, frozen=True, kw_only=True):
    """A what-if that was adopted: its id, and that of the batch."""

    spacecraft: str
    run: str
    id: str
    batch_id: str


class Limit(Model, frozen=True, kw_only=True):
    """The limits of a quantity; `since`, `who` and `comment` are None for the default."""

    spacecraft: str
    quantity: str
    tracker: str | None = None
    unit: str
    is_default: bool
    since: str | None
    who: str | None
    comment: str | None
    settings: Mapping[str, Any]


class AnnotationChange(Model, frozen=True, kw_only=True):
    """A note that was written, or deleted."""

    id: str
    spacecraft: str | None
    start: str
    end: str | None
    text: str
    who: str
    created: str
    deleted: bool


class TrackingChange(Model, frozen=True, kw_only=True):
    """A change of the tracking state of a spacecraft at a batch; None: not tracked."""

    spacecraft: str
    run: str
    id: str
    batch: str
    time: str
    state: str | None
    before: str | None

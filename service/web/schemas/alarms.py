"""Limits and alarms."""

from typing import Literal

from pydantic import Field

from service.alarms.latch import Action, State
from service.alarms.limits import LimitSettings
from service.alarms.quantities import QuantityName
from service.web.schemas.base import Id, Moment, Shape

SeverityName = Literal["watch", "warning", "critical"]


class LimitOut(Shape):
    """The limit of one quantity of a spacecraft."""

    spacecraft: str
    quantity: QuantityName
    unit: str
    is_default: bool = Field(description="Whether it is the shipped one.")
    since: Moment | None = Field(description="null: it was never changed.")
    who: str | None
    comment: str | None
    settings: LimitSettings


class LimitList(Shape):
    """The limits of a spacecraft."""

    items: list[LimitOut]


class LimitHistory(Shape):
    """One limit, the shipped one, and every one that was set."""

    limit: LimitOut
    default: LimitSettings
    history: list[LimitOut] = Field(description="Newest first.")


class PointOut(Shape):
    """A judged value with the time and the batch that it is of."""

    value: float
    time: Moment = Field(description="Of the batch; of a silence that of the batch before it.")
    batch_id: Id | None


class RaisedOut(PointOut):
    """What an alarm was raised by."""

    at: Moment = Field(description="By the service's clock.")
    bound: float = Field(description="The bound of the worst severity so far.")


class ActedOut(Shape):
    """Who did something, and when."""

    at: Moment
    who: str


class ShelfOut(ActedOut):
    """Put aside until a moment."""

    until: Moment


class AlarmOut(Shape):
    """An alarm: latched until it is acknowledged and its quantity back in limits."""

    id: Id
    spacecraft: str
    run: str
    quantity: QuantityName
    unit: str
    state: State
    severity: SeverityName = Field(description="The worst so far.")
    current_severity: SeverityName | None = Field(description="null: back in limits.")
    in_limits: bool
    raised: RaisedOut
    worst: PointOut
    latest: PointOut
    returned_at: Moment | None
    acknowledged: ActedOut | None
    shelved: ShelfOut | None
    cleared_at: Moment | None


class AlarmPage(Shape):
    """A page of alarms."""

    items: list[AlarmOut]
    next_cursor: str | None


class ActionOut(Shape):
    """Something that happened to an alarm, or that somebody did about it."""

    at: Moment
    action: Action
    who: str | None
    comment: str | None
    severity: SeverityName | None
    value: float | None
    time: Moment | None


class AlarmRecord(AlarmOut):
    """An alarm with all that was noted of it."""

    actions: list[ActionOut] = Field(description="Oldest first.")


class AlarmSummary(Shape):
    """How many alarms are active, by state."""

    open: int
    acknowledged: int
    shelved: int
    worst: SeverityName | None = Field(description="Of those that are not shelved.")

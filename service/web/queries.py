"""What may stand behind the question mark: each parameter checked, unknown ones refused."""

from typing import Annotated, Any, Self

from fastapi import Depends
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)
from starlette.requests import Request

from service.errors import BadBatch, BadInput, Fault, shown_value
from service.observe.wire import Key, RunName
from service.records.reading import OutcomeName, Status
from service.records.rollups import Bucket
from service.times import Utc, parse_utc

MAX_LIMIT = 500


def _time(value: object) -> Utc:
    try:
        return parse_utc(value)
    except BadInput as error:
        raise ValueError(error.faults[0].message) from None


_TIME_SCHEMA = {"type": "string", "examples": ["1996-01-10T12:00:00.000Z", "1996-010T12:00:00Z"]}

Time = Annotated[Utc, PlainValidator(_time), WithJsonSchema(_TIME_SCHEMA)]
"""UTC text, calendar or day-of-year, as the core's own type."""

Start = Annotated[Time | None, Field(description="The first moment, itself included.")]
End = Annotated[Time | None, Field(description="The last moment, itself excluded.")]
Limit = Annotated[int, Field(ge=1, le=MAX_LIMIT, description="The most items on a page.")]
Cursor = Annotated[
    str | None,
    Field(pattern=r"^[\x21-\x7e]{1,200}$", description="Where the page begins: from a `Link`."),
]
Spacecraft = Annotated[Key | None, Field(description="Only those of this spacecraft.")]


class Query(BaseModel):
    """The ground rules of every query: nothing unknown."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def asked(self) -> dict[str, Any]:
        """Every parameter by its name, as the operations take them."""
        return {name: getattr(self, name) for name in type(self).model_fields}


class Stretch(Query):
    """A stretch of time and a run."""

    run: Annotated[RunName, Field(description="The run; `live` is what pipelines send.")] = "live"
    start: Start = None
    end: End = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.start and self.end and self.start.tai_ns > self.end.tai_ns:
            raise ValueError(f"start {self.start} must not be after end {self.end}")
        return self


class StretchPage(Stretch):
    """A page of what lies in a stretch of time."""

    limit: Limit = 100
    cursor: Cursor = None


class BatchQuery(StretchPage):
    """Which of the recorded batches."""

    spacecraft: Spacecraft = None
    outcome: Annotated[
        OutcomeName | None, Field(description="Only those with at least one star of it.")
    ] = None
    status: Annotated[
        Status | None,
        Field(description="Only those whose attitude is good or suspect, or that have none."),
    ] = None


class RatesQuery(Stretch):
    """Star rates of a stretch of time, in buckets."""

    bucket: Annotated[Bucket, Field(description="The width of a bucket, in UTC.")] = "hour"


async def _no_query(request: Request) -> None:
    faults = [
        Fault(name[:80], "there is no such parameter here; there is none", shown_value(value))
        for name, value in request.query_params.items()
    ]
    if faults:
        raise BadBatch(faults)


NO_QUERY = Depends(_no_query)
"""For a route that takes no parameter."""

"""What all shapes have in common: words, numbers, and the shape of a problem."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Components = Annotated[list[float], Field(min_length=3, max_length=3)]
Quaternion = Annotated[
    list[float],
    Field(min_length=4, max_length=4, description="Inertial to body, scalar last, qc >= 0."),
]
Outcome = Literal["unique", "ambiguous", "unmatched"]
Moment = Annotated[str, Field(description="UTC.", examples=["1996-01-10T12:00:00.000Z"])]
Id = Annotated[str, Field(min_length=26, max_length=26, description="Sorts by time of recording.")]
Digest = Annotated[str, Field(pattern=r"^sha256:[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]


Settings = Annotated[dict[str, Any], Field(description="By the names of the mission's file.")]
Status = Literal["good", "suspect"]
Reason = Literal[
    "fewer_than_two_unique_stars",
    "degenerate_geometry",
    "fewer_than_three_stars",
    "no_match",
    "doubtful_match",
]
Covariance = Annotated[
    list[Components],
    Field(min_length=3, max_length=3, description="Of the small rotation about the body axes."),
]


def _without_defaults(schema: dict[str, Any]) -> None:
    # A default here says that a field may be absent, not what is meant where it is.
    for each in schema.get("properties", {}).values():
        each.pop("default", None)


class Shape(BaseModel):
    """The ground rules: nothing but what is described here is sent."""

    model_config = ConfigDict(extra="forbid", json_schema_extra=_without_defaults)


class FaultOut(Shape):
    """One thing that is wrong with a request."""

    field: str
    message: str
    value: str | None


class Problem(Shape):
    """A problem (RFC 9457)."""

    type: str = Field(description="What kind of problem; `about:blank` where the status says all.")
    title: str
    status: int
    detail: str
    instance: str = Field(description="The path of the request.")
    errors: list[FaultOut] = Field(default=[], description="Every fault, field by field.")

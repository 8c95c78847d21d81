"""Runs and replays."""

from typing import Literal

from pydantic import Field

from service.web.schemas.base import Count, FaultOut, Id, Moment, Shape


class RunRow(Shape):
    """A run."""

    run: str
    created: Moment
    alarms: bool = Field(description="Whether limits are held against it.")
    batches: Count
    spacecraft: list[str]
    first_day: str = Field(examples=["1999-03-01"])
    last_day: str


class RunList(Shape):
    """Every run that holds batches."""

    items: list[RunRow]


class ReplayLines(Shape):
    """The lines of a replay."""

    total: int | None = Field(description="null where nobody counted them beforehand.")
    done: Count
    refused: Count


class ReplayCounts(Shape):
    """What came of the lines so far."""

    new: Count = Field(description="Batches that were recorded.")
    repeated: Count = Field(description="Batches that were recorded before.")
    observed: Count = Field(description="Their stars; then these by outcome.")
    unique: Count
    ambiguous: Count
    unmatched: Count
    attitudes: Count = Field(description="Batches that have one.")


class LineProblem(Shape):
    """What is wrong with a line."""

    detail: str
    errors: list[FaultOut] = Field(default=[], description="Every fault, field by field.")


class RefusedLine(Shape):
    """A line that was refused; the others go on."""

    line: int = Field(description="Its number, from 1.")
    problem: LineProblem


class ReplayState(Shape):
    """A replay and how far it is."""

    id: Id
    run: str
    name: str
    state: Literal["running", "done", "interrupted", "failed", "cancelled"]
    lines: ReplayLines
    counts: ReplayCounts
    errors: list[RefusedLine] = Field(
        description="The first thousand, then what ended a replay that failed."
    )
    started: Moment
    finished: Moment | None


class ReplayList(Shape):
    """The latest replays, newest first."""

    items: list[ReplayState]


class RunState(Shape):
    """A run, and whether limits are held against it."""

    run: str
    alarms: bool

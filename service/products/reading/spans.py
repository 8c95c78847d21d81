"""The spans of time in which the segments of a file are valid."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol, TypeVar

from service.errors import BadFile, Fault


class Span(Protocol):
    """What is valid from one time to another, `Utc.tai_ns`; `place` names it in messages."""

    @property
    def place(self) -> str:
        """Where it stands in its file."""

    @property
    def first_ns(self) -> int:
        """The first time."""

    @property
    def last_ns(self) -> int:
        """The last time."""


S = TypeVar("S", bound=Span)


def in_order(file: str, segments: Sequence[S]) -> list[S]:
    """The segments of a file in order of time.

    Raises `BadFile` where one has no useable time, and where two overlap.
    """
    for each in segments:
        if each.first_ns > each.last_ns:
            raise BadFile(Fault(f"{file}, {each.place}", "the segment has no useable time"))
    ordered = sorted(segments, key=lambda each: each.first_ns)
    for one, other in pairwise(ordered):
        if other.first_ns < one.last_ns:
            message = f"overlaps the segment at {one.place}: a time belongs to one segment"
            raise BadFile(Fault(f"{file}, {other.place}", message))
    return ordered

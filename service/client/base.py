"""The base of all models, and what several modules share."""

from typing import Generic, TypeVar

from msgspec import Struct

T = TypeVar("T")


class Model(Struct, frozen=True):
    """A part of an answer.

    Fields that a later service adds are ignored.  A field with a default may be absent from the
    answer.  Words such as a status are text: a later service may know further ones.
    """


class Page(Struct, Generic[T], frozen=True):
    """A part of a list; `next_cursor` leads to the next part, None at the end."""

    items: list[T]
    next_cursor: str | None = None


class FieldFault(Model, frozen=True):
    """One fault of a request or a line: the field, what is expected, and the value received."""

    field: str
    message: str
    value: str | None

"""The base of all models, and what several modules share."""

from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from msgspec import Struct

OutcomeWord = Literal["unique", "ambiguous", "unmatched"]
StatusWord = Literal["good", "suspect"]
IdentifierWord = Literal["verified", "starid", "lost_in_space", "ptp"]
if TYPE_CHECKING:
    Outcome = OutcomeWord
    Status = StatusWord
    Identifier = IdentifierWord
else:
    # A later service may know further words: they are read, too.
    Outcome = Status = Identifier = str

T = TypeVar("T")


class Model(Struct, frozen=True):
    """A part of an answer.

    Fields that a later service adds are ignored.  A field with a default may be absent from the
    answer.  Words such as a status are text when they are read, since a later service may know
    further ones; for a type checker they are those of this version.
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

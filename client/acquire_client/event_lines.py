"""Server-sent events: parsing of an event stream to blocks, and of blocks to events."""

from collections.abc import Mapping
from typing import Any, Literal, cast, get_args, get_type_hints

import msgspec

from .base import Model
from .errors import UnexpectedAnswer
from .events import KnownEvent


class OtherEvent(Model, frozen=True):
    """Event of a kind that a later service added, whose word is `name`."""

    id: int
    kind: Literal["other"]
    name: str
    data: dict[str, Any]


Event = KnownEvent | OtherEvent
"""Event of the service with its number: numbers have no gaps and follow the order of commit.

`kind` gives the kind of event, which determines the type of `data`.
"""
_BY_KIND: Mapping[str, Any] = {
    get_args(get_type_hints(each)["kind"])[0]: each for each in get_args(KnownEvent)
}


class Block(Model, frozen=True):
    """Block of an event stream; `data` is None for a block with only a number."""

    id: int | None
    kind: str
    data: str | None

    def event(self) -> Event:
        """Convert the block to an event; raises `UnexpectedAnswer` if it is none."""
        fault = UnexpectedAnswer(f"this is no event of the service: {self}")
        if self.id is None:
            raise fault
        try:
            data = msgspec.json.decode(self.data or "", type=dict[str, Any])
            kind = _BY_KIND.get(self.kind)
            if kind is None:
                return OtherEvent(self.id, "other", self.kind, data)
            event = {"id": self.id, "kind": self.kind, "data": data}
            return cast(Event, msgspec.convert(event, type=kind))
        except (msgspec.DecodeError, msgspec.ValidationError) as error:
            raise fault from error


class BlockReader:
    """Parser of the blocks of an event stream from its bytes.

    A block is complete after its empty line: an incomplete one is dropped, with its number.  Lines
    end with a line feed only: text may hold other separators.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._fields: dict[str, str] = {}

    def feed(self, piece: bytes) -> list[Block]:
        """Add bytes of the stream; returns the blocks that they complete."""
        *lines, self._rest = (self._rest + piece).split(b"\n")
        found = []
        for line in lines:
            text = line.removesuffix(b"\r").decode()
            if text:
                name, _, value = text.partition(":")
                self._fields[name] = value.removeprefix(" ")
            elif (block := self._block()) is not None:
                found.append(block)
        return found

    def _block(self) -> Block | None:
        fields, self._fields = self._fields, {}
        number = fields.get("id", "")
        id = int(number) if number.isascii() and number.isdigit() else None
        if id is None and "data" not in fields:
            return None
        return Block(id, fields.get("event", "message"), fields.get("data"))

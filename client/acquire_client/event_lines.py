"""Server-sent events: the blocks of an event stream, and the events in them."""

from collections.abc import Mapping
from typing import Any, Literal, cast, get_args, get_type_hints

import msgspec

from .base import Model
from .errors import UnexpectedAnswer
from .events import KnownEvent


class OtherEvent(Model, frozen=True):
    """An event of a kind that a later service added: the word is `name`."""

    id: int
    kind: Literal["other"]
    name: str
    data: dict[str, Any]


Event = KnownEvent | OtherEvent
"""Something that happened, by its number: numbers have no gaps and are in order of commit.

`kind` says which it is, and so what `data` is.
"""
_BY_KIND: Mapping[str, Any] = {
    get_args(get_type_hints(each)["kind"])[0]: each for each in get_args(KnownEvent)
}


class Block(Model, frozen=True):
    """A block of a stream: `data` is None where it has only the number."""

    id: int | None
    kind: str
    data: str | None

    def event(self) -> Event:
        """The block as an event."""
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
    """Reads the blocks of a stream from its bytes.

    A block counts once the empty line after it has come: one that was cut off is left out, and
    its number with it.  Lines end with a line feed alone: text may hold other separators.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._fields: dict[str, str] = {}

    def feed(self, piece: bytes) -> list[Block]:
        """The blocks that these bytes complete."""
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

"""Server-sent events: the blocks of an event stream, and the events in them."""

from typing import Any

import msgspec

from .base import Model
from .errors import UnexpectedAnswer


class Event(Model, frozen=True):
    """Something that happened, by its number: numbers have no gaps and are in order of commit.

    `kind` is batches, adopted, alarm, limit, annotation, replay, or a word that a later service
    adds; `data` depends on it.
    """

    id: int
    kind: str
    data: dict[str, Any]


class Block(Model, frozen=True):
    """A block of a stream: `data` is None where it has only the number."""

    id: int | None
    kind: str
    data: str | None

    def event(self) -> Event:
        """The block as an event."""
        try:
            data = msgspec.json.decode(self.data or "", type=dict[str, Any])
        except msgspec.DecodeError:
            data = None
        if self.id is None or data is None:
            raise UnexpectedAnswer(f"this is no event of the service: {self}")
        return Event(self.id, self.kind, data)


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

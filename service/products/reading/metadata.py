"""The metadata of a segment of a CCSDS message: its keywords, each with its line."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from service.errors import BadFile
from service.products.reading.epochs import TIME_SYSTEMS, epoch_ns
from service.products.reading.tokens import MessageForm, Source, Token

INERTIAL = ("EME2000", "J2000", "ICRF", "GCRF")
"""One frame for the service, which lets 23 mas between EME2000 and ICRF be."""


@dataclass
class Metadata:
    """Keywords with their values; `line` is that of the end of the metadata."""

    source: Source
    line: int
    values: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)

    def require(self, names: tuple[str, ...]) -> None:
        """Raise `BadFile` naming the first keyword that is missing or empty."""
        for name in names:
            if not self.values.get(name):
                raise self.source.bad(self.line, name, "is missing in the metadata")

    def one_of(self, name: str, known: tuple[str, ...]) -> str:
        """The value of a keyword in capital letters, which must be a known one."""
        value = self.values[name].upper()
        if value not in known:
            raise self.fault(name, f"must be one of {', '.join(known)}")
        return value

    def time_system(self) -> str:
        """The time system, which must be a known one."""
        return self.one_of("TIME_SYSTEM", TIME_SYSTEMS)

    def moment(self, name: str, time_system: str) -> int | None:
        """A time as `Utc.tai_ns`; None where the keyword is not there."""
        if name not in self.values:
            return None
        try:
            return epoch_ns(self.values[name], time_system)
        except ValueError as error:
            raise self.fault(name, str(error)) from None

    def span(self, time_system: str) -> tuple[int, int]:
        """START_TIME and STOP_TIME, which are required and in order."""
        first, last = (self.moment(name, time_system) for name in ("START_TIME", "STOP_TIME"))
        assert first is not None
        assert last is not None
        if first > last:
            raise self.fault("STOP_TIME", "must not be before START_TIME")
        return first, last

    def useable(self, time_system: str) -> tuple[int | None, int | None]:
        """USEABLE_START_TIME and USEABLE_STOP_TIME, None where they are not there."""
        names = ("USEABLE_START_TIME", "USEABLE_STOP_TIME")
        first, last = (self.moment(name, time_system) for name in names)
        return first, last

    def fault(self, name: str, message: str) -> BadFile:
        """The error that names a keyword with its line and value."""
        return self.source.bad(self.lines[name], name, message, self.values[name])


def read_metadata(
    source: Source, tokens: Iterator[Token], line: int, known: tuple[str, ...], form: MessageForm
) -> Metadata:
    """The metadata that begins before the next token, to META_STOP.

    Raises `BadFile` for a keyword that is not `known` in this form of message or comes twice.
    """
    found = Metadata(source, line)
    for token in tokens:
        if token.name == "META_STOP":
            found.line = token.line
            return found
        if token.kind != "key" or token.name not in known:
            raise source.bad_token(token, f"is no keyword of an {form.kind}'s metadata")
        if token.name in found.values:
            raise source.bad_token(token, f"is there already, in line {found.lines[token.name]}")
        found.values[token.name] = token.value
        found.lines[token.name] = token.line
    raise source.bad(line, "META_STOP", "is missing: the file was cut short")


def read_version(
    source: Source, token: Token | None, form: MessageForm, versions: tuple[str, ...]
) -> str:
    """The version, one of `versions`, from the first token of a message."""
    name = f"CCSDS_{form.kind}_VERS"
    if token is None or token.name != name:
        line = 1 if token is None else token.line
        raise source.bad(line, name, "must come first in a message")
    if token.value not in versions:
        raise source.bad_token(token, f"must be {', '.join(versions[:-1])} or {versions[-1]}")
    return token.value

"""The tokens of a CCSDS message, of attitudes or of orbits: the same for KVN and XML.

A message is read as keywords with their values, starts and ends of its parts, and states, each
with its line; the reader of a kind of message need not know which form it has.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO, Any, Literal
from xml.parsers import expat

from service.errors import BadFile, Fault, shown_value
from service.products.reading.epochs import epoch_ns

MAX_LINE_BYTES = 4096
_PIECE_BYTES = 1 << 16
_MOST_DEPTH = 12
_PAIR = re.compile(r"([A-Za-z0-9_]+)\s*=\s*(.*)")
_UNIT = re.compile(r"\s*\[[^\]]*\]$")


@dataclass(frozen=True)
class Token:
    """A keyword, a mark or a state, with its line.

    `words` of a state are its epoch and numbers; in XML with the `names` of its elements.
    """

    line: int
    kind: Literal["key", "mark", "state"]
    name: str
    value: str = ""
    words: tuple[str, ...] = ()
    names: tuple[str, ...] | None = None


@dataclass(frozen=True)
class MessageForm:
    """How a kind of message is written.

    In KVN `marks` stand alone in their lines, and lines without keyword are states after one of
    `before_states`.  In XML the elements `parts` stand for the marks of their start and end, and
    `state` is the element of a state.
    """

    kind: str
    marks: tuple[str, ...]
    before_states: tuple[str, ...]
    parts: Mapping[str, tuple[str, str]]
    state: str


AEM = MessageForm(
    kind="AEM",
    marks=("META_START", "META_STOP", "DATA_START", "DATA_STOP"),
    before_states=("DATA_START",),
    parts={"metadata": ("META_START", "META_STOP"), "data": ("DATA_START", "DATA_STOP")},
    state="attitudeState",
)
OEM = MessageForm(
    kind="OEM",
    marks=("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"),
    before_states=("META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"),
    parts={
        "metadata": ("META_START", "META_STOP"),
        "covarianceMatrix": ("COVARIANCE_START", "COVARIANCE_STOP"),
    },
    state="stateVector",
)


@dataclass(frozen=True)
class Source:
    """A file by its name in messages."""

    name: str

    def bad(self, line: int, field: str, message: str, value: object = None) -> BadFile:
        """The error that names file, line and field."""
        shown = None if value is None else shown_value(value)
        return BadFile(Fault(f"{self.name}, line {line}: {field}", message, shown))

    def bad_token(self, token: Token, message: str) -> BadFile:
        """The error that names a token and its line."""
        return self.bad(token.line, token.name, message, token.value or None)

    def epoch_ns(self, token: Token, word: str, time_system: str) -> int:
        """The epoch of a state as `Utc.tai_ns`; raises `BadFile` for any other word."""
        try:
            return epoch_ns(word, time_system)
        except ValueError as error:
            raise self.bad(token.line, "EPOCH", str(error), word) from None

    def number(self, token: Token, word: str) -> float:
        """A number of a state; raises `BadFile` for any other word."""
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in word:
            raise self.bad(token.line, token.name, "must be a number", word)
        return number

    def named(self, token: Token, names: tuple[str, ...]) -> tuple[str, ...]:
        """The words of an XML state by the names of their elements, each there once."""
        assert token.names is not None
        for name in names:
            if token.names.count(name) != 1:
                raise self.bad(token.line, name, "must be there once in a state")
        found = dict(zip(token.names, token.words, strict=True))
        return tuple(found[name] for name in names)


def tokens_of(source: Source, file: IO[bytes], form: MessageForm) -> Iterator[Token]:
    """The tokens of a message, KVN or XML as the file has it.

    The first is the version.  Raises `BadFile` where the form itself is broken.
    """
    start = file.read(256)
    file.seek(0)
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return _xml(source, file, form)
    return _kvn(source, file, form)


def _kvn(source: Source, file: IO[bytes], form: MessageForm) -> Iterator[Token]:
    inside_data = False
    number = 0
    while data := file.readline(MAX_LINE_BYTES + 1):
        number += 1
        line = _text(source, number, data)
        if not line or line == "COMMENT" or line.startswith("COMMENT "):
            continue
        if line in form.marks:
            inside_data = line in form.before_states
            yield Token(number, "mark", line)
        elif (pair := _PAIR.fullmatch(line)) is not None:
            yield Token(number, "key", pair[1], _UNIT.sub("", pair[2].strip()))
        elif inside_data:
            words = tuple(line.split())
            yield Token(number, "state", "state", words=words)
        else:
            raise source.bad(number, "line", "must be KEYWORD = value", line)


def _text(source: Source, number: int, data: bytes) -> str:
    if len(data) > MAX_LINE_BYTES:
        raise source.bad(number, "line", f"must have at most {MAX_LINE_BYTES} bytes")
    try:
        return data.decode().lstrip("\ufeff").strip()
    except UnicodeDecodeError:
        raise source.bad(number, "line", "must be text", data[:20]) from None


def _xml(source: Source, file: IO[bytes], form: MessageForm) -> Iterator[Token]:
    reader = _XmlReader(source, form)
    while True:
        piece = file.read(_PIECE_BYTES)
        reader.feed(piece)
        yield from reader.taken()
        if not piece:
            return


class _XmlReader:
    """Collects tokens while the parser calls it.  No entity is expanded, nothing is fetched."""

    def __init__(self, source: Source, form: MessageForm) -> None:
        self._source, self._form = source, form
        self._parser = parser = expat.ParserCreate("UTF-8")
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._characters
        parser.StartDoctypeDeclHandler = self._doctype
        self._tokens: list[Token] = []
        self._path: list[str] = []
        self._text: list[str] = []
        self._size = 0
        self._is_leaf = False
        self._line = 0
        self._state: list[tuple[str, str]] | None = None

    def feed(self, piece: bytes) -> None:
        """Read on; a piece without bytes is the end."""
        try:
            self._parser.Parse(piece, not piece)
        except expat.ExpatError as error:
            raise self._source.bad(error.lineno, "XML", expat.ErrorString(error.code)) from None

    def taken(self) -> list[Token]:
        """The tokens since the last call."""
        tokens, self._tokens = self._tokens, []
        return tokens

    @property
    def _here(self) -> int:
        return self._parser.CurrentLineNumber

    def _doctype(self, *_: Any) -> None:
        raise self._source.bad(self._here, "DOCTYPE", "is not read: a message has none")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        if not self._path:
            kind = self._form.kind
            if tag.upper() != kind:
                message = f"must be the element {kind.lower()}"
                raise self._source.bad(self._here, "XML", message, tag)
            version = attributes.get("version", "")
            self._tokens.append(Token(self._here, "key", f"CCSDS_{kind}_VERS", version))
        elif tag in self._form.parts:
            self._tokens.append(Token(self._here, "mark", self._form.parts[tag][0]))
        elif tag == self._form.state:
            self._state, self._line = [], self._here
        self._path.append(tag)
        if len(self._path) > _MOST_DEPTH:
            raise self._source.bad(self._here, tag, f"lies in more than {_MOST_DEPTH} others")
        self._text, self._size, self._is_leaf = [], 0, True

    def _characters(self, text: str) -> None:
        self._size += len(text)
        if self._size > MAX_LINE_BYTES:
            raise self._source.bad(
                self._here, self._path[-1], f"must have at most {MAX_LINE_BYTES} bytes"
            )
        self._text.append(text)

    def _end(self, tag: str) -> None:
        self._path.pop()
        if tag in self._form.parts:
            self._tokens.append(Token(self._here, "mark", self._form.parts[tag][1]))
        elif tag == self._form.state:
            names, words = zip(*self._state or [("", "")], strict=True)
            self._tokens.append(
                Token(self._line, "state", "state", words=tuple(words), names=tuple(names))
            )
            self._state = None
        elif self._is_leaf and tag != "COMMENT":
            value = "".join(self._text).strip()
            if self._state is None:
                self._tokens.append(Token(self._here, "key", tag, value))
            elif len(self._state) < 32:
                self._state.append((tag, value))
        self._is_leaf = False
        self._text, self._size = [], 0

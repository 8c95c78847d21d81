"""Parser of CCSDS messages on attitudes or orbits, KVN or XML: tokens, epochs, metadata.

A message is read as keywords with values, marks at the start and end of its parts, and states, each
with its line; readers of a kind of message need not know its notation.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import IO, Any, Literal
from xml.parsers import expat

from service.ephemerides.attitude_types import SEQUENCES
from service.ephemerides.known import MOST_RECORDS
from service.errors import BadFile, BadInput, Fault, shown_value
from service.times import FIRST_YEAR, LAST_YEAR, TT_LESS_TAI_S, parse_utc

MAX_LINE_BYTES = 4096
_PIECE_BYTES = 1 << 16
_MOST_DEPTH = 12
_PAIR = re.compile(r"([A-Za-z0-9_]+)\s*=\s*(.*)")
_VERSION = re.compile(r"CCSDS_([A-Z]+)_VERS")
_D_TO_E = str.maketrans("dD", "ee")
_UNIT = re.compile(r"\s*\[[^\]]*\]$")


@dataclass(frozen=True)
class Token:
    """Token of a CCSDS message: a keyword, a mark or a state, with its line.

    `words` of a state are its epoch and numbers; in XML with the `names` of its elements, and their
    `units`.
    """

    line: int
    kind: Literal["key", "mark", "state"]
    name: str
    value: str = ""
    words: tuple[str, ...] = ()
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class MessageForm:
    """Notation of one kind of CCSDS message: marks, parts and states.

    In KVN `marks` stand alone in their lines, and lines without keyword are states after one of
    `before_states`.  In XML the elements `parts` replace the marks of start and end, and `state` is
    the element of a state.
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
    """Input file under the name that error messages have; it makes their errors."""

    name: str

    def bad(self, line: int, field: str, message: str, value: object = None) -> BadFile:
        """Error `BadFile` that names file, line and field, with a message and a value."""
        shown = None if value is None else shown_value(value)
        return BadFile(Fault(f"{self.name}, line {line}: {field}", message, shown))

    def bad_token(self, token: Token, message: str) -> BadFile:
        """Error `BadFile` that names a token and its line."""
        return self.bad(token.line, token.name, message, token.value or None)

    def epoch_ns(self, token: Token, word: str, time_system: str) -> int:
        """Epoch of a state as `Utc.tai_ns`; raises `BadFile` for an invalid one."""
        try:
            return epoch_ns(word, time_system)
        except ValueError as error:
            raise self.bad(token.line, "EPOCH", str(error), word) from None

    def number(self, token: Token, word: str) -> float:
        """Number in a state; raises `BadFile` for an invalid one."""
        try:
            # Fortran writes the exponents of double precision with D.
            number = float(word.translate(_D_TO_E))
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in word:
            raise self.bad(token.line, token.name, "must be a number", word)
        return number

    def named(self, token: Token, names: tuple[str, ...]) -> tuple[str, ...]:
        """Values of an XML state by element names, each required once."""
        assert token.names is not None
        for name in names:
            if token.names.count(name) != 1:
                raise self.bad(token.line, name, "must be there once in a state")
        found = dict(zip(token.names, token.words, strict=True))
        return tuple(found[name] for name in names)


def tokens_of(source: Source, file: IO[bytes], form: MessageForm) -> Iterator[Token]:
    """Tokens of a CCSDS message in KVN or XML, recognised by its first bytes.

    The first token is the version.  Raises `BadFile` for invalid notation.
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
        if not line or line.partition(" ")[0].partition("\t")[0] == "COMMENT":
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
    """Parser that collects the tokens of an XML message; expands no entity and fetches nothing."""

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
        self._state: list[tuple[str, str, str]] | None = None
        self._attributes: dict[str, str] = {}

    def feed(self, piece: bytes) -> None:
        """Parse the next piece of an XML message; an empty one marks the end."""
        try:
            self._parser.Parse(piece, not piece)
        except expat.ExpatError as error:
            raise self._source.bad(error.lineno, "XML", expat.ErrorString(error.code)) from None

    def taken(self) -> list[Token]:
        """Tokens of an XML message completed since the last call."""
        tokens, self._tokens = self._tokens, []
        return tokens

    @property
    def _line_number(self) -> int:
        return self._parser.CurrentLineNumber

    def _doctype(self, *_: Any) -> None:
        raise self._source.bad(self._line_number, "DOCTYPE", "is not read: a message has none")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        tag = tag.rpartition(":")[2]
        if not self._path and tag.lower() == "ndm":
            # A combined message with several messages, the form of many catalogs.
            self._path.append("ndm")
            return
        if self._path in ([], ["ndm"]):
            kind = self._form.kind
            is_about_all = bool(self._path) and tag in ("COMMENT", "MESSAGE_ID")
            if tag.upper() != kind and not is_about_all:
                message = f"must be the element {kind.lower()}"
                raise self._source.bad(self._line_number, "XML", message, tag)
            version = attributes.get("version", "")
            if not is_about_all:
                self._tokens.append(Token(self._line_number, "key", f"CCSDS_{kind}_VERS", version))
        elif tag in self._form.parts:
            self._tokens.append(Token(self._line_number, "mark", self._form.parts[tag][0]))
        elif tag == self._form.state:
            self._state, self._line = [], self._line_number
        self._path.append(tag)
        if len(self._path) > _MOST_DEPTH:
            raise self._source.bad(
                self._line_number, tag, f"lies in more than {_MOST_DEPTH} others"
            )
        self._text, self._size, self._is_leaf = [], 0, True
        self._attributes = attributes

    def _characters(self, text: str) -> None:
        self._size += len(text)
        if self._size > MAX_LINE_BYTES:
            raise self._source.bad(
                self._line_number, self._path[-1], f"must have at most {MAX_LINE_BYTES} bytes"
            )
        self._text.append(text)

    def _end(self, tag: str) -> None:
        tag = tag.rpartition(":")[2]
        self._path.pop()
        if tag in self._form.parts:
            self._tokens.append(Token(self._line_number, "mark", self._form.parts[tag][1]))
        elif tag == self._form.state:
            names, words, units = zip(*self._state or [("", "", "")], strict=True)
            state = Token(self._line, "state", "state", words=words, names=names, units=units)
            if self._is_leaf:
                # As in ACM a line of numbers.
                words = tuple("".join(self._text).split())
                state = Token(self._line, "state", "state", words=words)
            self._tokens.append(state)
            self._state = None
        elif self._is_leaf and tag not in ("COMMENT", "MESSAGE_ID"):
            value = "".join(self._text).strip()
            if self._state is None:
                self._tokens.append(Token(self._line_number, "key", tag, value))
            elif len(self._state) < 32:
                # Version 1 names Euler angles in an attribute.
                own = self._attributes
                name = own.get("angle", own.get("rate", tag))
                self._state.append((name, value, own.get("units", "")))
        self._is_leaf = False
        self._text, self._size = [], 0


_LESS_TAI_NS = {"TAI": 0, "GPS": -19 * 10**9, "TT": round(TT_LESS_TAI_S * 1e9)}
"""Nanoseconds by which each uniform time system is ahead of TAI, by name."""
TIME_SYSTEMS = ("UTC", *_LESS_TAI_NS)
_J2000 = datetime(2000, 1, 1, 12)
_DECIMALS = re.compile(r"(.*T\d\d:\d\d:\d\d)(\.\d+)?Z?", re.ASCII)


def epoch_ns(text: str, time_system: str) -> int:
    """Convert an epoch to `Utc.tai_ns`; raises `ValueError` with the expected form.

    Digits beyond the nanosecond are cut off.
    """
    found = _DECIMALS.fullmatch(text)
    if found is None:
        raise ValueError("must be a time as 1996-01-10T12:00:00.000 or 1996-010T12:00:00.000")
    whole, fraction = found[1], (found[2] or ".0")[:10]
    if time_system == "UTC":
        try:
            return parse_utc(whole + fraction).tai_ns
        except BadInput as error:
            raise ValueError(error.faults[0].message) from None
    try:
        form = "%Y-%jT%H:%M:%S" if len(whole) == 17 else "%Y-%m-%dT%H:%M:%S"
        moment = datetime.strptime(whole, form)
    except ValueError:
        raise ValueError("there is no such time") from None
    if not FIRST_YEAR <= moment.year <= LAST_YEAR:
        raise ValueError(f"the year must be from {FIRST_YEAR} to {LAST_YEAR}")
    since = moment - _J2000
    seconds = since.days * 86_400 + since.seconds
    return seconds * 10**9 + int(fraction[1:].ljust(9, "0")) - _LESS_TAI_NS[time_system]


INERTIAL = ("EME2000", "J2000", "ICRF", "GCRF")
"""Names of inertial frames that are treated as equal; EME2000 and ICRF differ by 23 mas."""


@dataclass
class Metadata:
    """Metadata of a message segment: keywords with values; `line` is where they end."""

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
        """Upper-case value of a metadata keyword; raises `BadFile` unless it is one of `known`."""
        value = self.values[name].upper()
        if value not in known:
            raise self.fault(name, f"must be one of {', '.join(known)}")
        return value

    def time_system(self) -> str:
        """Time system of the segment; raises `BadFile` unless it is a known one."""
        return self.one_of("TIME_SYSTEM", TIME_SYSTEMS)

    def moment(self, name: str, time_system: str) -> int | None:
        """Time of a keyword as `Utc.tai_ns`; None if the keyword is missing."""
        if name not in self.values:
            return None
        try:
            return epoch_ns(self.values[name], time_system)
        except ValueError as error:
            raise self.fault(name, str(error)) from None

    def span(self, time_system: str) -> tuple[int, int]:
        """START_TIME and STOP_TIME as `Utc.tai_ns`; both are required and must be in order."""
        first, last = (self.moment(name, time_system) for name in ("START_TIME", "STOP_TIME"))
        assert first is not None
        assert last is not None
        if first > last:
            raise self.fault("STOP_TIME", "must not be before START_TIME")
        return first, last

    def useable(self, time_system: str) -> tuple[int | None, int | None]:
        """USEABLE_START_TIME and USEABLE_STOP_TIME as `Utc.tai_ns`, None if missing."""
        names = ("USEABLE_START_TIME", "USEABLE_STOP_TIME")
        first, last = (self.moment(name, time_system) for name in names)
        return first, last

    def fault(self, name: str, message: str) -> BadFile:
        """Error `BadFile` that names a metadata keyword with its line and value."""
        return self.source.bad(self.lines[name], name, message, self.values[name])


_BODY = re.compile(r"(SC_BODY|SPACECRAFT_BODY|SC_BODY_\w+)")


def from_body(metadata: Metadata) -> bool:
    """True if REF_FRAME_A is the body; raises `BadFile` unless the other frame is inertial."""
    frames = {name: metadata.values[name].upper() for name in ("REF_FRAME_A", "REF_FRAME_B")}
    is_body = {name: bool(_BODY.fullmatch(frame)) for name, frame in frames.items()}
    for name, frame in frames.items():
        if not is_body[name] and frame not in INERTIAL:
            message = f"must be one of {', '.join(INERTIAL)}, or the body as SC_BODY_1"
            raise metadata.fault(name, message)
    if is_body["REF_FRAME_A"] == is_body["REF_FRAME_B"]:
        message = "one of REF_FRAME_A and REF_FRAME_B must be inertial, the other the body"
        raise metadata.fault("REF_FRAME_B", message)
    return is_body["REF_FRAME_A"]


def euler_sequence(metadata: Metadata) -> str:
    """Axes of Euler angles, such as ZXZ, from the required keyword EULER_ROT_SEQ."""
    metadata.require(("EULER_ROT_SEQ",))
    sequence = metadata.values["EULER_ROT_SEQ"].upper().translate(str.maketrans("123", "XYZ"))
    if sequence not in SEQUENCES:
        message = "must name three axes as ZXZ or 313, no two in a row the same"
        raise metadata.fault("EULER_ROT_SEQ", message)
    return sequence


def read_metadata(
    source: Source, tokens: Iterator[Token], line: int, known: tuple[str, ...], form: MessageForm
) -> Metadata:
    """Read metadata from the next token up to META_STOP.

    Raises `BadFile` for a keyword that is not `known` in this kind of message or occurs twice.
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
    """Version of a message from its first token; raises `BadFile` unless one of `versions`."""
    name = f"CCSDS_{form.kind}_VERS"
    if token is None or token.name != name:
        line = 1 if token is None else token.line
        if token is not None and (other := _VERSION.fullmatch(token.name)) is not None:
            raise source.bad(line, token.name, f"is of an {other[1]}, not of an {form.kind}")
        raise source.bad(line, name, "must come first in a message")
    if token.value not in versions:
        known = " or ".join(filter(None, [", ".join(versions[:-1]), versions[-1]]))
        raise source.bad_token(token, f"must be {known}")
    return token.value


class MessageReader:
    """Base class of message readers, which checks objects, times and the number of states."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._object: tuple[str, str] | None = None
        self._records = 0

    @property
    def _object_name(self) -> str:
        assert self._object is not None
        return self._object[0]

    def _check_object(self, metadata: Metadata) -> None:
        """Raise `BadFile` for a segment about another object than the previous ones."""
        about = (metadata.values["OBJECT_NAME"], metadata.values["OBJECT_ID"])
        if self._object not in (None, about):
            differs = "OBJECT_NAME" if self._object_name != about[0] else "OBJECT_ID"
            raise metadata.fault(differs, "must be the same in every segment")
        self._object = about

    def _count_state(self, token: Token, epoch: str, time_ns: int, before: list[int]) -> None:
        """Raise `BadFile` for a state not later than the previous ones, or beyond the limit."""
        if before and time_ns <= before[-1]:
            message = "must be later than that of the state before"
            raise self._source.bad(token.line, "EPOCH", message, epoch)
        self._records += 1
        if self._records > MOST_RECORDS:
            message = f"the file has more than the {MOST_RECORDS:,} states that are read"
            raise self._source.bad(token.line, "states", message)


def useable_span(times: list[int], useable_ns: tuple[int | None, int | None]) -> tuple[int, int]:
    """First and last valid time of a segment: its states, limited to the useable span."""
    first, last = useable_ns
    return (
        times[0] if first is None else max(first, times[0]),
        times[-1] if last is None else min(last, times[-1]),
    )

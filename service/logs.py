"""Logging: format of lines, the request that a line belongs to, and limits on repeated errors.

The standard library's logging does the work; `configure` sets it up, once in each process.  A line
never holds a token, a cookie or a body: none of these is passed to a logger, and secrets in the
text of an error are cut.
"""

import json
import logging
import re
import threading
import time
import traceback
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TextIO

from service.errors import printable

FORMATS = ("text", "json")
LEVELS = ("debug", "info", "warning", "error")
REPEATS_S = 60.0
"""Seconds within which a repeated error is only counted; the count is written afterwards."""

_MAX_COUNTED = 1_000
_MAX_LINE = 300
_SECRET = re.compile(r"(acq_|whsec_)[A-Za-z0-9_+/=-]+")
_PARAMETERS = re.compile(r"\[parameters: [^\n]*")
_PLAIN = re.compile(r"[!#-<>-~]+")
_NUMBER = re.compile(r"\d+")


@dataclass
class RequestContext:
    """Context of a request for log lines: its id, the caller's token name, and the run."""

    id: str
    caller: str | None = None
    run: str | None = None
    behind_s: float = 0.0
    """Lag of trends and alarms in the answer behind the record, in seconds, if large."""


request: ContextVar[RequestContext | None] = ContextVar("request", default=None)
"""Request to which the present log lines belong, also in threads that run handlers."""


@dataclass(frozen=True)
class LogSettings:
    """Format and level of the log, passed on to other processes of the service."""

    format: str
    level: str


_configured: LogSettings | None = None


def configured() -> LogSettings | None:
    """Log settings of this process; None if it has not configured logging."""
    return _configured


def configure(settings: LogSettings, process: str) -> None:
    """Configure logging to standard error; each line names `process`."""
    global _configured
    _configured = settings
    handler = CountingHandler()
    handler.setFormatter(JsonLines(process) if settings.format == "json" else TextLines(process))
    level = logging.getLevelNamesMapping()[settings.level.upper()]
    # Libraries log much at lower levels: keep only their warnings and errors.
    logging.basicConfig(handlers=[handler], level=max(level, logging.WARNING), force=True)
    logging.getLogger("service").setLevel(level)
    logging.getLogger("uvicorn").setLevel(max(level, logging.INFO))


def finish() -> None:
    """Write the pending counts of repeated errors, as a signal ends a process without it."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, CountingHandler):
            handler.write_counts()


class CountingHandler(logging.StreamHandler[TextIO]):
    """Log handler that writes a warning or error once, counts repetitions, and writes the count.

    Two records are the same if their text without arguments, the error, and the place that raised
    it are the same.
    """

    def __init__(self, stream: TextIO | None = None, period_s: float = REPEATS_S) -> None:
        super().__init__(stream)
        self._period_s = period_s
        self._counted: dict[object, _Counted] = {}
        self._timer: threading.Timer | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Write a log record, or count it as a repetition."""
        if record.levelno >= logging.WARNING and self._is_repeated(record):
            return
        super().emit(record)

    def _is_repeated(self, record: logging.LogRecord) -> bool:
        # The caller holds the handler's lock.
        key = _kind(record)
        if key not in self._counted and len(self._counted) >= _MAX_COUNTED:
            key = (record.name, record.levelno)
        known = self._counted.get(key)
        if known is not None:
            known.count += 1
            known.last = record
            return True
        self._counted[key] = _Counted(record, time.monotonic() + self._period_s)
        self._set_timer()
        return False

    def _set_timer(self) -> None:
        if self._timer is None and self._counted:
            until_s = min(each.until_s for each in self._counted.values())
            self._timer = threading.Timer(max(0.0, until_s - time.monotonic()), self._tell)
            self._timer.daemon = True
            self._timer.start()

    def _tell(self) -> None:
        self.acquire()
        try:
            self._timer = None
            now_s = time.monotonic()
            for key, known in list(self._counted.items()):
                if now_s < known.until_s:
                    continue
                if known.count:
                    self._write_count(known)
                    known.count, known.until_s = 0, now_s + self._period_s
                else:
                    del self._counted[key]
            self._set_timer()
        finally:
            self.release()

    def _write_count(self, known: "_Counted") -> None:
        last = known.last
        message = f"repeated {known.count} times within {self._period_s:g} s: {last.getMessage()}"
        count_record = logging.LogRecord(
            last.name, last.levelno, last.pathname, last.lineno, message, None, None
        )
        # The count is about many requests, not the one in progress in this thread.
        vars(count_record).update(repeated=known.count, about=None)
        super().emit(count_record)

    def write_counts(self) -> None:
        """Write the pending counts of repetitions, and reset them."""
        self.acquire()
        try:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            for known in self._counted.values():
                if known.count:
                    self._write_count(known)
            self._counted.clear()
        finally:
            self.release()

    def close(self) -> None:
        """Write the pending counts of repetitions, and close the handler."""
        self.write_counts()
        super().close()


@dataclass
class _Counted:
    last: logging.LogRecord
    until_s: float
    count: int = field(default=0)


def _kind(record: logging.LogRecord) -> object:
    """Key under which log records count as equal; numbers in an error's text are ignored."""
    arguments = record.args if isinstance(record.args, tuple) else ()
    errors = tuple(
        (type(each).__name__, _NUMBER.sub("#", str(each)[:_MAX_LINE]))
        for each in arguments
        if isinstance(each, BaseException)
    )
    raised: tuple[object, ...] = ()
    if record.exc_info and (kind := record.exc_info[0]) is not None:
        frames = traceback.extract_tb(record.exc_info[2], limit=-1)
        raised = kind.__name__, *((each.filename, each.lineno) for each in frames)
    return record.name, record.levelno, str(record.msg), errors, raised


class _Lines(logging.Formatter):
    """Base class of both log formats."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def fields(self, record: logging.LogRecord) -> dict[str, object]:
        """Fields of a log line, in order; fields without a value are left out."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        about: RequestContext | None = getattr(record, "about", request.get())
        values: dict[str, object | None] = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": record.getMessage(),
            "request_id": about and about.id,
            "caller": about and about.caller,
            "run": getattr(record, "run", None) or (about and about.run),
            "repeated": getattr(record, "repeated", None),
            **getattr(record, "access", {}),
        }
        return {
            name: _harmless(value) if isinstance(value, str) else value
            for name, value in values.items()
            if value is not None
        }

    def error(self, record: logging.LogRecord) -> list[str]:
        """Lines of a log record's traceback; empty without an exception."""
        if not record.exc_info or record.exc_info[0] is None:
            return []
        return _harmless(self.formatException(record.exc_info)).splitlines()


class TextLines(_Lines):
    """Log format for people: a line for each record; a traceback follows in lines of its own."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a log record as text."""
        fields = self.fields(record)
        head = " ".join(str(fields.pop(each)) for each in ("time", "level", "process", "logger"))
        message = printable(str(fields.pop("message")))
        rest = "".join(
            f" {name}={_quoted(str(value))}"
            for name, value in fields.items()
            if name not in ("method", "path", "status", "duration_ms")
        )
        raised = "".join(f"\n    {printable(each)}" for each in self.error(record))
        return f"{head}: {message}{rest}{raised}"


class JsonLines(_Lines):
    """Log format with one JSON object in each line."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a log record as JSON."""
        fields = self.fields(record)
        if raised := self.error(record):
            fields["error"] = "\n".join(raised)
        return json.dumps(fields)


def _harmless(text: str) -> str:
    """Remove tokens and statements' parameters from a text, and cut long lines."""
    text = _PARAMETERS.sub("[parameters: not shown]", _SECRET.sub(r"\1(not shown)", text))
    return "\n".join(
        line if len(line) <= _MAX_LINE else line[: _MAX_LINE - 1] + "…"
        for line in text.splitlines()
    )


def _quoted(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else json.dumps(text)

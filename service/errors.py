"""Exceptions of the service, in one tree.

    AcquisitionError
    ├── BadInput              invalid input: names the field and the value
    │   ├── BadBatch          a batch, an option, a query
    │   ├── BadFile           a telemetry or catalog file: names line and column
    │   └── NotAvailable      a feature that this version or installation lacks
    ├── Conflict              the batch id is taken by another body
    ├── KeyReused             the Idempotency-Key was used with another body
    ├── WrongState            the state does not allow this, as of a cleared alarm
    ├── NotFound              no such spacecraft, batch, zone, run or replay
    │   └── UnknownSpacecraft no mission of that name
    ├── Unauthenticated       the token is absent, unknown, expired or revoked
    ├── Forbidden             the token lacks the scope or the spacecraft
    ├── RateLimited           more requests than the token's rate allows
    ├── BadConfiguration      a mission file, a setting: names file, key and allowed values
    └── Busy                  the queue is full, or the database does not answer
        ├── BeingBuilt        another thread builds what the work needs
        └── Stopping          the service is stopping: a later attempt here will fail too

An unidentified star is a result and raises nothing.  This module does not know HTTP; the status
codes are given in `service.web.requests.problems`.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fault:
    """Fault of an input: the field, the expected value, and the given value."""

    field: str
    message: str
    value: str | None = None

    def __str__(self) -> str:
        shown = "" if self.value is None else f" (got {self.value})"
        # Names and values come from files and requests, and are shown on terminals: escape them.
        return printable(f"{self.field}: {self.message}{shown}")


def printable(text: str) -> str:
    """Escape characters that would begin a line or move a terminal's cursor."""
    if text.isprintable():
        return text
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )


def shown_value(value: object) -> str:
    """Format a value for a message, cut to 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else text[:79] + "…"


class AcquisitionError(Exception):
    """Base class of every error that the service raises itself."""


class BadInput(AcquisitionError):
    """Error for invalid input, with every fault found in it."""

    def __init__(self, faults: Iterable[Fault] | Fault) -> None:
        self.faults = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("; ".join(str(fault) for fault in self.faults))

    def __reduce__(self) -> tuple[type["BadInput"], tuple[tuple[Fault, ...]]]:
        # Pickling would otherwise pass the text in place of the faults.
        return type(self), (self.faults,)


class BadBatch(BadInput):
    """Error for an invalid batch, option or query."""


class BadFile(BadInput):
    """Error for an invalid file; names line and column."""


class Conflict(AcquisitionError):
    """Error for another body under a (spacecraft, run, batch) that is already recorded."""


class KeyReused(AcquisitionError):
    """Error for another body under an Idempotency-Key that is already used."""


class WrongState(AcquisitionError):
    """Error for an operation that the state of its object does not allow."""


class NotFound(AcquisitionError):
    """Error for a missing object; names it, and the existing ones if they are few."""


class UnknownSpacecraft(NotFound):
    """Error for the name of a spacecraft without a mission."""


class NotAvailable(BadInput):
    """Error for a feature of the interface that this version or installation lacks."""


class Unauthenticated(AcquisitionError):
    """Error for an absent, unknown, expired or revoked token; the message does not say which."""


class Forbidden(AcquisitionError):
    """Error for a valid token whose scopes or spacecraft do not cover the request."""


class RateLimited(AcquisitionError):
    """Error for more requests than a token's rate allows; trying again later will succeed."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class BadConfiguration(AcquisitionError):
    """Error in a mission file or a setting: names file, key and allowed values."""


class Busy(AcquisitionError):
    """Error for work that the service cannot take now; trying again later may succeed."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class BeingBuilt(Busy):
    """Error while another thread builds a needed part of the sky; `done` is its future."""

    def __init__(self, done: "Future[Any]") -> None:
        super().__init__("a part of the sky that this needs is built for the first time", 5)
        self.done = done


class Stopping(Busy):
    """Error while the service is stopping: this process will take no more work."""


def problem_of(error: Exception) -> dict[str, Any]:
    """Fields `detail` and `errors` of an error, the same in HTTP, replays and files.

    `detail` is the first fault with the number of the others; `errors` has every field and value,
    and is absent where the error is about no field.
    """
    if not isinstance(error, BadInput):
        return {"detail": str(error)}
    return problem_of_faults(error.faults)


def problem_of_faults(faults: Sequence[Fault]) -> dict[str, Any]:
    """Fields `detail` and `errors` for faults without an exception."""
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return {
        "detail": f"{faults[0]}{more}",
        "errors": [
            {"field": each.field, "message": each.message, "value": each.value} for each in faults
        ],
    }

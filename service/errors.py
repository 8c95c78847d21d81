"""Every exception that the service raises on purpose.

    AcquisitionError
    ├── BadInput              what a client sent: names the field and the value
    │   ├── BadBatch          a batch, an option, a query
    │   └── BadFile           a telemetry or catalog file: names line and column
    ├── Conflict              another body under a batch id that is taken
    ├── KeyReused             another body under an Idempotency-Key that is taken
    ├── NotNow                an alarm is acknowledged or cleared already
    ├── NotFound              no such spacecraft, batch, zone, run or replay
    ├── NotAvailable          asked for something that is not there yet
    ├── NotAdmitted           nobody is known by this token: absent, unknown, expired, revoked
    ├── NotAllowed            known, but this is not theirs: a scope, another spacecraft
    ├── TooOften              more requests than the token's rate allows
    ├── BadConfiguration      a mission file, a setting: names file, key and allowed values
    └── Busy                  the writer's queue is full, or the database cannot be reached now
        └── Stopping          the service is stopping: here, later will not succeed

Not finding a star is a result and raises nothing.  Nothing here knows HTTP;
the status codes are given in `service.web.errors`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with an input: where it stands, what it was, what is asked for."""

    field: str
    message: str
    value: str | None = None

    def __str__(self) -> str:
        shown = "" if self.value is None else f" (got {self.value})"
        return f"{self.field}: {self.message}{shown}"


def shown_value(value: object, limit: int = 80) -> str:
    """A value as text for a message, cut to `limit` characters."""
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"


class AcquisitionError(Exception):
    """The root of every error that the service raises on purpose."""


class BadInput(AcquisitionError):
    """An input that is refused, with every fault found in it."""

    def __init__(self, faults: Iterable[Fault] | Fault) -> None:
        self.faults = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("; ".join(str(fault) for fault in self.faults))

    def __reduce__(self) -> tuple[type["BadInput"], tuple[tuple[Fault, ...]]]:
        # Made anew elsewhere of what it was made of here, not of its text.
        return type(self), (self.faults,)


class BadBatch(BadInput):
    """A batch, an option or a query that is refused."""


class BadFile(BadInput):
    """A file that is refused, with the line and the column where it is damaged."""


class Conflict(AcquisitionError):
    """Another body under a (spacecraft, run, batch) that is already recorded."""


class KeyReused(AcquisitionError):
    """Another body under an Idempotency-Key that is already taken."""


class NotNow(AcquisitionError):
    """What was asked does not fit the state that the thing is in."""


class NotFound(AcquisitionError):
    """No such thing: names what was asked for and, where the list is short, what there is."""


class NotAvailable(BadInput):
    """Something the interface names that this version does not do yet."""


class NotAdmitted(AcquisitionError):
    """No token, or one that nobody is known by; which of these is not told."""


class NotAllowed(AcquisitionError):
    """The token is good, but its scopes or its spacecraft do not cover what was asked."""


class TooOften(AcquisitionError):
    """More requests than a token's rate allows; trying again later will succeed."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class BadConfiguration(AcquisitionError):
    """A mistake in a mission file or a setting: names file, key and allowed values."""


class Busy(AcquisitionError):
    """The service cannot take the work now; trying again later may succeed."""

    def __init__(self, message: str, retry_after_s: int = 1) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class Stopping(Busy):
    """The service is stopping: the same process will not take the work any more."""


def problem_of(error: Exception) -> dict[str, Any]:
    """What an error says of an input, in one form wherever it is told: `detail`, and its `errors`.

    `detail` is the first fault with the number of the others; `errors` names
    every field and value, and is absent where the error is about no field.
    """
    if not isinstance(error, BadInput):
        return {"detail": str(error)}
    return problem_of_faults(error.faults)


def problem_of_faults(faults: Sequence[Fault]) -> dict[str, Any]:
    """The same of faults that no exception carries."""
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return {
        "detail": f"{faults[0]}{more}",
        "errors": [
            {"field": each.field, "message": each.message, "value": each.value} for each in faults
        ],
    }

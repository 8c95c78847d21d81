"""Every exception that the client raises, and the statuses of HTTP that they stand for.

    ClientError
    ├── InvalidArgument         an argument that no request can carry
    ├── NoAnswer                no service answers, or none long enough
    ├── UnexpectedAnswer        something else than this service answers
    ├── EventsLost              the service no longer keeps events that were missed
    ├── ReplayEnded             a replay ended before its file did
    ├── PackageMissing          a table needs a package that is not installed
    └── Problem                 the service refuses; `type` is that of its problem document
        ├── BadInput            invalid input: `errors` names each field and value
        │   ├── NotAvailable    a feature that this version or installation lacks
        │   └── KeyReused       the Idempotency-Key was used with another body
        ├── Unauthenticated     the token is absent, unknown, expired or revoked
        ├── Forbidden           the token lacks the scope or the spacecraft
        ├── NotFound            no such spacecraft, batch, alarm or replay
        ├── Conflict            the batch id is taken by another body; a gyro block likewise
        ├── WrongState          the state does not allow this, as of a cleared alarm
        ├── Busy                try again later: after `retry_after_s`
        │   └── RateLimited     more requests than the token's rate allows
        └── ServiceFailed       a fault of the service, whose log has the cause

Not finding a star is a result and raises nothing.  Nothing but this module knows a status.
"""

from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING

import httpx
import msgspec

from .models.problems import ProblemDocument

if TYPE_CHECKING:
    from .models import Replay


class ClientError(Exception):
    """Base class of every error that the client raises itself."""


class InvalidArgument(ClientError, ValueError):
    """Error for an argument that no request can carry; the message holds no secret."""


class NoAnswer(ClientError):
    """Error if no service answers at the address for as long as the client waits."""


class UnexpectedAnswer(ClientError):
    """Error for an answer from another program, or from an unknown version of the service."""


class EventsLost(ClientError):
    """Error if the service no longer keeps some of the events that were missed.

    Those after `after` and up to `resumes_after` are lost: read the data concerned again, and
    continue with the events after `resumes_after`.
    """

    def __init__(self, after: int | None, resumes_after: int) -> None:
        self.after, self.resumes_after = after, resumes_after
        super().__init__(
            f"the service no longer keeps all events after {after}; "
            f"it can go on after {resumes_after}"
        )


class ReplayEnded(ClientError):
    """Error for a replay that ended before its file did; `replay` is its last state."""

    def __init__(self, replay: "Replay") -> None:
        self.replay = replay
        reason = f": {replay.errors[-1].problem.detail}" if replay.errors else ""
        lines = replay.lines.done
        super().__init__(f"the replay {replay.id} ended as {replay.state} at line {lines}{reason}")


class PackageMissing(ClientError):
    """Error for a table that needs a missing package; the message has the install command."""


class Problem(ClientError):
    """Error for a request that the service refuses.

    `status` is that of HTTP, `type` a page of the service such as `/problems/bad-input`; `detail`
    has the fault in a sentence, `errors` every fault, field by field.
    """

    def __init__(self, document: ProblemDocument, retry_after_s: float | None = None) -> None:
        self.document, self.retry_after_s = document, retry_after_s
        self.status, self.type = document.status, document.type
        self.detail, self.errors = document.detail, document.errors
        super().__init__(document.detail)


class BadInput(Problem):
    """Error for invalid input: the same request will fail again."""


class NotAvailable(BadInput):
    """Error for a feature that this version or installation of the service lacks."""


class KeyReused(BadInput):
    """Error for an Idempotency-Key that was used with another body."""


class Unauthenticated(Problem):
    """Error for an absent, unknown, expired or revoked token."""


class Forbidden(Problem):
    """Error for a token without the scope of the request, or limited to other spacecraft."""


class NotFound(Problem):
    """Error for a spacecraft, batch, alarm or replay that is missing, or hidden from the token."""


class Conflict(Problem):
    """Error for a batch id, block name or sample time that another body has already."""


class WrongState(Problem):
    """Error for an action in the wrong state: an alarm already cleared, a replay ended."""


class Busy(Problem):
    """Error if the service cannot take the request now; repeating it later may succeed."""


class RateLimited(Busy):
    """Error for more requests than the token's rate allows, or more event streams."""


class ServiceFailed(Problem):
    """Error for a fault of the service, or a status that the client does not know."""


_BY_TYPE: dict[str, type[Problem]] = {
    "/problems/not-available": NotAvailable,
    "/problems/key-reused": KeyReused,
    "/problems/not-now": WrongState,
}
_BY_STATUS: dict[int, type[Problem]] = {
    400: BadInput,
    401: Unauthenticated,
    403: Forbidden,
    404: NotFound,
    405: NotAvailable,
    408: Busy,
    409: Conflict,
    413: BadInput,
    415: BadInput,
    421: Forbidden,
    422: BadInput,
    429: RateLimited,
    431: BadInput,
    502: Busy,
    503: Busy,
    504: Busy,
}


def problem_of(response: httpx.Response) -> Problem:
    """Build the error for an answer with a problem; the answer's body must have been read."""
    try:
        document = msgspec.json.decode(response.content, type=ProblemDocument)
    except msgspec.DecodeError:
        # The answer may come from a proxy, not from the service.
        status, text = response.status_code, response.text[:200].strip()
        detail = f"HTTP {status}: {text}" if text else f"HTTP {status}"
        if response.is_redirect and (place := response.headers.get("Location")):
            leads = response.request.url.join(place)
            detail = f"HTTP {status} leads to {leads}: give the client that address"
        document = ProblemDocument(
            type="about:blank",
            title=response.reason_phrase,
            status=status,
            detail=detail,
            instance=response.request.url.path,
        )
    kind = _BY_TYPE.get(document.type) or _BY_STATUS.get(response.status_code, ServiceFailed)
    return kind(document, retry_after_s(response))


def retry_after_s(response: httpx.Response) -> float | None:
    """Seconds to wait by `Retry-After` (RFC 9110), as a number or a date; None without one.

    The date is compared with the service's own clock where the answer has its `Date`.
    """
    text = response.headers.get("Retry-After", "").strip()
    if text.isascii() and text.isdigit():
        return float(text[:9])
    until = _date(text)
    if until is None:
        return None
    now = _date(response.headers.get("Date", "")) or datetime.now(UTC)
    return max(0.0, (until - now).total_seconds())


def _date(text: str) -> datetime | None:
    try:
        found = parsedate_to_datetime(text)
    except (ValueError, OverflowError):
        return None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)

"""Decision whether and when to send a request again, and when to give up."""

import random
import time
from enum import Enum

import httpx

from .errors import Busy, NoAnswer, Problem, RateLimited

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 5.0


class Repeat(Enum):
    """Condition under which a request may be sent again."""

    ALWAYS = "a second one changes nothing"
    IF_REFUSED = "unless the service may have received it"
    NEVER = "its body can be read once only"


class Patience:
    """Waiting times between attempts of one request, or one stream, until giving up.

    Waits double from 0.1 s to 5 s, less a random part, so that many clients do not return at the
    same moment.  They are longer where the service asks for it (`Retry-After`), and the client
    gives up at once where that would take longer than `give_up_after_s`.  This time counts from the
    first failure: a slow attempt that fails is followed by another one.
    """

    def __init__(self, give_up_after_s: float, repeat: Repeat = Repeat.ALWAYS) -> None:
        self._give_up_after_s = give_up_after_s
        self._repeat = repeat
        self.progressed()

    def answered(self) -> None:
        """Note that the service answers: the time until giving up restarts at the next failure."""
        self._deadline_s: float | None = None

    def progressed(self) -> None:
        """Note progress: the next wait is short, and the time until giving up restarts."""
        self.answered()
        self._wait_s = FIRST_WAIT_S

    def after_problem(self, problem: Problem) -> float:
        """Seconds until the request should be sent again; raises `problem` if it should not."""
        is_refused = isinstance(problem, RateLimited) and self._repeat is Repeat.IF_REFUSED
        may_repeat = isinstance(problem, Busy) and self._repeat is Repeat.ALWAYS
        if not (is_refused or may_repeat):
            raise problem
        wait_s = self._next_wait_s(problem.retry_after_s or 0.0)
        if wait_s is None:
            raise problem
        return wait_s

    def after_loss(self, error: httpx.RequestError, url: httpx.URL) -> float:
        """Seconds until a lost request is sent again; raises `NoAnswer` if it should not be."""
        is_unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
        may_repeat = self._repeat is Repeat.ALWAYS or (
            is_unsent and self._repeat is Repeat.IF_REFUSED
        )
        # A request that cannot be sent as it is would fail at the next attempt as well.
        is_faulty = isinstance(error, httpx.LocalProtocolError | httpx.UnsupportedProtocol)
        wait_s = self._next_wait_s() if may_repeat and not is_faulty else None
        if wait_s is None:
            raise NoAnswer(f"{url} gives no answer ({shown(error)})") from None
        return wait_s

    def after_end(self) -> float:
        """Seconds until a stream that ended should be opened again."""
        return self._next_wait_s() or FIRST_WAIT_S

    def _next_wait_s(self, asked_s: float = 0.0) -> float | None:
        now_s = time.monotonic()
        if self._deadline_s is None:
            self._deadline_s = now_s + self._give_up_after_s
        wait_s = max(self._wait_s * random.uniform(0.5, 1.0), asked_s)
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        return wait_s if now_s + wait_s <= self._deadline_s else None


def shown(error: Exception) -> str:
    """Message of an error, or the name of its class if it has none."""
    return str(error) or type(error).__name__

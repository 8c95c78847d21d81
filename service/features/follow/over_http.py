"""Submission of stream messages to a service over HTTP."""

from acquire_client import AsyncClient
from acquire_client import errors as answers
from acquire_client.encoding import path_of
from acquire_client.retrying import Repeat

from service.errors import BadConfiguration
from service.features.follow.follower import Answer, NotNow, Refused, gyro_block_in

RECORDED = (200, 201)
"""HTTP statuses of a message recorded before, and of one recorded now."""
MISDIRECTED = 421
"""HTTP status of a service that does not accept the host name in the request."""
PATH_TOO_LONG = (414, 431)
"""HTTP statuses of a request line that a long spacecraft name makes too long."""
FAILED = 500


class OverHttp:
    """Submits messages through the HTTP client.

    Raises the client's exceptions if the service requires a token, or another host name.
    """

    def __init__(self, client: AsyncClient) -> None:
        self._client = client

    async def require_scope(self) -> None:
        """Raise `BadConfiguration` if the token lacks the scope to submit."""
        if "submit" not in (await self._client.session()).scopes:
            raise BadConfiguration("ACQUIRE_TOKEN: the token lacks the scope `submit`")

    async def __call__(self, message: bytes) -> Answer:
        """Submit a message; returns the answer of the service once committed."""
        path, body = path_of("batches"), message
        if (block := gyro_block_in(message)) is not None:
            spacecraft, body = block
            path = path_of("spacecraft", spacecraft, "gyro")
        try:
            response = await self._client.request("POST", path, body=body, repeat=Repeat.ALWAYS)
        except answers.Unauthenticated:
            raise
        except (answers.Busy, answers.NoAnswer) as error:
            raise NotNow(str(error)) from None
        except answers.Problem as problem:
            if problem.status == MISDIRECTED:
                raise
            if not _is_about_message(problem):
                raise NotNow(problem.detail) from None
            raise Refused(
                _problem_of(problem), isinstance(problem, answers.ServiceFailed)
            ) from None
        kind = response.headers.get("Content-Type", "").partition(";")[0].strip().lower()
        if response.status_code not in RECORDED or kind != "application/json":
            raise NotNow(
                f"HTTP {response.status_code} with {kind or 'no Content-Type'} "
                "is no answer of the service"
            )
        return Answer(response.content, response.headers.get("Replayed") == "true")


def _is_about_message(problem: answers.Problem) -> bool:
    """True if the service refused the message itself; False if a proxy, for example, answered.

    The client gives an answer that is no problem document the detail `HTTP 404: ...`.
    """
    is_of_service = not problem.detail.startswith(f"HTTP {problem.status}")
    return is_of_service or problem.status in (*PATH_TOO_LONG, FAILED)


def _problem_of(error: answers.Problem) -> dict[str, object]:
    errors = [
        {"field": fault.field, "message": fault.message, "value": fault.value}
        for fault in error.errors or ()
    ]
    return {
        "type": error.type,
        "status": error.status,
        "detail": error.detail,
        "errors": errors,
    }

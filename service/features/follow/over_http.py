"""Submits the messages of a stream to a service over HTTP."""

from acquire_client import AsyncClient
from acquire_client import errors as answers
from acquire_client.encoding import path_of
from acquire_client.retrying import Repeat

from service.errors import BadConfiguration
from service.features.follow.follower import Answer, NotNow, Refused, gyro_block_in

RECORDED = (200, 201)
"""The statuses of a message that was recorded before, and of one that is recorded now."""
MISDIRECTED = 421
"""The status where the service does not know itself by the name in its address."""
PATH_TOO_LONG = (414, 431)
"""The statuses where the name of a spacecraft makes the request line too long."""
FAILED = 500


class OverHttp:
    """Submits through a client.

    Raises what the client does where the service wants a token, or another name of its host.
    """

    def __init__(self, client: AsyncClient) -> None:
        self._client = client

    async def require_scope(self) -> None:
        """Raise `BadConfiguration` where the token may not submit."""
        if "submit" not in (await self._client.session()).scopes:
            raise BadConfiguration("ACQUIRE_TOKEN: the token lacks the scope `submit`")

    async def __call__(self, message: bytes) -> Answer:
        """The answer of the service once it has committed."""
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
    """False if a proxy answered, for example: the same message may be recorded later.

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

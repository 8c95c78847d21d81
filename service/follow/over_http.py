"""Submits the messages of a stream to a service over HTTP."""

from acquire_client import AsyncClient
from acquire_client import errors as answers
from acquire_client.encoding import path_of
from acquire_client.retrying import Repeat

from service.errors import BadConfiguration
from service.follow.follower import Answer, NotNow, Refused, gyro_block_in


class OverHttp:
    """Submits through a client; raises what the client does where the service wants a token."""

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
            raise Refused(
                _problem_of(problem), isinstance(problem, answers.ServiceFailed)
            ) from None
        return Answer(response.content, response.headers.get("Replayed") == "true")


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

"""Batches: submit them, read their results, try other options."""

from collections.abc import AsyncIterator, Mapping
from typing import Any, Literal, overload

from .. import models
from ..base import Outcome, Status
from ..encoding import Batch, Time, decoded, path_of
from ..errors import Problem
from ..outcomes import BatchOutcome, RecordedAnswer
from ..retrying import Repeat
from .backend import Source, bounded_map
from .connection import AsyncConnection, AsyncItems


class AsyncBatches(AsyncConnection):
    """The part of the client that is about batches."""

    async def submit(self, batch: Batch, *, idempotency_key: str | None = None) -> models.Answer:
        """Identify the stars of a batch, solve for the attitude, and record both.

        Spacecraft, run and batch id identify the batch: to send it again is harmless, and gives
        the first answer.  Raises `BadInput` naming each field, `Conflict` where another body has
        this batch id.

        >>> answer = await client.submit(batch)
        >>> answer.counts.unique, answer.attitude.status
        (4, 'good')
        """
        recorded = await self.submit_json(batch, idempotency_key=idempotency_key)
        return recorded.answer

    async def submit_json(
        self, batch: Batch, *, idempotency_key: str | None = None
    ) -> RecordedAnswer:
        """The same, with the answer as it is recorded, and whether it was recorded before.

        >>> recorded = await client.submit_json(batch)
        >>> recorded.replayed
        True
        """
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        response = await self.request(
            "POST", path_of("batches"), body=batch, headers=headers, repeat=Repeat.ALWAYS
        )
        return RecordedAnswer(response.content, response.headers.get("Replayed") == "true")

    async def submit_many(
        self, batches: Source[Batch], *, at_once: int = 8
    ) -> AsyncIterator[BatchOutcome]:
        """Submit batches as they are taken from `batches`, at most `at_once` at a time.

        The outcomes come in the same order: an answer, or the problem of a batch that was
        refused.  Where batches come slowly, `submit` each: an outcome may wait for the next batch.
        For whole files, `replay` is faster.

        >>> [outcome.problem async for outcome in client.submit_many([batch, batch])]
        [None, None]
        """
        async for outcome in bounded_map(self._outcome, batches, at_once):
            yield outcome

    async def _outcome(self, batch: Batch) -> BatchOutcome:
        try:
            recorded = await self.submit_json(batch)
        except Problem as problem:
            return BatchOutcome(batch, None, problem)
        return BatchOutcome(batch, recorded, None)

    def batches(
        self,
        spacecraft: str | None = None,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        outcome: Outcome | None = None,
        status: Status | Literal["no_attitude"] | None = None,
        batch: str | None = None,
    ) -> AsyncItems[models.Summary]:
        """The current results of recorded batches, newest first by batch time.

        `run` is `*` for all runs; `end` is excluded; `outcome` asks for at least one such star.

        >>> [found.batch async for found in client.batches("XTE")]
        ['1996-010-0110']
        """
        query = {
            "spacecraft": spacecraft,
            "run": run,
            "start": start,
            "end": end,
            "outcome": outcome,
            "status": status,
            "batch": batch,
        }
        return AsyncItems(self, models.Summary, path_of("batches"), query)

    async def batch(self, id: str) -> models.Result:
        """One recorded result with its batch; raises `NotFound`."""
        return await self.get(models.Result, path_of("batches", id))

    async def latest(self, spacecraft: str, *, run: str = "live") -> models.Result:
        """The newest result of a spacecraft by batch time; raises `NotFound` without a batch.

        >>> latest = await client.latest("XTE")
        >>> latest.answer.attitude.status
        'good'
        """
        return await self.get(
            models.Result, path_of("spacecraft", spacecraft, "latest"), {"run": run}
        )

    @overload
    async def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[True]
    ) -> models.Answer: ...

    @overload
    async def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[False] = False
    ) -> models.WhatIf: ...

    @overload
    async def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool
    ) -> models.Answer | models.WhatIf: ...

    async def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool = False
    ) -> models.Answer | models.WhatIf:
        """Process a recorded batch again with other options; `record` keeps the result beside it.

        >>> latest = await client.latest("XTE")
        >>> votes = await client.what_if(latest.answer.id, {"identifier": "starid"})
        >>> votes.counts.ambiguous, votes.id
        (1, None)
        """
        body = {"options": dict(options), "record": record}
        path = path_of("batches", id, "what-if")
        if record:
            return await self.post(models.Answer, path, body)
        return await self.post(models.WhatIf, path, body, Repeat.ALWAYS)

    async def adopt(self, id: str, options: Mapping[str, Any]) -> models.Answer:
        """Process a recorded batch again, and let the result stand for the batch.

        >>> latest = await client.latest("XTE")
        >>> adopted = await client.adopt(latest.answer.id, {"identifier": "verified"})
        >>> found = await client.batch(adopted.id)
        >>> found.current
        True
        """
        body = {"options": dict(options), "adopt": True}
        return await self.post(models.Answer, path_of("batches", id, "what-if"), body)

    async def solve_picture(
        self,
        picture: bytes,
        *,
        spacecraft: str | None = None,
        field_of_view_deg: float | None = None,
    ) -> models.Picture:
        """Find the attitude, the lens and the stars of a picture of any camera; records nothing.

        `picture` is the content of its file; a `spacecraft` is the one whose camera took it.
        """
        response = await self.request(
            "POST",
            path_of("pictures"),
            query={"spacecraft": spacecraft, "field_of_view_deg": field_of_view_deg},
            content=picture,
            headers={"Content-Type": "application/octet-stream"},
            repeat=Repeat.ALWAYS,
        )
        return decoded(response, models.Picture)

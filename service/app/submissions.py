"""Batches to identify, solve and record; and gyro blocks, recorded once and read back."""

import asyncio
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import to_json

from service.access.tokens import Caller
from service.acquire.kernel_build import KernelBuild
from service.app.context import Context, known_id
from service.errors import AcquisitionError, BadBatch
from service.gyro import GyroBlock, block_from_json
from service.ingest.outcomes import Observer
from service.ingest.queue import Backlog
from service.ingest.submit import GyroIntake, SubmissionService
from service.missions.mission import mission_named
from service.observations.faults import faults_of
from service.observations.schema import Submission, submission_from_json
from service.storage.gyro import BlockFilter, Recorded, list_blocks, read_block
from service.storage.models.base import Page
from service.storage.models.spacecraft import GyroBlockRow, GyroSamples
from service.storage.recording.unsaved_result import LIVE, Answered
from service.times import Utc

MAX_ARRAY = 100
"""The most batches of an array."""
READ_HERE_BYTES, READ_HERE_OBJECTS = 4_096, 64
"""A body within both bounds is read in the event loop; thirty stars fit."""


_ARRAY: TypeAdapter[list[Any]] = TypeAdapter(
    Annotated[list[Any], Field(min_length=1, max_length=MAX_ARRAY)]
)

Outcome = Answered | BaseException


class Submissions:
    """Accepts batches; each is identified, solved and recorded once, however often it is sent."""

    def __init__(self, context: Context, kernels: KernelBuild | None) -> None:
        self.ingest = SubmissionService(context.missions, context.sky, context.store)
        self._kernels = kernels
        self._reader = ThreadPoolExecutor(1, "read")

    @property
    def observers(self) -> list[Observer]:
        """Called with every batch that is new, after its commit."""
        return self.ingest.observers

    def require_kernels(self) -> None:
        """Raise `Busy` while kernels are compiled: no answer depends on which ones exist."""
        if self._kernels is not None:
            self._kernels.require_built()

    def _require_kernels_of_zones(self) -> None:
        # A batch that needs others, without a priori attitude or with a wrong one, is refused
        # where it needs them: by `SkyModel.require_whole_sky`.
        if self._kernels is not None:
            self._kernels.require_zones_built()

    def submit(
        self,
        submission: Submission,
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Record a batch and answer it; a repeat gets the stored answer.

        Raises `KeyReused` and `Conflict` for another body under a key or a
        batch that is taken, `BadBatch` for an unknown spacecraft and for what
        does not fit its mission, `Busy` when too much is waiting.
        """
        return self.ingest.submit(submission, idempotency_key, caller, Future()).result()

    async def answered(
        self, sent: bytes, idempotency_key: str | None = None, caller: Caller | None = None
    ) -> Answered:
        """`submit` of a JSON body, for an event loop.

        A small batch is read in the event loop.  A larger one is not: every other request
        would wait for it.
        """
        self._require_kernels_of_zones()
        loop = asyncio.get_running_loop()
        if len(sent) <= READ_HERE_BYTES and sent.count(b"{") <= READ_HERE_OBJECTS:
            submission = submission_from_json(sent)
        else:
            submission = await loop.run_in_executor(self._reader, submission_from_json, sent)
        future: asyncio.Future[Answered] = loop.create_future()
        return await self.ingest.submit(submission, idempotency_key, caller, future)

    async def read_array(self, sent: bytes) -> list[Submission | BadBatch]:
        """The batches of a JSON array; in the place of one that is refused, its error.

        Raises `BadBatch` where the body is no array of one to `MAX_ARRAY` elements.
        """
        self._require_kernels_of_zones()
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._reader, _submissions_of_array, sent)

    async def answered_each(
        self, read: Sequence[Submission | BadBatch], caller: Caller | None = None
    ) -> list[Outcome]:
        """`submit` each of the batches of an array; the answers and errors in their order."""
        loop = asyncio.get_running_loop()
        futures: list[asyncio.Future[Answered]] = []
        for each in read:
            future: asyncio.Future[Answered] = loop.create_future()
            futures.append(future)
            try:
                if isinstance(each, BadBatch):
                    raise each
                self.ingest.submit(each, None, caller, future)
            except AcquisitionError as error:
                future.set_exception(error)
        return list(await asyncio.gather(*futures, return_exceptions=True))

    def submit_many(self, submissions: Sequence[Submission]) -> list[Answered | AcquisitionError]:
        """`submit` each in one transaction; a refused batch has its error in the list."""
        return self.ingest.submit_many(submissions)

    def backlog(self) -> Backlog:
        """The queues of posts and of writes, and whether the last write succeeded."""
        return self.ingest.backlog()

    def require_alive(self) -> None:
        """Raise `Stopping` if the thread that processes submissions has ended."""
        self.ingest.require_alive()

    def close(self) -> None:
        """Answer the queued posts, and stop."""
        self._reader.shutdown(cancel_futures=True)
        self.ingest.close()


def _submissions_of_array(sent: bytes) -> list[Submission | BadBatch]:
    try:
        elements = _ARRAY.validate_json(sent)
    except ValidationError as error:
        raise BadBatch(faults_of(error)) from None
    return [_submission_of(each) for each in elements]


def _submission_of(element: Any) -> Submission | BadBatch:
    try:
        # As text again: a batch is read by the one reader of batches, NaN and all.
        return submission_from_json(to_json(element, inf_nan_mode="constants"))
    except BadBatch as error:
        return error


class Gyro:
    """Takes and reads gyro blocks."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.intake = GyroIntake(context.missions, context.store)

    def submit(self, name: str, sent: bytes) -> Recorded:
        """Record the block of a JSON body; see `record`."""
        mission_named(self._context.missions, name)
        return self.record(block_from_json(sent, name))

    def record(self, block: GyroBlock) -> Recorded:
        """Record a block, and wait for that; a repeat of the same body gets the recorded one.

        See `GyroIntake.begin` for what is refused.
        """
        return self.intake.begin(block)()

    def page(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[GyroBlockRow]:
        """The blocks of a period without their samples, the earliest first."""
        self._context.mission(name)
        selected = BlockFilter(name, run or LIVE, start, end)
        with self._context.reading() as connection:
            return list_blocks(connection, selected, limit=limit, cursor=cursor)

    def get(self, name: str, id: str) -> GyroSamples:
        """A block of a spacecraft with its samples."""
        with self._context.reading() as connection:
            return read_block(connection, name, known_id(id, "gyro block"))

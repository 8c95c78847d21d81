"""Follower of a NATS stream that runs within the service (`ACQUIRE_FOLLOW`).

Messages are submitted like requests, without a token and without HTTP.  Several services that share
a database share the messages of the consumer, too.
"""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio.to_thread

from service import errors
from service.app.factory import App
from service.extras import require_extra
from service.features.follow.source import EXPECTED, Source, refusals_of, server_and_stream
from service.settings import Settings
from service.web.requests.access import json_response
from service.web.requests.metrics import Metrics
from service.web.requests.problems import FAILED, INTERNAL_ERROR, problem_type_of
from service.web.requests.request_body import MAX_JSON_BYTES, refused

if TYPE_CHECKING:
    # NATS is an optional dependency, imported only on use.
    from service.features.follow.follower import Submit

log = logging.getLogger(__name__)


def source_of(settings: Settings) -> Source | None:
    """Stream, consumer and subjects from the settings; None without a stream.

    Raises `BadConfiguration` for an invalid address and for a missing file, `NotAvailable` without
    the package.
    """
    if settings.follow is None:
        return None
    require_extra("nats", "nats", "ACQUIRE_FOLLOW", "nats")
    try:
        servers, stream = server_and_stream(settings.follow)
    except ValueError:
        # No address in the message: it may contain a password.
        raise errors.BadConfiguration(f"ACQUIRE_FOLLOW: {EXPECTED}") from None
    files = {
        "ACQUIRE_FOLLOW_CREDENTIALS": settings.follow_credentials,
        "ACQUIRE_FOLLOW_AUTHORITY": settings.follow_authority,
    }
    for name, file in files.items():
        if file is not None and not file.is_file():
            raise errors.BadConfiguration(f"{name}: {file} is not there, or is no file")
    return Source(
        servers,
        stream,
        settings.follow_consumer,
        refusals_of(stream),
        settings.follow_answers,
        settings.follow_credentials,
        settings.follow_authority,
    )


def check(settings: Settings) -> None:
    """Raise for settings of a stream that cannot be followed; see `source_of`."""
    source_of(settings)


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Follow the stream named in the settings, in a background task."""
    source = source_of(app.settings)
    if source is None:
        yield
        return
    from service.features.follow.follower import Follower
    from service.features.follow.follower import Metrics as Counters

    follower = Follower(source, _submit_to(app, metrics), Counters(metrics.registry))
    task = asyncio.create_task(follower.keep_running())
    try:
        yield
    finally:
        follower.stop()
        await task


def _submit_to(app: App, metrics: Metrics) -> "Submit":
    """Submit function for a follower that runs within the service."""
    from service.features.follow.follower import Answer, NotNow, Refused, gyro_block_in

    async def recorded(message: bytes) -> Answer:
        if len(message) > MAX_JSON_BYTES:
            raise errors.BadBatch(errors.Fault("body", f"may have at most {MAX_JSON_BYTES} bytes"))
        if (block := gyro_block_in(message)) is None:
            answered = await app.submissions.answered(message)
            return Answer(answered.body, answered.replayed)
        found = await anyio.to_thread.run_sync(app.gyro.submit, *block)
        return Answer(bytes(json_response(found.row).body), found.replayed)

    async def submit(message: bytes) -> Answer:
        try:
            answer = await recorded(message)
        except errors.Busy as error:
            raise NotNow(str(error)) from None
        except Exception as error:
            if isinstance(error, errors.BadInput):
                error = refused(message, error)
            kind, details = INTERNAL_ERROR, FAILED
            if isinstance(error, errors.AcquisitionError):
                kind, details = problem_type_of(error), errors.problem_of(error)
            if kind is INTERNAL_ERROR:
                log.error("a message of the stream failed", exc_info=error)
                details = FAILED
            problem = {"type": kind.type, "status": kind.status, "errors": []} | details
            raise Refused(problem, kind is INTERNAL_ERROR) from None
        if answer.is_repeated:
            metrics.count_repeat()
        return answer

    return submit

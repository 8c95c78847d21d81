"""The outcomes of submissions: found in the record, recorded, or refused."""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future

from msgspec import Struct

from service.errors import AcquisitionError, BadBatch, Busy, Fault, shown_value
from service.storage.recording.identity import ExistingResult, Identity, OwnKey, Registry
from service.storage.recording.transaction import WriteOutcomes
from service.storage.recording.unsaved_result import Answered, UnsavedResult

MAX_KEY_LENGTH = 255

Answers = list[Answered | AcquisitionError]


class Recorded(Struct, frozen=True, eq=False):
    """A newly recorded batch, as observers receive it."""

    spacecraft: str
    run: str
    batch: str
    counts: Mapping[str, int]
    """Its stars: observed, and of them unique, ambiguous and unmatched."""
    has_attitude: bool


Observer = Callable[[Recorded], None]


def outcome_of(future: "asyncio.Future[Answered] | Future[Answered]") -> Answered | Exception:
    """The answer that a future of threads comes to, or its error."""
    assert isinstance(future, Future)
    try:
        return future.result()
    except Exception as error:
        # The caller raises or lists it, as it does with errors that came without a future.
        return error


def note_handed_over(unsaved_results: Sequence[UnsavedResult]) -> None:
    """Note the time: what follows is the time that recording takes."""
    moment_ns = time.perf_counter_ns()
    for unsaved in unsaved_results:
        unsaved.handed_over_ns = moment_ns


def decided(outcomes: WriteOutcomes) -> Answers:
    """Answers and errors of single batches; raises the others."""
    answers: Answers = []
    for outcome in outcomes:
        # Both decide nothing about the batch.
        if isinstance(outcome, Busy) or not isinstance(outcome, Answered | AcquisitionError):
            raise outcome
        answers.append(outcome)
    return answers


def holder_of(
    registry: Registry, identity: Identity, key: OwnKey | None, fingerprint: str
) -> ExistingResult | AcquisitionError | None:
    """The recorded holder of an identity or a key, or the error where it is of another body."""
    try:
        return registry.first(identity, key, fingerprint)
    except AcquisitionError as error:
        return error


def check_key(own: OwnKey) -> None:
    """Raise `BadBatch` for an Idempotency-Key that cannot be one."""
    _, key = own
    if not (0 < len(key) <= MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        message = f"must be 1 to {MAX_KEY_LENGTH} printable ASCII characters"
        raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))

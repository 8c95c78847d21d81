"""The outcome of a batch that was sent."""

from dataclasses import dataclass
from functools import cached_property

import msgspec

from .encoding import Batch
from .errors import Problem, UnexpectedAnswer
from .models import Answer


@dataclass(frozen=True)
class RecordedAnswer:
    """An answer as it is recorded: its JSON, and whether the batch was recorded before."""

    body: bytes
    replayed: bool

    @cached_property
    def answer(self) -> Answer:
        """The answer as a model."""
        try:
            return msgspec.json.decode(self.body, type=Answer)
        except msgspec.DecodeError as error:
            raise UnexpectedAnswer(f"this is no answer to a batch: {error}") from None


@dataclass(frozen=True)
class BatchOutcome:
    """A batch that was sent, with its answer, or with the problem for which it was refused."""

    batch: Batch
    recorded: RecordedAnswer | None
    problem: Problem | None

    @property
    def answer(self) -> Answer:
        """The answer; raises the problem of a batch that was refused."""
        if self.recorded is None:
            assert self.problem is not None
            raise self.problem
        return self.recorded.answer

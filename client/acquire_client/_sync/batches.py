"""Batches: submit many of them, try other options."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal, overload

from .. import models
from ..encoding import Batch, path_of
from ..errors import Problem
from ..operations import BatchOutcome, Results
from ..retrying import Repeat
from .backend import Source, bounded_map
from .connection import Connection


class Batches(Results, Connection):
    """The part of the client that is about many batches, and what-ifs."""

    def submit_many(self, batches: Source[Batch], *, at_once: int = 8) -> Iterator[BatchOutcome]:
        """Submit batches as they are taken from `batches`, at most `at_once` at a time.

        The outcomes come in the same order: an answer, or the problem of a batch that was
        refused.  Where batches come slowly, `submit` each: an outcome may wait for the next batch.
        For whole files, `replay` is faster.

        >>> [outcome.problem for outcome in client.submit_many([batch, batch])]
        [None, None]
        """
        yield from bounded_map(self._outcome, batches, at_once)

    def _outcome(self, batch: Batch) -> BatchOutcome:
        try:
            recorded = self.submit_json(batch)
        except Problem as problem:
            return BatchOutcome(batch, None, problem)
        return BatchOutcome(batch, recorded, None)

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[True]
    ) -> models.Answer: ...

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: Literal[False] = False
    ) -> models.WhatIf: ...

    @overload
    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool
    ) -> models.Answer | models.WhatIf: ...

    def what_if(
        self, id: str, options: Mapping[str, Any], *, record: bool = False
    ) -> models.Answer | models.WhatIf:
        """Process a recorded batch again with other options; `record` keeps the result beside it.

        >>> latest = client.latest("XTE")
        >>> votes = client.what_if(latest.answer.id, {"identifier": "starid"})
        >>> votes.counts.ambiguous, votes.id
        (1, None)
        """
        body = {"options": dict(options), "record": record}
        path = path_of("batches", id, "what-if")
        if record:
            return self.post(models.Answer, path, body)
        return self.post(models.WhatIf, path, body, Repeat.ALWAYS)

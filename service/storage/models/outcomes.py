"""The outcomes of batches that were sent together."""

from typing import Annotated, ClassVar

from msgspec import Raw

from service.storage.models.answers import Answer
from service.storage.models.base import DescribedAs, Problem, Record, doc


class BatchOutcome(Record, frozen=True, kw_only=True):
    """The outcome of one batch of an array: its answer or its problem, the other is null."""

    component: ClassVar[str] = "BatchOutcome"
    status: Annotated[
        int,
        doc(
            "The status that the batch alone would have had: 201 if it is now recorded, 200 if it "
            "was recorded before, or the status of the problem."
        ),
    ]
    answer: Annotated[Raw | None, DescribedAs(Answer | None), doc("As it is recorded.")]
    problem: Problem | None


class BatchOutcomes(Record, frozen=True, kw_only=True):
    """One outcome for each batch of an array, in the order in which they were sent."""

    component: ClassVar[str] = "BatchOutcomes"
    items: list[BatchOutcome]

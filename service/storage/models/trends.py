"""Histories of quantities, thinned out, and the worst batches."""

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.alarms.quantities import QuantityName
from service.storage.models.answers import Summary
from service.storage.models.base import Count, Id, Moment, Record, doc

Numbers = list[float | None]


class Series(Record, frozen=True, kw_only=True):
    """A quantity. `minmax`: mean, least and greatest of each bucket; `latest`: single values."""

    component: ClassVar[str] = "Series"
    unit: Annotated[str, Field(examples=["arcsec"])]
    count: Annotated[list[Count], doc("`minmax`: batches with a value.")] | UnsetType = UNSET
    mean: (
        Annotated[Numbers, doc("`minmax`: for shares, over all stars or batches.")] | UnsetType
    ) = UNSET
    min: Annotated[Numbers, doc("Least value of a batch.")] | UnsetType = UNSET
    max: Annotated[Numbers, doc("Greatest value of a batch.")] | UnsetType = UNSET
    value: Annotated[Numbers, doc("`latest`: the value of each batch.")] | UnsetType = UNSET


class History(Record, frozen=True, kw_only=True):
    """Quantities over a period of time, oldest first; null: unknown."""

    component: ClassVar[str] = "History"
    spacecraft: str
    run: str
    tracker: Annotated[str, doc("If the request names one.")] | UnsetType = UNSET
    not_split: (
        Annotated[
            bool,
            doc(
                "With `tracker`: true while older batches of the run are not split by tracker yet, "
                "and so are missing here."
            ),
        ]
        | UnsetType
    ) = UNSET
    start: Moment | None
    end: Moment | None
    strategy: Literal["minmax", "latest"]
    bucket_s: Annotated[int | None, doc("The width of a bucket; null for single batches.")]
    source: Annotated[
        Literal["batch", "hour", "day"],
        doc("The source of the data; both ends of the period are exact in any case."),
    ]
    thinned: Annotated[bool, doc("Whether the period has more batches than the answer has points.")]
    unix_s: Annotated[
        list[float],
        doc(
            "POSIX time of the beginning of each bucket, or of each batch. Empty buckets are "
            "omitted."
        ),
    ]
    batches: Annotated[list[Count], doc("`minmax`: batches in each bucket.")] | UnsetType = UNSET
    time: Annotated[list[Moment], doc("`latest` only, like the next two fields.")] | UnsetType = (
        UNSET
    )
    id: list[Id] | UnsetType = UNSET
    batch: list[str] | UnsetType = UNSET
    series: dict[QuantityName, Series]


class RankedBatch(Summary, frozen=True, kw_only=True):
    """A batch with its value of the chosen quantity."""

    component: ClassVar[str] = "WorstBatch"
    value: float


class Ranking(Record, frozen=True, kw_only=True):
    """The worst batches of a period."""

    component: ClassVar[str] = "WorstList"
    by: QuantityName
    tracker: Annotated[str, doc("If the request names one.")] | UnsetType = UNSET
    not_split: (
        Annotated[bool, doc("With `tracker`: true while older batches are not split by tracker.")]
        | UnsetType
    ) = UNSET
    items: list[RankedBatch]

"""Histories of quantities, thinned out, and the worst batches."""

from typing import Literal

from pydantic import Field

from service.alarms.quantities import QuantityName
from service.web.schemas.answers import Summary
from service.web.schemas.base import Count, Id, Moment, Shape

Numbers = list[float | None]


class Series(Shape):
    """One quantity: of `minmax` mean, least and greatest a bucket, of `latest` its values."""

    unit: str = Field(examples=["arcsec"])
    count: list[Count] = Field(default=[], description="Of `minmax`: the batches that have it.")
    mean: Numbers = Field(default=[], description="Of shares: over all stars or batches.")
    min: Numbers = Field(default=[], description="The least of a batch.")
    max: Numbers = Field(default=[], description="The greatest of a batch.")
    value: Numbers = Field(default=[], description="Of `latest`: that of each batch.")


class History(Shape):
    """Quantities over a stretch of time, oldest first; null where nothing is known."""

    spacecraft: str
    run: str
    start: Moment | None
    end: Moment | None
    strategy: Literal["minmax", "latest"]
    bucket_s: int | None = Field(description="The width of a bucket; null for single batches.")
    source: Literal["batch", "hour", "day"] = Field(
        description="What it was read from; both ends are exact in any case."
    )
    thinned: bool = Field(description="Whether the stretch has more batches than there are points.")
    unix_s: list[float] = Field(
        description="POSIX time at which each bucket begins, or of each batch. Buckets without "
        "a batch are left out."
    )
    batches: list[Count] = Field(default=[], description="Of `minmax`: in each bucket.")
    time: list[Moment] = Field(default=[], description="Of `latest`, as are the next two.")
    id: list[Id] = Field(default=[])
    batch: list[str] = Field(default=[])
    series: dict[QuantityName, Series]


class WorstBatch(Summary):
    """A batch with the value that it is among the worst by."""

    value: float


class WorstList(Shape):
    """The worst batches of a stretch."""

    by: QuantityName
    items: list[WorstBatch]

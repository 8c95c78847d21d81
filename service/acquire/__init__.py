"""Acquisition of batches: star identification, then attitude determination."""

from service.acquire.pipeline import ResultColumns, acquire, acquire_many, acquired
from service.acquire.result import Acquisition
from service.observations.columns import BatchColumns

__all__ = [
    "Acquisition",
    "BatchColumns",
    "ResultColumns",
    "acquire",
    "acquire_many",
    "acquired",
]

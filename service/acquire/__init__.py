"""Acquisition of batches: identification of the stars, then the attitude."""

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

"""From a batch to an acquisition: identification of the stars, then the attitude."""

from service.acquire.pipeline import acquire
from service.acquire.result import Acquisition

__all__ = ["Acquisition", "acquire"]

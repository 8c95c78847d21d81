"""From a batch to an acquisition: identification of the stars, then the attitude."""

from service.acquire.pipeline import acquire, acquire_at_once
from service.acquire.result import Acquisition

__all__ = ["Acquisition", "acquire", "acquire_at_once"]

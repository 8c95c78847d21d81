"""Whether the filter of a mission is kept up while batches and gyro samples come in."""

from pydantic import Field

from service.missions.strict import Strict


class LiveFilterSettings(Strict):
    """The filter of live data; off where the mission has no such table."""

    every_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Seconds from one look at what was recorded to the next, at least."""

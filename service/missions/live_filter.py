"""Settings of filters that the service runs by itself: live, and once a day."""

from pydantic import Field

from service.missions.strict import Strict


class LiveFilterSettings(Strict):
    """The filter of live data; off where the mission has no such table."""

    every_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Seconds from one look at what was recorded to the next, at least."""


class SmoothingSettings(Strict):
    """When the service makes the definitive attitude by itself."""

    daily: bool = False
    """Each UTC day of live data, two hours and ten minutes after its end."""

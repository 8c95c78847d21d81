"""Live batches, and how far ahead of the clock one may be dated and still be the latest."""

LIVE = "live"
"""The run of what pipelines send."""
AHEAD_NS = 3600 * 10**9
"""A live batch dated further ahead than this is not the latest, whatever its time says."""

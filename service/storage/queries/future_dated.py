"""The live run, and how far in the future a live batch may be dated and still be the latest."""

LIVE = "live"
"""The run of batches that pipelines send."""
AHEAD_NS = 3600 * 10**9
"""A live batch dated further in the future than this is never the latest."""

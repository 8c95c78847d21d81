"""Frames of a spacecraft, which are pictures too."""

from tests.web.test_frames import frames, send

__all__ = ["frames", "send"]

"""The shipped mission files of the version before derived defaults, which state every value."""

from pathlib import Path

STATED_FOLDER = Path(__file__).parent / "stated"

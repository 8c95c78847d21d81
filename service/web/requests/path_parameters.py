"""Path parameters that routes of several subjects have."""

from typing import Annotated

from fastapi import Path

SpacecraftPath = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]

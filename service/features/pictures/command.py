"""`acquire frame` without a spacecraft, and `acquire camera`."""

from typing import Any

from service.features.pictures import any_camera, camera


def add(commands: Any) -> None:
    """Extend `acquire frame` for pictures of any camera, and declare `acquire camera`."""
    any_camera.extend(commands.choices["frame"])
    camera.add(commands)

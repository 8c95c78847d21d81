"""Commands `acquire frame`, `acquire camera` and `acquire simulate frames`."""

from typing import Any

from service.features.pictures import camera, frame_command, simulate_command


def add(commands: Any) -> None:
    """Declare the commands for frames and pictures."""
    frame_command.add(commands)
    camera.add(commands)
    simulate_command.add(commands)

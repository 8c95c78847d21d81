"""`acquire simulate`: skies whose truth is known; a module each for its commands."""

import pkgutil
from importlib import import_module
from typing import Any

from service.cli.arguments import add_group


def add(commands: Any) -> None:
    """Declare the group with every command of this package."""
    group = add_group(
        commands,
        "simulate",
        "Simulate telemetry and frames with known truth, and repeat published experiments.",
        "acquire simulate telemetry --spacecraft XTE --batches 2000 --seed 7 xte.ndjson",
    )
    for module in pkgutil.iter_modules(__path__):
        import_module(f"{__name__}.{module.name}").add(group)

"""`acquire export`: files for other programs; a module each for its commands."""

import pkgutil
from importlib import import_module
from typing import Any

from service.cli.arguments import add_group


def add(commands: Any) -> None:
    """Declare the group with every command of this package."""
    group = add_group(
        commands,
        "export",
        "Write recorded data to files that other programs read.",
        "acquire export attitude --spacecraft XTE --format aem --output xte.aem",
    )
    for module in pkgutil.iter_modules(__path__):
        import_module(f"{__name__}.{module.name}").add(group)

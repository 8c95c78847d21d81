"""`acquire export batches`: a table for analysts."""

from typing import Any

from service.cli.table_export import add_table_export


def add(commands: Any) -> None:
    """Declare the command."""
    summary = "Write the recorded batches of a spacecraft with their quantities, one row per batch."
    add_table_export(commands, "batches", summary)

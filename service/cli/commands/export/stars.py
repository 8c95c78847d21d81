"""`acquire export stars`: a table for analysts."""

from typing import Any

from service.cli.table_export import add_table_export


def add(commands: Any) -> None:
    """Declare the command."""
    summary = "Write the stars of a spacecraft's batches with their outcomes, one row per star."
    add_table_export(commands, "stars", summary)

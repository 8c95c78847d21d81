"""`acquire export gyro`: a table for analysts."""

from typing import Any

from service.cli.table_export import add_table_export


def add(commands: Any) -> None:
    """Declare the command."""
    summary = "Write the recorded gyro samples of a spacecraft, one row per sample."
    add_table_export(commands, "gyro", summary)

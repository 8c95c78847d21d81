"""The shipped mission files of the version before derived defaults, and tables as TOML."""

from pathlib import Path

from service.cli.mission_files import _value

STATED_FOLDER = Path(__file__).parent / "stated"


def toml_text(table):
    """A table as TOML, its own tables in line."""
    return "".join(f"{key} = {_value(value)}\n" for key, value in table.items()).replace(
        "NaN", "nan"
    )

"""The metadata of all tables, the types of shared columns, and the values of a row."""

from typing import Any

from sqlalchemy import MetaData, String

Row = dict[str, Any]
"""The values of a row by column name."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

Id = String(26)
Name = String(128)
RunName = String(64)
Digest = String(80)
Moment = String(30)

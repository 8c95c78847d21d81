"""The base of all models."""

from typing import TYPE_CHECKING, Generic, TypeVar, cast

from msgspec import Struct

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from .models import History

T = TypeVar("T")


class Model(Struct, frozen=True):
    """A part of an answer.

    Fields that a later service adds are ignored.  A field with a default may be absent from the
    answer.  Words such as a status are text when they are read, since a later service may know
    further ones; for a type checker they are those of this version.
    """


class Page(Struct, Generic[T], frozen=True):
    """A part of a list; `next_cursor` leads to the next part, None at the end."""

    items: list[T]
    next_cursor: str | None = None


class Tabulated(Model, frozen=True):
    """The methods of quantities over time that make tables of them."""

    def to_arrow(self) -> "pa.Table":
        """A table with a row for each point; a column such as `residual_rms_arcsec.mean`.

        Raises `PackageMissing` where pyarrow is not installed.
        """
        from .tables import table_of_history

        return table_of_history(cast("History", self))

    def to_pandas(self) -> "pd.DataFrame":
        """The same as a data frame.

        Raises `PackageMissing` where pandas and pyarrow are not both installed.
        """
        from .tables import pandas_of

        return pandas_of(self.to_arrow())

"""Base classes of all models of the client."""

from typing import TYPE_CHECKING, Generic, TypeVar, cast

from msgspec import Struct

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from .models import History

T = TypeVar("T")


class Model(Struct, frozen=True):
    """Base class of a model: a part of an answer.

    Fields that a later service adds are ignored.  A field with a default may be absent from the
    answer.  Words such as a status are read as text, since a later service may have further ones;
    for a type checker they are those of this version.
    """


class Page(Struct, Generic[T], frozen=True):
    """Page of a list; `next_cursor` leads to the next page, None at the end."""

    items: list[T]
    next_cursor: str | None = None


class Tabulated(Model, frozen=True):
    """Base class of histories, with methods that convert them to tables."""

    def to_arrow(self) -> "pa.Table":
        """Convert a history to an Arrow table with a row for each point.

        Columns have names such as `residual_rms_arcsec.mean`.  Raises `PackageMissing` where
        pyarrow is not installed.
        """
        from .tables import table_of_history

        return table_of_history(cast("History", self))

    def to_pandas(self) -> "pd.DataFrame":
        """Convert a history to a data frame with a row for each point.

        Raises `PackageMissing` where pandas and pyarrow are not both installed.
        """
        from .tables import pandas_of

        return pandas_of(self.to_arrow())

"""Long lists, whose pages are read as they are needed."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec

from ..base import Page
from ..encoding import Query
from ..tables import pandas_of, table_of
from .connection import Connection

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

T = TypeVar("T", bound=msgspec.Struct)

ITEMS_A_PAGE = 500


class Items(Generic[T]):
    """The items of a list: iterate over it, more than once if you like.

    What is recorded meanwhile neither repeats nor hides items.
    """

    def __init__(self, connection: Connection, kind: type[T], path: str, query: Query) -> None:
        self._connection, self._kind = connection, kind
        self._path, self._query = path, query

    def __iter__(self) -> Iterator[T]:
        page_kind: Any = Page[self._kind]  # type: ignore[name-defined]
        query = {"limit": ITEMS_A_PAGE, **self._query}
        while True:
            page = self._connection.get(page_kind, self._path, query)
            yield from page.items
            if page.next_cursor is None:
                return
            query["cursor"] = page.next_cursor

    def all(self) -> list[T]:
        """Every item."""
        return list(self)

    def to_arrow(self) -> "pa.Table":
        """A table with a row for each item; raises `PackageMissing` without pyarrow."""
        return table_of(self.all(), self._kind)

    def to_pandas(self) -> "pd.DataFrame":
        """The same as a data frame; raises `PackageMissing` without pandas and pyarrow."""
        return pandas_of(self.to_arrow())

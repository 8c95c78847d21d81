"""Conversion of models to tables of pyarrow and pandas, where these are installed."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import inspect

from .errors import PackageMissing

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from .models import History


def table_of(rows: Sequence[msgspec.Struct], kind: type[msgspec.Struct]) -> "pa.Table":
    """Arrow table with a row for each model of one kind.

    The column of a part is named `counts.unique`; free settings are columns of JSON text.  The
    columns depend on the kind only, so a table without rows has them too.
    """
    arrow = _package("pyarrow")
    described = inspect.type_info(kind)
    schema = arrow.schema(
        [(each.encode_name, _arrow_type(arrow, each.type)) for each in described.fields]  # type: ignore[attr-defined]
    )
    as_json = {
        each.encode_name
        for each in described.fields  # type: ignore[attr-defined]
        if _is_free(each.type)
    }
    found = [
        {
            name: msgspec.json.encode(value).decode() if name in as_json else value
            for name, value in msgspec.to_builtins(row).items()
        }
        for row in rows
    ]
    table = arrow.Table.from_pylist(found, schema=schema)
    while any(arrow.types.is_struct(each.type) for each in table.schema):
        table = table.flatten()
    return table


def table_of_history(history: "History") -> "pa.Table":
    """Arrow table with a row for each point of a history."""
    arrow = _package("pyarrow")
    columns: dict[str, Any] = {"unix_s": arrow.array(history.unix_s, arrow.float64())}
    for name in ("time", "id", "batch", "batches"):
        if values := getattr(history, name):
            columns[name] = values
    for quantity, series in history.series.items():
        for part in ("count", "mean", "min", "max", "value"):
            if values := getattr(series, part):
                kind = arrow.int64() if part == "count" else arrow.float64()
                columns[f"{quantity}.{part}"] = arrow.array(values, kind)
    return arrow.table(columns)


def pandas_of(table: "pa.Table") -> "pd.DataFrame":
    """Convert an Arrow table to a pandas data frame."""
    _package("pandas")
    return table.to_pandas()


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise PackageMissing(
            f"this needs the package {name}; install it with: pip install {name}"
        ) from None


def _is_free(kind: inspect.Type) -> bool:
    """True if the type of a field allows settings of any shape."""
    return isinstance(kind, inspect.DictType) and isinstance(kind.value_type, inspect.AnyType)


def _arrow_type(arrow: Any, kind: inspect.Type) -> Any:
    plain = {
        inspect.StrType: arrow.string,
        inspect.IntType: arrow.int64,
        inspect.FloatType: arrow.float64,
        inspect.BoolType: arrow.bool_,
    }
    if isinstance(kind, inspect.UnionType):
        (kind,) = (each for each in kind.types if not isinstance(each, inspect.NoneType))
    if isinstance(kind, inspect.ListType):
        return arrow.list_(_arrow_type(arrow, kind.item_type))
    if _is_free(kind):
        return arrow.string()
    if isinstance(kind, inspect.DictType):
        return arrow.map_(arrow.string(), _arrow_type(arrow, kind.value_type))
    if isinstance(kind, inspect.StructType):
        return arrow.struct(
            [(each.encode_name, _arrow_type(arrow, each.type)) for each in kind.fields]
        )
    return plain[type(kind)]()

"""Histories as CSV: a row a bucket or batch, named columns with their units."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from starlette.responses import Response

from service.times import utc_of_unix

CSV = "text/csv"


def history_csv(history: Mapping[str, Any]) -> Response:
    """A history (see `trends.history`) as a file to keep."""
    rows = _batches(history) if history["strategy"] == "latest" else _buckets(history)
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\r\n").writerows(rows)
    name = f"{history['spacecraft']}-{history['run']}-history.csv".replace(":", "_")
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(text.getvalue(), 200, headers, media_type=CSV)


def _buckets(history: Mapping[str, Any]) -> Iterator[Sequence[object]]:
    series = history["series"]
    parts = ("count", "mean", "min", "max")
    yield ["start", "bucket_s", "batches", *(f"{name}_{part}" for name in series for part in parts)]
    starts = [utc_of_unix(each).text for each in history["unix_s"]]
    widths = [history["bucket_s"]] * len(starts)
    values = [each[part] for each in series.values() for part in parts]
    yield from _rows([starts, widths, history["batches"], *values])


def _batches(history: Mapping[str, Any]) -> Iterator[Sequence[object]]:
    series = history["series"]
    yield ["time", "batch", "id", *series]
    columns = [history[name] for name in ("time", "batch", "id")]
    yield from _rows([*columns, *(each["value"] for each in series.values())])


def _rows(columns: Sequence[Iterable[object]]) -> Iterator[Sequence[object]]:
    for row in zip(*columns, strict=True):
        yield ["" if each is None else each for each in row]

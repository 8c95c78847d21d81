"""Histories as CSV: a row a bucket or batch, named columns with their units."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from starlette.responses import Response, StreamingResponse

from service.times import utc_of_unix

CSV = "text/csv"
THINNED = {
    "Thinned": {
        "description": "`true` where the stretch has more batches than there are points or rows.",
        "schema": {"type": "string", "enum": ["true", "false"]},
    }
}


def history_csv(history: Mapping[str, Any]) -> Response:
    """A history (see `trends.history`) as a file to keep."""
    is_of_batches = history["strategy"] == "latest"
    rows = (
        chain([_batch_header(history)], _batches(history)) if is_of_batches else _buckets(history)
    )
    headers = _headers(history["spacecraft"], history["run"], history["thinned"])
    return Response(_text(rows), 200, headers, media_type=CSV)


def batches_csv(spacecraft: str, run: str, pages: Iterator[Mapping[str, Any]]) -> Response:
    """Pages of batches (see `trends.every_batch`) as a file, sent as they are read.

    The first is read at once: what is wrong then is still an answer of its own.
    """
    first = next(pages)
    lines = chain(
        [_text([_batch_header(first)])], (_text(_batches(page)) for page in chain([first], pages))
    )
    return StreamingResponse(lines, 200, _headers(spacecraft, run, False), media_type=CSV)


def thinned(is_thinned: bool) -> dict[str, str]:
    """The header that says whether a history has less than was recorded."""
    return {"Thinned": "true" if is_thinned else "false"}


def _headers(spacecraft: str, run: str, is_thinned: bool) -> dict[str, str]:
    name = f"{spacecraft}-{run}-history.csv".replace(":", "_")
    return {"Content-Disposition": f'attachment; filename="{name}"'} | thinned(is_thinned)


def _text(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\r\n").writerows(rows)
    return text.getvalue()


def _buckets(history: Mapping[str, Any]) -> Iterator[Sequence[object]]:
    series = history["series"]
    parts = ("count", "mean", "min", "max")
    yield ["start", "bucket_s", "batches", *(f"{name}_{part}" for name in series for part in parts)]
    starts = [utc_of_unix(each).text for each in history["unix_s"]]
    widths = [history["bucket_s"]] * len(starts)
    values = [each[part] for each in series.values() for part in parts]
    yield from _rows([starts, widths, history["batches"], *values])


def _batch_header(history: Mapping[str, Any]) -> Sequence[object]:
    return ["time", "batch", "id", *history["series"]]


def _batches(history: Mapping[str, Any]) -> Iterator[Sequence[object]]:
    columns = [history[name] for name in ("time", "batch", "id")]
    return _rows([*columns, *(each["value"] for each in history["series"].values())])


def _rows(columns: Sequence[Iterable[object]]) -> Iterator[Sequence[object]]:
    for row in zip(*columns, strict=True):
        yield ["" if each is None else each for each in row]

"""CSV files as spreadsheets and other programs write them: in any order and any dialect."""

import io
import json
import math
import random
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from service.csv_cells import neutralised, original
from service.errors import BadFile
from service.observations import csv_table
from service.observations.csv_rows import write_batches_csv
from service.observations.decompress import Line
from service.observations.schema import BatchIn, submission_from_json
from service.observations.telemetry import read_lines, require_telemetry
from service.table_files.table import Column, Table, write_csv

HEADER = "spacecraft,batch,time,tracker,x,y,z,magnitude"
GYRO = "spacecraft,run,block,time,rate_1_rad_per_s,rate_2_rad_per_s,rate_3_rad_per_s"


def row(batch: int, star: int, tracker: str = "A") -> str:
    x = round(math.sin(star / 100.0), 6)
    z = round(math.cos(star / 100.0), 6)
    return f"XTE,b{batch},1996-01-10T12:00:{batch:02d}Z,{tracker},{x},0,{z},{3.5 + 0.25 * star}"


ROWS = [row(batch, star, tracker) for batch in range(4) for tracker in "AB" for star in range(5)]


def read(text: str | bytes) -> list[Line]:
    data = text if isinstance(text, bytes) else text.encode()
    return list(read_lines(io.BytesIO(data), "csv"))


def file_of(rows: list[str], header: str = HEADER, end: str = "\n") -> str:
    return end.join([header, *rows]) + end


def bodies(lines: list[Line]) -> list[dict[str, Any]]:
    assert [line.fault for line in lines if line.fault is not None] == []
    return [json.loads(line.body or b"") for line in lines]


def without_order(body: dict[str, Any]) -> dict[str, Any]:
    """A batch with its trackers and stars in an order that does not depend on the file."""
    observations = [
        {**one, "stars": sorted(one["stars"], key=json.dumps)} for one in body["observations"]
    ]
    return {**body, "observations": sorted(observations, key=lambda one: str(one["tracker"]))}


def column(name: str) -> Any:
    at = HEADER.split(",").index(name)
    return lambda text: text.split(",")[at]


def shuffled(rows: list[str]) -> list[str]:
    return random.Random(4).sample(rows, len(rows))


IN_ORDER = [without_order(body) for body in bodies(read(file_of(ROWS)))]


@pytest.mark.parametrize(
    "rows",
    [
        sorted(ROWS, key=lambda text: float(column("magnitude")(text))),
        sorted(ROWS, key=column("tracker")),
        sorted(ROWS, key=column("x"), reverse=True),
        shuffled(ROWS),
    ],
    ids=["by magnitude", "by tracker", "by x, downward", "shuffled"],
)
def test_rows_in_any_order_are_the_batches_that_they_are_in_order(rows: list[str]) -> None:
    """Whole batches, in order of time, each with the number of its first row."""
    lines = read(file_of(rows))
    assert [without_order(body) for body in bodies(lines)] == IN_ORDER
    first = [2 + min(k for k, each in enumerate(rows) if f",b{n}," in each) for n in range(4)]
    assert sorted(line.number for line in lines) == sorted(first)


def test_batches_in_order_of_the_file_stay_so_though_their_times_do_not() -> None:
    """A file whose rows do not lie apart is handed on as it is, also one with a late batch."""
    rows = [*ROWS[20:30], *ROWS[:10], *ROWS[10:20]]
    assert [body["batch"] for body in bodies(read(file_of(rows)))] == ["b2", "b0", "b1"]


@pytest.mark.parametrize("order", ["by rate", "shuffled", "backward", "by half"])
def test_gyro_samples_in_any_order_are_the_blocks_that_they_are_in_order(order: str) -> None:
    rows = [
        f"XTE,,g{block},1999-03-01T00:0{block}:{k:02d}Z,{(k * 7 % 10) * 1e-5!r},0,0"
        for block in range(3)
        for k in range(10)
    ]
    orders = {
        "by rate": sorted(rows, key=lambda text: float(text.split(",")[4])),
        "shuffled": shuffled(rows),
        "backward": rows[::-1],
        "by half": rows[::2] + rows[1::2],
    }
    in_order = bodies(read(file_of(rows, GYRO)))
    found = bodies(read(file_of(orders[order], GYRO)))
    if order == "backward":
        # Consecutive rows are taken as they are: a clock that runs backward is refused, not hidden.
        assert [body["times_s"] for body in found] == [[-float(k) for k in range(10)]] * 3
        return
    assert found == in_order


def test_more_rows_apart_than_are_held_are_refused_by_the_line_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csv_table, "MOST_ROWS_APART", 30)
    path = tmp_path / "wide.csv"
    path.write_text(file_of(sorted(ROWS, key=column("tracker"))))
    message = r"line 32: rows of one batch lie apart \(line 22\), and no more than 30 rows"
    with pytest.raises(BadFile, match=message):
        next(read_lines(path))
    with pytest.raises(BadFile, match=r"wide\.csv: line 32"):
        require_telemetry(path)
    path.write_text(file_of(ROWS))
    assert len(bodies(list(read_lines(path)))) == 4


def test_more_batches_than_are_told_apart_are_refused_by_the_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(csv_table, "MOST_GROUPS", 3)
    with pytest.raises(BadFile, match="line 32: is beyond 3 groups of rows: split the file"):
        read(file_of(ROWS))


def test_a_damaged_row_among_rows_that_lie_apart_refuses_the_file() -> None:
    rows = sorted(ROWS, key=column("tracker"))
    rows[7] = '"XTE,b1'
    with pytest.raises(BadFile, match=r"line 9: cannot be read, .* any batch of the file"):
        read(file_of(rows))


def test_a_row_that_leaves_out_its_batch_refuses_the_batches_beside_it() -> None:
    """A spreadsheet with merged cells names a batch in its first row only."""
    unnamed = "," * 3 + ROWS[1].split(",", 3)[3]
    first, stray, after = read(file_of([ROWS[0], unnamed, ROWS[10]]))
    assert str(first.fault).startswith("line 2: the batch may lack a star")
    assert str(stray.fault) == "line 3: does not name its spacecraft and batch"
    assert str(after.fault).startswith("line 4: the batch may lack a star")


def test_memory_does_not_grow_with_the_rows_that_lie_apart(tmp_path: Path) -> None:
    """Their places are held, not their text: 2 MiB of rows take less than half of that."""
    path = tmp_path / "apart.csv"
    pad = " " * 1000
    rows = [row(k % 50, k % 20).replace(",A,", f",A,{pad}") for k in range(2000)]
    path.write_text(file_of(rows))
    tracemalloc.start()
    count = sum(1 for _ in read_lines(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 50
    assert peak < 1 << 20


def dialect(separator: str, decimal: str = ".") -> str:
    header = HEADER.replace(",", separator)
    return file_of([each.replace(",", separator).replace(".", decimal) for each in ROWS], header)


@pytest.mark.parametrize(
    "text",
    [
        dialect(";"),
        dialect("\t"),
        dialect("|"),
        dialect(";", ","),
        dialect("\t", ","),
        f"sep=;\n{dialect(';')}",
        f'\ufeff"sep=;"\r\n{dialect(";", ",")}',
        f"SEP=,\n{file_of(ROWS)}",
        file_of(ROWS, HEADER.upper()),
        file_of(ROWS, HEADER.title()),
        file_of(ROWS, HEADER.replace(",", " , ")),
        file_of([f"{each},,," for each in ROWS], f"{HEADER},,,"),
        file_of([*ROWS, "," * 7, " ," * 7]),
        file_of([*ROWS[:20], HEADER, *ROWS[20:]]),
        file_of([",".join(f'"{cell}"' for cell in each.split(",")) for each in ROWS]),
        file_of([each.replace(",0,", ",'0,") for each in ROWS]),
        file_of(ROWS, end="\r\n"),
        file_of(
            [
                ",".join(f'"{c}"' for c in each.replace(".", ";").split(",")).replace(";", ",")
                for each in ROWS
            ]
        ),
        f"# made by a spreadsheet\n#,of stars\n{file_of(ROWS)}",
    ],
    ids=[
        "semicolons",
        "tabs",
        "bars",
        "semicolons, decimal commas",
        "tabs, decimal commas",
        "sep=",
        "byte order mark, sep=, decimal commas",
        "SEP= with commas",
        "capitals",
        "capital first letters",
        "spaces in the header",
        "empty columns at the end",
        "empty rows at the end",
        "two files one after another",
        "every cell in quotes",
        "numbers marked as texts",
        "CR LF",
        "commas, decimal commas in quotes",
        "comments before the header",
    ],
)
def test_every_dialect_is_read_as_the_plain_file(text: str) -> None:
    assert [without_order(body) for body in bodies(read(text))] == IN_ORDER


@pytest.mark.parametrize("rows", [ROWS, shuffled(ROWS)], ids=["in order", "apart"])
@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_a_decimal_comma_is_read_in_times_too(rows: list[str], separator: str) -> None:
    """A spreadsheet of such a language writes 12:00:01,500 beside 0,25, also as ISO 8601 has it."""
    at = [each.replace(f":{k:02d}Z", f":{k:02d}.500Z") for each in rows for k in [int(each[5])]]
    text = file_of([each.replace(",", separator).replace(".", ",") for each in at])
    text = text.replace(HEADER, HEADER.replace(",", separator))
    found = bodies(read(text))
    assert found == bodies(read(file_of(at)))
    assert [body["time"] for body in found] == [f"1996-01-10T12:00:0{k}.500Z" for k in range(4)]


@pytest.mark.parametrize(
    "data",
    [
        file_of(ROWS, end="\r\n").encode("utf-16"),
        b"\xfe\xff" + dialect("\t", ",").encode("utf-16-be"),
        file_of(ROWS, end="\r").encode(),
        b"\xef\xbb\xbf" + file_of(ROWS).encode(),
    ],
    ids=["UTF-16", "UTF-16, big-endian, tabs, decimal commas", "CR alone", "UTF-8 with mark"],
)
@pytest.mark.parametrize("name", ["pass.csv", "PASS.TSV"])
def test_every_encoding_is_read_as_the_plain_file(tmp_path: Path, data: bytes, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    require_telemetry(path)
    assert [without_order(body) for body in bodies(list(read_lines(path)))] == IN_ORDER


def test_lines_of_json_in_utf16_are_read(tmp_path: Path) -> None:
    """As a redirection of Windows PowerShell writes them."""
    path = tmp_path / "pass.ndjson"
    path.write_bytes('{"batch": "ä"}\r\n{"batch": "b"}\r\n'.encode("utf-16"))
    require_telemetry(path)
    assert [body["batch"] for body in bodies(list(read_lines(path)))] == ["ä", "b"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "T [s];Q0;Q1;Q2;Q3\n0;1;0;0;0\n",
            "line 1: is no header of batches or gyro samples: a row of names such as spacecraft,",
        ),
        (
            dialect(";").replace("0.999800", "1").replace("4.5", "4,5", 1),
            "line 6: has a number with a decimal comma, but line 2 one with a decimal point",
        ),
        (
            dialect(";", ",").replace("4,5", "1.004,5", 1),
            "line 6: has a number with a decimal point, but line 2 one with a decimal comma",
        ),
        (dialect(";").replace("magnitude", "mag"), "line 1, column mag: there is no such column"),
        (file_of(ROWS, f"{HEADER},Magnitude"), "line 1, column magnitude: occurs twice"),
    ],
)
def test_what_is_not_read_is_refused_whole_in_a_line(text: str, message: str) -> None:
    with pytest.raises(BadFile) as refusal:
        read(text)
    assert message in str(refusal.value)


@pytest.mark.parametrize("number", ["1,234.5", "1 234", "4,5", "1,234", "5.0mag", "#N/A", "1e3,5"])
def test_a_number_that_has_another_form_refuses_its_batch(number: str) -> None:
    rows = [*ROWS[:3], f'{ROWS[3].rpartition(",")[0]},"{number}"', *ROWS[10:]]
    refused, *others = read(file_of(rows))
    assert str(refused.fault) == f"line 5, column magnitude: must be a number (got {number!r})"
    assert len(bodies(others)) == 3


FORMULAS = [
    '=HYPERLINK("http://x/","y")',
    "+1+1",
    "-2+3",
    "@SUM(1)",
    "＝1+1",
    "'=1",
    "''@x",
    "'plain",
    "a=b",
]
SEPARATORS = ["a;b", "=1;2", 'a";"b', "a,b;c"]


@pytest.mark.parametrize("name", SEPARATORS)
def test_a_text_with_a_separator_of_any_country_is_one_cell(name: str) -> None:
    star = {"vector": [-0.6, 0.0, 0.8]}
    body = {"spacecraft": "XTE", "batch": name, "time": "1996-01-10T12:00:00Z", "a_priori": None}
    body["observations"] = [{"tracker": name, "stars": [star]}]
    text = io.StringIO(newline="")
    write_batches_csv([BatchIn.model_validate(body)], text)
    cell = '"{}"'.format(neutralised(name).replace('"', '""'))
    assert f",{cell}," in text.getvalue().splitlines()[1]
    table = Table([Column("name", "text")], [[[name]]])
    assert b"".join(write_csv(table)).decode().splitlines() == ["name", cell]
    (line,) = read(text.getvalue())
    assert submission_from_json(line.body or b"").batch.batch == name


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_is_written_as_text_and_read_back(name: str) -> None:
    body = {
        "spacecraft": "XTE",
        "batch": name,
        "time": "1996-01-10T12:00:00Z",
        "a_priori": None,
        "observations": [{"tracker": name, "stars": [{"vector": [-0.6, 0.0, 0.8]}]}],
    }
    text = io.StringIO(newline="")
    write_batches_csv([BatchIn.model_validate(body)], text)
    cells = text.getvalue().splitlines()[1]
    assert neutralised(name)[0] in "'a"
    assert (f"'{name[0]}" in cells) == (name not in ("'plain", "a=b"))
    assert ",-0.6," in cells
    (line,) = read(text.getvalue())
    assert submission_from_json(line.body or b"").batch.batch == name


@pytest.mark.parametrize("name", [*FORMULAS, "\tx", "\r=1", "\n", "'", ""])
def test_what_is_neutralised_reads_back(name: str) -> None:
    assert original(neutralised(name)) == name
    assert neutralised(name)[:1] not in tuple("=+-@\t\r\n＝＋－＠")

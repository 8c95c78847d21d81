"""Telemetry files: every batch with its line, every fault with its place, the rest goes on."""

import io
import json
import math
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import BadBatch, BadFile
from service.observations.csv_rows import COLUMNS, write_batches_csv
from service.observations.decompress import MAX_LINE_BYTES, Line
from service.observations.schema import BatchIn, submission_from_json
from service.observations.telemetry import read_lines
from tests.scale import draws

HEADER = "spacecraft,batch,time,q1,q2,q3,qc,tracker,x,y,z,magnitude"


def ndjson(text: bytes) -> list[Line]:
    return list(read_lines(io.BytesIO(text)))


def csv(*rows: str) -> list[Line]:
    return list(read_lines(io.BytesIO("\n".join(rows).encode()), "csv"))


def row(batch: str, magnitude: str = "5.0", tail: str = "") -> str:
    return f"XTE,{batch},1996-01-10T12:00:00Z,0,0,0,1,STARTRACKER_1,0,0,1,{magnitude}{tail}"


def refused(lines: list[Line]) -> list[tuple[int, str]]:
    return [(line.number, str(line.fault)) for line in lines if line.fault is not None]


def batches(lines: list[Line]) -> list[tuple[int, str, int]]:
    read = [(line.number, json.loads(line.body)) for line in lines if line.body is not None]
    return [(n, body["batch"], len(body["observations"][0]["stars"])) for n, body in read]


def test_lines_are_numbered_from_one_and_blank_ones_are_counted_but_not_handed_on() -> None:
    lines = ndjson(b'\xef\xbb\xbf{"a":1}\r\n\n   \n{"b":2}\n{"c":3}')
    assert [(line.number, line.body) for line in lines] == [
        (1, b'{"a":1}'),
        (4, b'{"b":2}'),
        (5, b'{"c":3}'),
    ]


@pytest.mark.parametrize("text", [b"", b"\n", b"\xef\xbb\xbf"])
def test_an_empty_file_has_no_lines(text: bytes) -> None:
    assert ndjson(text) == []


def test_a_line_that_is_too_long_is_a_fault_with_its_number_and_the_rest_goes_on() -> None:
    long = b"x" * (3 * MAX_LINE_BYTES)
    lines = ndjson(b"one\n" + long + b"\nthree\n" + long)
    assert [(line.number, line.body) for line in lines if line.body] == [(1, b"one"), (3, b"three")]
    assert refused(lines) == [
        (2, f"line 2: is longer than {MAX_LINE_BYTES} bytes (got {len(long) + 1} bytes)"),
        (4, f"line 4: is longer than {MAX_LINE_BYTES} bytes (got {len(long)} bytes)"),
    ]


def test_a_line_of_just_the_limit_is_read() -> None:
    body = b"x" * MAX_LINE_BYTES
    assert [line.body for line in ndjson(body + b"\n" + body)] == [body, body]


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """64 MiB in one line, and 64 MiB in many, pass through a few MiB."""
    path = tmp_path / "long.ndjson"
    with path.open("wb") as file:
        for _ in range(64):
            file.write(b"x" * (1 << 20))
        for _ in range(64):
            file.write((b"y" * 1023 + b"\n") * 1024)
    tracemalloc.start()
    count = sum(1 for _ in read_lines(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 64 * 1024
    assert peak < 8 << 20


def test_a_file_that_is_not_there_is_a_bad_file_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"none\.ndjson: cannot be opened: No such file"):
        list(read_lines(tmp_path / "none.ndjson"))
    with pytest.raises(BadFile, match="cannot be opened: Is a directory"):
        list(read_lines(tmp_path))


def test_the_name_tells_the_form(tmp_path: Path) -> None:
    path = tmp_path / "PASS.CSV"
    path.write_text(f"{HEADER}\n{row('a')}\n")
    assert batches(list(read_lines(path))) == [(2, "a", 1)]


def test_rows_of_one_batch_form_it_though_others_lie_between() -> None:
    lines = csv(HEADER, row("a"), row("a"), "", row("b"), row("a"))
    assert batches(lines) == [(2, "a", 3), (5, "b", 1)]


def test_a_batch_of_rows_is_the_batch_of_json() -> None:
    header = (
        "spacecraft,batch,run,time,boresight_ra_deg,boresight_dec_deg,rate_x_deg_per_s,"
        "rate_y_deg_per_s,rate_z_deg_per_s,aberration,tracker,h_deg,v_deg,time_offset_s"
    )
    common = 'XTE,"one, two",night,1996-010T12:00:00Z, 83.5 ,-2,0,0.1,0,ignore'
    (line,) = csv(header, f"{common},A,1,-1.5,", f"{common},B,,,", f"{common},A,.5,+2e-1,0.25")
    assert line.body is not None
    assert json.loads(line.body) == {
        "spacecraft": "XTE",
        "batch": "one, two",
        "run": "night",
        "time": "1996-010T12:00:00Z",
        "aberration": "ignore",
        "a_priori": {"boresight": {"ra_deg": 83.5, "dec_deg": -2.0}},
        "body_rates_deg_per_s": [0.0, 0.1, 0.0],
        "observations": [
            {
                "tracker": "A",
                "stars": [
                    {"h_deg": 1.0, "v_deg": -1.5},
                    {"h_deg": 0.5, "v_deg": 0.2, "time_offset_s": 0.25},
                ],
            },
            {"tracker": "B", "stars": []},
        ],
    }


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("bright", "must be a number (got 'bright')"),
        ("NaN", "must be a number (got 'NaN')"),
        ("inf", "must be a number (got 'inf')"),
        ("1_0", "must be a number (got '1_0')"),
        ("1e999", "must be a finite number (got '1e999')"),
    ],
)
def test_a_bad_cell_names_line_and_column_and_refuses_its_batch_alone(
    cell: str, message: str
) -> None:
    lines = csv(HEADER, row("a"), row("b"), row("b", cell), row("b"), row("c"))
    assert refused(lines) == [(4, f"line 4, column magnitude: {message}")]
    assert batches(lines) == [(2, "a", 1), (6, "c", 1)]


def test_a_vector_with_an_empty_component_names_the_empty_cell() -> None:
    lines = csv(HEADER, row("a").replace("0,0,1,5.0", "0,,1,5.0"))
    assert refused(lines) == [
        (2, "line 2, column y: is empty, while the columns that belong to it are not")
    ]


def test_rows_of_one_batch_that_disagree_are_refused() -> None:
    other = row("a").replace("12:00:00", "12:00:01")
    assert refused(csv(HEADER, row("a"), other)) == [
        (
            3,
            (
                "line 3, column time: differs from line 2, the first of the batch "
                "(got '1996-01-10T12:00:01Z')"
            ),
        )
    ]


def test_two_a_priori_attitudes_in_one_batch_are_refused() -> None:
    lines = csv(HEADER + ",sun_pointed", row("a", tail=",true"), row("b", tail=",maybe"))
    assert refused(lines) == [
        (
            2,
            (
                "line 2, column batch: has more than one a priori attitude: "
                "quaternion and sun_pointed (got 'a')"
            ),
        ),
        (3, "line 3, column sun_pointed: must be true, false or empty (got 'maybe')"),
    ]


def test_options_that_are_no_json_are_refused() -> None:
    lines = csv(HEADER + ",options", row("a", tail=",{solver}"))
    assert refused(lines) == [(2, "line 2, column options: must be a JSON object (got '{solver}')")]


def test_a_row_with_too_few_or_too_many_cells_refuses_its_batch() -> None:
    lines = csv(HEADER, row("a"), row("a")[:-4], row("b"), row("c", tail=",1"))
    assert refused(lines) == [
        (3, "line 3: has 11 cells; the header has 12"),
        (5, "line 5: has 13 cells; the header has 12"),
    ]
    assert batches(lines) == [(4, "b", 1)]


@pytest.mark.parametrize("damaged", ["XTE", '"XTE', 'XTE,"a"b,c'])
def test_a_row_that_could_be_of_either_neighbour_refuses_both(damaged: str) -> None:
    """A batch is never taken with a star less than it had."""
    lines = csv(HEADER, row("a"), row("b"), damaged, row("b"), row("c"))
    assert [number for number, _ in refused(lines)] == [4, 4, 5]
    assert refused(lines)[0][1] == (
        "line 3: the batch may lack a star: the row beside it, line 4, cannot be read"
    )
    assert batches(lines) == [(2, "a", 1), (6, "c", 1)]


def test_a_batch_without_end_is_refused_and_not_held() -> None:
    lines = csv(HEADER, *[row("a")] * 4001, row("b"))
    assert refused(lines) == [(4002, "line 4002, column batch: has more than 4000 rows (got 'a')")]
    assert batches(lines) == [(4003, "b", 1)]


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER + ",color", "line 1, column color: there is no such column; there are spacecraft"),
        (HEADER + ",magnitde", "column magnitde: there is no such column; magnitude is meant?"),
        (HEADER + ",time", "line 1, column time: occurs twice"),
        (HEADER.replace("time,", ""), "line 1, column time: is missing"),
        (HEADER.replace(",qc", ""), "line 1, column qc: is missing"),
        (HEADER.replace(",x,y,z", ",h_deg"), "line 1, column v_deg: is missing"),
        (HEADER.replace(",x,y,z", ""), "line 1, column x: is missing"),
        ('spacecraft,"batch', "line 1: is not a row of comma-separated values"),
        ("", "line 1: there is no header"),
    ],
)
def test_a_header_that_makes_no_sense_refuses_the_file_at_once(header: str, message: str) -> None:
    with pytest.raises(BadFile) as refusal:
        csv(header, row("a")) if header else csv()
    assert message in str(refusal.value)


@given(st.binary(max_size=400))
def test_no_bytes_upset_the_readers(noise: bytes) -> None:
    """Whatever a file holds: lines, faults, or one BadFile for its header."""
    for line in ndjson(noise):
        assert (line.body is None) != (line.fault is None)
        with pytest.raises(BadBatch):
            submission_from_json(line.body or b"")
    for text in (noise, f"{HEADER}\n{row('a')}\n".encode() + noise):
        try:
            lines = list(read_lines(io.BytesIO(text), "csv"))
        except BadFile:
            continue
        assert all((line.body is None) != (line.fault is None) for line in lines)


numbers = st.floats(-1e6, 1e6, allow_subnormal=False)
small = st.floats(-80, 80)
keys = st.text(
    st.characters(exclude_categories=("Cs", "Cc", "Cf", "Zl", "Zp")), min_size=1, max_size=12
).filter(lambda text: text == text.strip())
units = st.sampled_from([[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.0, 0.6, 0.80000001]])
stars = st.fixed_dictionaries(
    {},
    optional={
        "magnitude": st.floats(-2, 12) | st.none(),
        "time_offset_s": st.floats(-2, 2),
        "sigma_arcsec": st.floats(0.1, 60),
    },
).flatmap(
    lambda rest: st.one_of(
        st.builds(lambda v: {**rest, "vector": v}, units),
        st.builds(lambda h, v: {**rest, "h_deg": h, "v_deg": v}, small, small),
    )
)
trackers = st.lists(
    st.fixed_dictionaries({"tracker": keys, "stars": st.lists(stars, max_size=4)}),
    min_size=1,
    max_size=3,
    unique_by=lambda tracker: tracker["tracker"],
).filter(lambda all_of: any(each["stars"] for each in all_of))
frames = st.fixed_dictionaries({}, optional={"frame": st.sampled_from(["EME2000", "ICRF"])})
priors = st.one_of(
    st.builds(lambda f: {"quaternion": [0.1, 0.2, 0.3, 0.9273618495495703], **f}, frames),
    st.builds(
        lambda ra, dec, f: {"boresight": {"ra_deg": ra, "dec_deg": dec}, **f},
        st.floats(0, 360),
        st.floats(-90, 90),
        frames,
    ),
    st.builds(lambda f: {"sun_pointed": True, **f}, frames),
)
triples = st.lists(st.floats(-90, 90), min_size=3, max_size=3)
bodies = st.fixed_dictionaries(
    {
        "spacecraft": keys,
        "batch": keys,
        "time": st.sampled_from(["1996-01-10T12:00:00.000Z", "2016-366T23:59:60.5Z"]),
        "a_priori": priors,
        "observations": trackers,
    },
    optional={
        "run": st.sampled_from(["live", "night-1"]),
        "body_rates_deg_per_s": triples,
        "velocity_km_per_s": triples,
        "position_km": st.lists(numbers, min_size=3, max_size=3).map(
            lambda km: [7e3, *km[1:]] if math.hypot(*km) < 7e3 else km
        ),
        "sun_vector": units,
        "aberration": st.sampled_from(["to_correct", "applied_upstream", "ignore"]),
        "options": st.just({"solver": "triad", "tolerances": {"magnitude_mag": 0.25}}),
    },
)


@settings(max_examples=draws(30, 100))
@given(st.lists(bodies, min_size=1, max_size=4, unique_by=lambda body: body["batch"]))
def test_rows_and_json_of_one_batch_are_one_submission(some: list[dict[str, object]]) -> None:
    """Written as CSV and read back, a batch has the text and the fingerprint that it had."""
    models = [BatchIn.model_validate_json(json.dumps(body)) for body in some]
    text = io.StringIO(newline="")
    write_batches_csv(models, text)
    assert text.getvalue().splitlines()[0] == ",".join(COLUMNS)
    lines = list(read_lines(io.BytesIO(text.getvalue().encode()), "csv"))
    assert refused(lines) == []
    assert [submission_from_json(line.body or b"").text for line in lines] == [
        submission_from_json(json.dumps(body)).text for body in some
    ]

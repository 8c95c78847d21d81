"""Tables, read by pyarrow, DuckDB, astropy and Python's own reader of CSV."""

import csv
import dataclasses
import io

import astropy.io.fits
import astropy.table
import astropy.time
import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

from service.app import fleet
from service.errors import NotAvailable
from service.features.products import result_tables
from service.features.products.attitude_formats import attitude_formats
from service.features.products.attitudes import COLUMNS, ESTIMATED_COLUMNS
from service.storage import gyro
from service.table_files.binary import write_fits, write_parquet
from service.table_files.table import Column, Table, write_csv
from service.times import parse_utc
from service.trends.quantities import QUANTITIES
from tests.features.products.series import GOLDEN, random_quaternions, rows, whole, written

QUATERNION, RATE = ("q1", "q2", "q3", "qc"), ("rate_x", "rate_y", "rate_z")


@pytest.fixture
def pages(rng):
    return [
        rows(random_quaternions(rng, 700)),
        rows(random_quaternions(rng, 300), "2016-12-31T23:58:00Z"),
        rows([GOLDEN], "2017-06-01T00:00:00.123456789Z"),
    ]


@pytest.fixture
def by_program(tmp_path):
    """The columns that each program reads, by its name."""

    def read(*pages):
        for name in ("csv", "parquet", "fits"):
            (tmp_path / f"t.{name}").write_bytes(written(name, *pages))
        lines = csv.DictReader(io.StringIO((tmp_path / "t.csv").read_text()))
        rows = [dict(each) for each in lines]
        arrow = pyarrow.parquet.read_table(tmp_path / "t.parquet")
        duck = duckdb.sql(f"SELECT * FROM '{tmp_path}/t.parquet'").fetchnumpy()
        table = astropy.io.fits.getdata(tmp_path / "t.fits", 1)
        return {
            "csv": lambda name: np.array([float(row[name] or "nan") for row in rows]),
            "pyarrow": lambda name: arrow[name].to_numpy(),
            "duckdb": lambda name: np.ma.filled(duck[name], np.nan),
            "astropy": lambda name: np.array(table[name], dtype=np.float64),
        }

    return read


def test_thirty_degrees_about_z_is_unchanged(by_program):
    for name, column in by_program(rows([GOLDEN])).items():
        assert [column(each).tolist() for each in QUATERNION] == [[q] for q in GOLDEN], name


def test_every_float_is_bit_equal(pages, by_program):
    wanted = whole(*pages)
    for program, column in by_program(*pages).items():
        for names, values in (
            (QUATERNION, wanted.quaternion),
            (RATE, wanted.rate_deg_per_s),
            (("p11", "p12", "p13", "p22", "p23", "p33"), wanted.covariance_arcsec2),
        ):
            for k, name in enumerate(names):
                known = ~np.isnan(values[:, k])
                found = column(name).astype(np.float64)
                assert found[known].tobytes() == values[known, k].tobytes(), (program, name)
                assert np.isnan(found[~known]).all()


def test_parquet_tells_units_frames_and_origin(tmp_path, pages):
    file = tmp_path / "t.parquet"
    file.write_bytes(written("parquet", *pages))
    schema = pyarrow.parquet.read_schema(file)
    for column in COLUMNS:
        told = schema.field(column.name).metadata
        assert told[b"description"].decode() == column.description
        assert told.get(b"unit", b"").decode() == column.unit
        assert told.get(b"frame", b"").decode() == column.frame
    assert schema.metadata[b"spacecraft"] == b"XTE"
    assert schema.metadata[b"largest_gap_s"] == b"60.0"


def test_fits_gives_the_same_moments_in_terrestrial_time(tmp_path, pages):
    file = tmp_path / "t.fits"
    file.write_bytes(written("fits", *pages))
    with astropy.io.fits.open(file) as hdus:
        hdus.verify("exception")
        header, data = hdus[1].header, hdus[1].data
        assert header["TIMESYS"] == "TT"
        assert header["TNULL3"] == -(2**63)
        reference = header["MJDREFI"] + header["MJDREFF"]
        found = astropy.time.Time(reference, data["TIME"] / 86_400, format="mjd", scale="tt")
        texts = [each.removesuffix("Z") for each in data["UTC"]]
        given = astropy.time.Time(texts, format="isot", scale="utc")
        assert np.abs((found - given).sec).max() < 1e-6
        assert "2016-12-31T23:59:60.000" in texts
        wanted = [parse_utc(each).tai_ns for each in data["UTC"]]
        assert data["tai_ns"].tolist() == wanted
        # The lone attitude has no rate.
        assert data["VALID"].tolist() == [True] * 1_000 + [False]
        assert (header["TTYPE8"], header["TUNIT8"]) == ("p11", "arcsec^2")
        names = [each.lower() for each in data.names]
        assert len(set(names)) == len(names)


def test_fits_has_units_that_astropy_knows(tmp_path):
    """Those of every table: a warning is an error here."""
    quantities = [Column(name, unit=each.unit) for name, each in QUANTITIES.items()]
    of_tables = [*COLUMNS, *ESTIMATED_COLUMNS, *quantities]
    for module in (fleet, result_tables, gyro):
        for each in vars(module).values():
            if isinstance(each, tuple) and each and isinstance(each[0], Column):
                of_tables += each
    assert {"UTC", "ppm", "rad/s"} & {each.unit for each in of_tables} == {"ppm", "rad/s"}
    for k, column in enumerate(of_tables):
        if column.kind in ("text", "utc"):
            assert not column.unit
        empty = Table([dataclasses.replace(column, name=f"c{k}")], [])
        (tmp_path / "t.fits").write_bytes(b"".join(write_fits(empty)))
        astropy.table.Table.read(tmp_path / "t.fits")


def test_parquet_has_times_to_compute_with_beside_those_with_leap_seconds(tmp_path):
    texts = [
        *("1996-01-10T12:00:00Z", "2016-12-31T23:59:59.5Z", "2016-12-31T23:59:60.25Z"),
        *("2017-01-01T00:00:00.250Z", "2017-06-01T00:00:00.123456789Z"),
    ]
    file = tmp_path / "t.parquet"
    file.write_bytes(b"".join(write_parquet(Table([Column("time", "utc")], [[texts]]))))
    found = pyarrow.parquet.read_table(file)
    assert found["time"].to_pylist() == texts
    assert found.schema.field("timestamp").type == pyarrow.timestamp("ns", "UTC")
    expected = [
        *("1996-01-10T12:00:00", "2016-12-31T23:59:59.5", "2017-01-01T00:00:00.25"),
        *("2017-01-01T00:00:00.25", "2017-06-01T00:00:00.123456789"),
    ]
    assert found["timestamp"].to_pandas().tolist() == [
        pd.Timestamp(each, tz="UTC") for each in expected
    ]


def test_values_that_are_not_known_are_nulls_in_each_kind_of_column(tmp_path):
    columns = [
        Column("n", "integer"),
        Column("x"),
        Column("t", "text", width=4),
        Column("f", "flag"),
    ]
    table = Table(columns, [[[1, None], [None, 2.5], ["é", None], [True, False]], [[], [], [], []]])
    (tmp_path / "t.fits").write_bytes(b"".join(write_fits(table)))
    (tmp_path / "t.parquet").write_bytes(b"".join(write_parquet(table)))
    with astropy.io.fits.open(tmp_path / "t.fits") as hdus:
        data = hdus[1].data
        assert data["n"].tolist() == [1, -(2**63)]
        assert np.isnan(data["x"][0])
        assert data["t"].tolist() == ["?", ""]
        assert data["f"].tolist() == [True, False]
        assert data["VALID"].tolist() == [False, False]
    found = pyarrow.parquet.read_table(tmp_path / "t.parquet").to_pydict()
    assert found == {"n": [1, None], "x": [None, 2.5], "t": ["é", None], "f": [True, False]}


def test_csv_reads_back_as_it_was(tmp_path):
    texts = ["a,b", 'say "x"', "two\r\nlines", None, "é", ""]
    numbers = [0.1, -5e-324, 1.7976931348623157e308, None, float("nan"), 1e-7]
    columns = [Column('odd, "name"', "text"), Column("x"), Column("n", "integer")]
    table = Table(columns, [[texts, numbers, [1, None, -(2**63), 2**63 - 1, 0, 7]], [[], [], []]])
    names, *found = csv.reader(io.StringIO(b"".join(write_csv(table)).decode(), newline=""))
    assert names == ['odd, "name"', "x", "n"]
    assert [row[0] for row in found] == ["a,b", 'say "x"', "two\r\nlines", "", "é", ""]
    known = [numbers[place] for place in (0, 1, 2, 5)]
    assert [float(row[1]) for row in found if row[1]] == known
    assert [row[2] for row in found] == ["1", "", str(-(2**63)), str(2**63 - 1), "0", "7"]


@pytest.mark.parametrize("name", ["parquet", "fits"])
def test_a_table_without_rows_is_a_file(tmp_path, name):
    file = tmp_path / f"t.{name}"
    file.write_bytes(written(name))
    if name == "fits":
        assert len(astropy.io.fits.getdata(file, 1)) == 0
    else:
        assert pyarrow.parquet.read_table(file).num_rows == 0


def test_a_format_without_its_package_names_the_command_that_installs_it(monkeypatch):
    extras = {"parquet": "tables", "fits": "tables", "ck": "spice"}
    formats = attitude_formats()
    for name in formats:
        formats[name].require(name)
    monkeypatch.setattr("service.extras.find_spec", lambda package: None)
    for name in formats.keys() - extras:
        formats[name].require(name)
    for name, extra in extras.items():
        with pytest.raises(NotAvailable, match=rf"pip install 'attitude-acquisition\[{extra}\]'"):
            formats[name].require(name)

"""Attitudes that trackers measured themselves: refusals by field, and as rows of CSV."""

import io
import json

import numpy as np
import pytest

from service.errors import BadBatch
from service.observations.csv_rows import write_batches_csv
from service.observations.schema import BatchIn, submission_from_json
from service.observations.telemetry import read_lines

MEASURED = {
    "spacecraft": "XTE",
    "batch": "q-1",
    "time": "1996-01-10T12:00:00Z",
    "measurement": {
        "quaternion": [0.0, 0.0, 0.258819045, 0.965925826],
        "tracker": "STARTRACKER_1",
        "sigma_arcsec": [6.0, 6.0, 40.0],
    },
    "a_priori": None,
}
STARS = [{"tracker": "STARTRACKER_1", "stars": [{"vector": [0.0, 0.0, 1.0]}]}]
COVARIANCE = [[36.0, 1.0, 0.0], [1.0, 36.0, 2.0], [0.0, 2.0, 1600.0]]


def told(**others):
    """The batch with some of its measurement changed; `...` leaves a field out."""
    changed = MEASURED["measurement"] | others
    kept = {name: value for name, value in changed.items() if value is not ...}
    return MEASURED | {"measurement": kept}


def faults_of(body):
    with pytest.raises(BadBatch) as refusal:
        submission_from_json(json.dumps(body))
    return {each.field: f"{each.message} {each.value}" for each in refusal.value.faults}


def covariance(rows):
    return told(sigma_arcsec=..., covariance_arcsec2=rows)


REFUSED = {
    "norm": (told(quaternion=[0.0, 0.0, 0.0, 1.0011]), "measurement.quaternion", "1.0011"),
    "nan": (told(quaternion=[0.0, float("nan"), 0.0, 1.0]), "measurement.quaternion.1", "nan"),
    "three": (
        told(quaternion=[0.0, 0.0, 1.0]),
        "measurement.quaternion",
        "must have 4 entries, not 3",
    ),
    "no sigma": (told(sigma_arcsec=...), "measurement", "either sigma_arcsec"),
    "both": (told(covariance_arcsec2=COVARIANCE), "measurement", "either sigma_arcsec"),
    "zero": (told(sigma_arcsec=[6.0, 0.0, 6.0]), "measurement.sigma_arcsec.1", "0.001"),
    "negative": (told(sigma_arcsec=[6.0, -6.0, 6.0]), "measurement.sigma_arcsec.1", "-6"),
    "far apart": (
        told(sigma_arcsec=[0.009, 6.0, 1000.0]),
        "measurement.sigma_arcsec",
        "below 1e-05 of the largest",
    ),
    "covariance far apart": (
        covariance([[0.009**2, 0.0, 0.0], [0.0, 36.0, 0.0], [0.0, 0.0, 1e6]]),
        "measurement.covariance_arcsec2",
        "below 1e-05 of the largest",
    ),
    "not positive": (
        covariance([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "measurement.covariance_arcsec2",
        "positive definite",
    ),
    "lopsided": (
        covariance([[36.0, 1.0, 0.0], [0.0, 36.0, 0.0], [0.0, 0.0, 36.0]]),
        "measurement.covariance_arcsec2",
        "symmetric",
    ),
    "degrees": (
        covariance([[1e12, 0.0, 0.0], [0.0, 36.0, 0.0], [0.0, 0.0, 36.0]]),
        "measurement.covariance_arcsec2",
        "36000",
    ),
    "nan covariance": (
        covariance([[float("nan"), 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "measurement.covariance_arcsec2.0.0",
        "nan",
    ),
    "frame": (told(frame="B1950"), "measurement.frame", "B1950"),
    "stars": (MEASURED | {"observations": STARS}, "observations", "not both"),
    "a priori": (MEASURED | {"a_priori": {"from": "last"}}, "a_priori", "null"),
    "options": (MEASURED | {"options": {"solver": "quest"}}, "options", "left out"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_measurement_is_named_with_its_value(name):
    body, field, words = REFUSED[name]
    assert words in faults_of(body)[field]


def test_a_norm_within_a_thousandth_is_made_one():
    batch = submission_from_json(json.dumps(told(quaternion=[0.0, 0.0, 0.0, 1.0009]))).batch
    assert np.array_equal(batch.measurement.quaternion, [0.0, 0.0, 0.0, 1.0])


def test_the_sigmas_are_the_diagonal_of_the_covariance():
    batch = submission_from_json(json.dumps(MEASURED)).batch
    expected = np.diag([36.0, 36.0, 1600.0])
    assert np.array_equal(batch.measurement.covariance_arcsec2, expected)
    assert (batch.observations, batch.a_priori) == ((), None)


BODIES = [MEASURED, covariance(COVARIANCE), told(tracker=..., frame="ICRF")]


def test_what_is_written_as_csv_reads_back_the_same_beside_batches_of_stars():
    stars = {**MEASURED, "batch": "s-1", "observations": STARS}
    del stars["measurement"]
    bodies = [body | {"batch": f"q-{k}"} for k, body in enumerate(BODIES)]
    models = [BatchIn.model_validate_json(json.dumps(body)) for body in [*bodies, stars]]
    stream = io.StringIO(newline="")
    write_batches_csv(models, stream)
    lines = list(read_lines(io.BytesIO(stream.getvalue().encode()), "csv"))
    assert [line.fault for line in lines] == [None] * 4
    assert [BatchIn.model_validate_json(line.body) for line in lines] == models


HEADER = "spacecraft,batch,time,tracker,measured_q1,measured_q2,measured_q3,measured_qc"
SIGMAS = "measured_sigma_x_arcsec,measured_sigma_y_arcsec,measured_sigma_z_arcsec"
ROW = "XTE,q-1,1996-01-10T12:00:00Z,STARTRACKER_1,0,0,0,1,6,6,40"


def lines_of(*rows):
    return list(read_lines(io.BytesIO("\n".join(rows).encode()), "csv"))


def test_a_file_of_quaternions_alone_needs_no_columns_of_stars():
    (line,) = lines_of(f"{HEADER},{SIGMAS}", ROW)
    batch = submission_from_json(line.body).batch
    assert batch.measurement.tracker == "STARTRACKER_1"
    assert np.array_equal(batch.measurement.quaternion, [0.0, 0.0, 0.0, 1.0])


def test_a_row_with_a_bad_cell_is_refused_by_its_column():
    (line,) = lines_of(f"{HEADER},{SIGMAS}", ROW.replace(",0,0,0,1,", ",0,,0,1,"))
    assert (line.body, line.fault.field) == (None, "line 2, column measured_q2")
    (line,) = lines_of(f"{HEADER},{SIGMAS},frame", f"{ROW},EME2000", f"{ROW},ICRF")
    assert (line.body, line.fault.field) == (None, "line 3, column frame")
    (line,) = lines_of(f"{HEADER},{SIGMAS},x,y,z", f"{ROW},0,0,1")
    assert "beside a measured attitude" in line.fault.message

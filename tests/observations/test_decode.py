"""A batch is made of its canonical text, which says no less than what was sent."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import NODEFAULT
from msgspec.structs import fields

from service.observations import decode as canonical
from service.observations import schema as wire
from service.observations.decode import batch_from_canonical
from service.observations.schema import MeasurementIn, PredictionIn
from tests.observations.example import BATCH

ALIKE = [
    (wire.StarIn, canonical.SentStar),
    (wire.TrackerIn, canonical.SentTracker),
    (wire.DirectionIn, canonical.SentDirection),
    (wire.OptionsIn, canonical.SentOptions),
    (wire.BatchIn, canonical.SentBatch),
    (PredictionIn, canonical.SentPrediction),
    (MeasurementIn, canonical.SentMeasurement),
]
PRIORS = (wire.QuaternionIn, wire.BoresightIn, wire.SunPointedIn, wire.FromLastIn)


def _defaults(struct):
    return {
        each.name: each.default if each.default_factory is NODEFAULT else each.default_factory()
        for each in fields(struct)
        if not each.required
    }


def _is_absent(default):
    return default is None or np.isnan(np.array(default, float)).all()


@pytest.mark.parametrize(("model", "struct"), ALIKE)
def test_what_the_text_leaves_out_has_the_default_of_the_model(model, struct):
    """The text leaves defaults out: those who write it and those who read it must agree."""
    assert set(model.model_fields) == set(struct.__struct_fields__)
    defaults = _defaults(struct)
    for name, field in model.model_fields.items():
        if field.is_required():
            assert name not in defaults
        elif field.default is None:
            assert _is_absent(defaults[name]), name
        elif not isinstance(field.default, wire.Wire):
            assert defaults[name] == field.default, name


def test_every_kind_of_prior_has_its_fields():
    fields = {name for model in PRIORS for name in model.model_fields}
    assert fields == set(canonical.SentPrior.__struct_fields__)
    with_frame = [model for model in PRIORS if model is not wire.FromLastIn]
    assert {model.model_fields["frame"].default for model in with_frame} == {
        _defaults(canonical.SentPrior)["frame"]
    }


components = st.floats(-1.0, 1.0, allow_subnormal=False)
numbers = {
    "magnitude": st.floats(-30, 30),
    "time_offset_s": st.floats(-3600, 3600),
    "sigma_arcsec": st.floats(1e-3, 3600),
}


@st.composite
def directions(draw):
    if draw(st.booleans()):
        angle = st.floats(-88, 88)
        return {"h_deg": draw(angle), "v_deg": draw(angle)}
    vector = np.array([draw(components), draw(components), 0.1 + abs(draw(components))])
    scale = draw(st.floats(0.9992, 1.0008)) / np.linalg.norm(vector)
    return {"vector": (vector * scale).tolist()}


@st.composite
def stars(draw):
    return draw(directions()) | draw(st.fixed_dictionaries({}, optional=numbers))


def unlike(star):
    """A star as a value: exact repeats count once, and several magnitudes of zero are none."""
    if star.get("magnitude") == 0.0:
        return "zero"
    return json.dumps({name: np.add(value, 0.0).tolist() for name, value in star.items()})


@given(st.lists(stars(), min_size=1, max_size=8, unique_by=unlike))
def test_every_number_of_a_star_arrives_as_it_was_sent(sent):
    body = BATCH | {"observations": [BATCH["observations"][0] | {"stars": sent}]}
    (seen,) = wire.submission_from_json(json.dumps(body)).batch.observations
    absent = {"magnitude": math.nan, "time_offset_s": 0.0, "sigma_arcsec": math.nan}
    for name, column in (
        ("magnitude", seen.magnitude_mag),
        ("time_offset_s", seen.time_offset_s),
        ("sigma_arcsec", seen.sigma_arcsec),
    ):
        assert np.array_equal(column, [s.get(name, absent[name]) for s in sent], equal_nan=True)
    for star, vector, angles in zip(sent, seen.vector, seen.angles_deg, strict=True):
        given_vector = np.array(star.get("vector", [math.nan] * 3))
        expected = given_vector / np.linalg.norm(given_vector)
        assert np.allclose(vector, expected, rtol=0.0, atol=1e-15, equal_nan=True)
        expected_angles = [star.get("h_deg", math.nan), star.get("v_deg", math.nan)]
        assert np.array_equal(angles, expected_angles, equal_nan=True)


def test_what_is_worked_on_cannot_be_written_to():
    batch = wire.submission_from_json(json.dumps(BATCH)).batch
    (seen,) = batch.observations
    arrays = (seen.vector, seen.angles_deg, seen.magnitude_mag, seen.time_offset_s)
    for array in (*arrays, seen.sigma_arcsec, batch.body_rates_deg_per_s):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_a_text_that_says_more_than_is_known_is_not_half_read():
    text = wire.checked_from_json(json.dumps(BATCH)).text
    more = json.dumps(json.loads(text) | {"of_a_later_version": 1})
    with pytest.raises(ValueError, match="of_a_later_version"):
        batch_from_canonical(more)

"""A batch is read whole or refused with every fault, each naming its field and its value."""

import copy
import json
import math

import numpy as np
import pytest

from service.errors import BadBatch
from service.observations.batch import (
    MAX_STARS_PER_TRACKER,
    BoresightPrior,
    QuaternionPrior,
    SunPointedPrior,
)
from service.observations.schema import submission_from_json
from tests.observations.example import BATCH

STAR = "observations.0.stars.0"


def changed(path, value):
    """The batch with one value put in place, or taken out where it is Ellipsis."""
    body = copy.deepcopy(BATCH)
    at = body
    *way, last = [int(p) if p.isdigit() else p for p in path.split(".")]
    for part in way:
        at = at[part] if not isinstance(at, dict) else at.setdefault(part, {})
    if value is ...:
        del at[last]
    else:
        at[last] = value
    return body


def read(body, **kwargs):
    return submission_from_json(json.dumps(body), **kwargs)


def test_every_field_of_the_batch_arrives_in_its_place():
    batch = read(BATCH).batch
    assert (batch.spacecraft, batch.batch, batch.run) == ("XTE", "1996-010-0001", "live")
    assert batch.time.text == "1996-01-10T12:00:00.000Z"
    assert isinstance(batch.a_priori, QuaternionPrior)
    assert batch.a_priori.quaternion == pytest.approx(BATCH["a_priori"]["quaternion"])
    assert batch.velocity_km_per_s.tolist() == [0.0, 7.5, 0.0]
    assert batch.aberration == "to_correct"
    (stars,) = batch.observations
    assert (stars.tracker, stars.count) == ("STARTRACKER_1", 2)
    norm = math.hypot(0.0123, -0.0157, 0.9998)
    assert stars.vector[0] == pytest.approx(np.array([0.0123, -0.0157, 0.9998]) / norm, abs=1e-15)
    assert np.isnan(stars.vector[1]).all()
    assert stars.angles_deg[1].tolist() == [0.52, -1.21]
    assert stars.magnitude_mag.tolist() == [5.31, 4.02]
    assert np.isnan(stars.sigma_arcsec[0])
    assert stars.sigma_arcsec[1] == 3.0


def test_what_is_left_out_has_its_default():
    body = {key: BATCH[key] for key in ("spacecraft", "batch", "time", "a_priori")}
    body["observations"] = [
        {"tracker": "STARTRACKER_1", "stars": [{"h_deg": 0, "v_deg": 0}]},
    ]
    batch = read(body).batch
    assert batch.aberration == "to_correct"
    assert batch.velocity_km_per_s is None
    assert batch.body_rates_deg_per_s.tolist() == [0, 0, 0]
    assert np.isnan(batch.observations[0].magnitude_mag).all()
    assert batch.observations[0].time_offset_s.tolist() == [0.0]


def test_every_kind_of_prior_is_told_apart():
    boresight = read(changed("a_priori", {"boresight": {"ra_deg": 83.0, "dec_deg": -5.0}}))
    assert boresight.batch.a_priori == BoresightPrior(83.0, -5.0)
    sun = read(changed("a_priori", {"sun_pointed": True})).batch.a_priori
    assert sun == SunPointedPrior(None, None)
    placed = read(changed("a_priori", {"sun_pointed": True, "position_km": [1.0, 2.0, 3.0]}))
    assert placed.batch.a_priori.position_km.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("inside", [True, False])
def test_the_sun_vector_may_stand_in_the_prior_or_beside_it(inside):
    body = changed("a_priori", {"sun_pointed": True})
    (body["a_priori"] if inside else body)["sun_vector"] = [0.0, 0.6, 0.8]
    assert read(body).batch.a_priori.sun_vector == pytest.approx([0.0, 0.6, 0.8])


def test_a_run_that_is_asked_for_takes_the_place_of_the_batch_s():
    assert read(BATCH, run="night").batch.run == "night"
    assert read({**BATCH, "run": "day"}).batch.run == "day"


def test_a_byte_order_mark_before_a_batch_makes_no_other_batch():
    text = json.dumps(BATCH)
    for body in ("\ufeff" + text, b"\xef\xbb\xbf" + text.encode()):
        assert submission_from_json(body).fingerprint == read(BATCH).fingerprint


def test_vectors_within_a_thousandth_of_norm_one_are_normalised():
    for norm in (0.9991, 1.0009):
        star = read(changed(f"{STAR}.vector", [0.0, 0.0, norm])).batch.observations[0].vector[0]
        assert star.tolist() == [0.0, 0.0, 1.0]


UNSEEN = [
    "a\tb",
    "a\x85b",
    "a\u200bb",
    "a\u200db",
    "a\u202eb",
    "a\u2066b",
    "a\ufeffb",
    "\u00ad",
    " a",
    "a ",
]
UNSEEN += ["\u00a0a", "a\u3000", " "]


@pytest.mark.parametrize("name", UNSEEN, ids=map(ascii, UNSEEN))
@pytest.mark.parametrize("field", ["batch", "observations.0.tracker"])
def test_a_name_with_a_character_that_nobody_sees_is_refused(field, name):
    with pytest.raises(BadBatch) as refused:
        read(changed(field, name))
    assert refused.value.faults[0].field.replace("[", ".").replace("]", "") == field


@pytest.mark.parametrize("name", ["a", "a b", "é漢😀", "-_.,;'\"<&>", "=1"])
def test_any_other_name_is_taken(name):
    assert read(changed("batch", name)).batch.batch == name


class TestIdentity:
    def test_white_space_and_the_order_of_keys_make_no_other_body(self):
        turned = dict(reversed(BATCH.items()))
        one, other = read(BATCH), submission_from_json(json.dumps(turned, indent=3).encode())
        assert one.fingerprint == other.fingerprint
        assert one.text == other.text

    def test_numbers_written_otherwise_and_defaults_spelled_out_make_no_other_body(self):
        body = changed("body_rates_deg_per_s", ...)
        body["velocity_km_per_s"] = [0, 7.50, 0e0]
        body["run"] = "live"
        assert read(body).fingerprint == read(BATCH).fingerprint

    @pytest.mark.parametrize(
        ("path", "value"),
        [
            (f"{STAR}.magnitude", 5.310000000000001),
            (f"{STAR}.vector", [0.0123, -0.0157, 0.99980001]),
            ("time", "1996-01-10T12:00:00.000000001Z"),
            ("aberration", "ignore"),
            ("run", "other"),
            ("velocity_km_per_s", ...),
            ("options.identifier", "starid"),
        ],
    )
    def test_any_difference_makes_another_body(self, path, value):
        assert read(changed(path, value)).fingerprint != read(BATCH).fingerprint

    @pytest.mark.parametrize(
        "prior",
        [
            BATCH["a_priori"],
            {"boresight": {"ra_deg": 83.0, "dec_deg": -5.0}},
            {"sun_pointed": True, "sun_vector": [0.0, 0.6, 0.8]},
            {"sun_pointed": True},
        ],
    )
    def test_the_text_that_is_kept_reads_back_as_itself(self, prior):
        body = changed("a_priori", prior)
        body["options"] = {
            "tests": {"magnitude": False},
            "tolerances": {"separation_deg": 0.01},
            "zone_grid_deg": 0,
        }
        first = read(body)
        again = submission_from_json(first.text)
        assert again.text == first.text
        assert again.fingerprint == first.fingerprint
        assert again.batch.options == first.batch.options


REFUSED = [
    ("spacecraft", ..., "spacecraft", "required"),
    ("spacecraft", "", "spacecraft", "must not be empty"),
    ("spacecraft", 5, "spacecraft", "must be text"),
    ("batch", "a\nb", "batch", "without control characters"),
    ("batch", "x" * 200, "batch", "128"),
    ("run", "no spaces", "run", "letters, digits"),
    ("time", "1996-02-30T00:00:00Z", "time", "no such day"),
    ("time", "2200-01-01T00:00:00Z", "time", "year"),
    ("time", 5, "time", "must be text"),
    ("a_priori", ..., "a_priori", "required"),
    ("a_priori", {}, "a_priori", "one of quaternion, boresight, sun_pointed"),
    ("a_priori", [1], "a_priori", "one of quaternion, boresight, sun_pointed"),
    ("a_priori.quaternion", [2.0, 0.0, 0.0, 0.0], "a_priori.quaternion", "norm is 2"),
    ("a_priori.quaternion", [0.0, 0.0, 0.0, 0.0], "a_priori.quaternion", "norm"),
    ("a_priori.quaternion", [1.0, 0.0, 0.0], "a_priori.quaternion", "must have 4 entries, not 3"),
    ("a_priori.frame", "B1950", "a_priori.frame", "EME2000"),
    ("a_priori.roll", 3, "a_priori.roll", "no such field"),
    ("a_priori", {"sun_pointed": False}, "a_priori.sun_pointed", "True"),
    ("a_priori", {"boresight": {"ra_deg": 10.0, "dec_deg": 91.0}}, "dec_deg", "90"),
    ("velocity_km_per_s", [0.0, 1e5, 0.0], "velocity_km_per_s.1", "100"),
    ("body_rates_deg_per_s", [0.0, 0.0], "body_rates_deg_per_s", "must have 3 entries, not 2"),
    ("aberration", "maybe", "aberration", "to_correct"),
    ("observations", [], "observations", "at least 1"),
    ("observations.0.stars", [], "observations", "no stars"),
    (f"{STAR}.vector", [0.0, 0.0, 0.0], f"{STAR}.vector", "norm"),
    (f"{STAR}.vector", [0.0, 0.0, 1.1], f"{STAR}.vector", "norm is 1.1"),
    (f"{STAR}.vector", ["0", "0", "1"], f"{STAR}.vector.0", "number"),
    (f"{STAR}.vector", [True, False, False], f"{STAR}.vector.0", "number"),
    (f"{STAR}.vector", ..., STAR, "needs either"),
    (f"{STAR}.h_deg", 1.0, STAR, "not both"),
    (f"{STAR}.magnitude", 500, f"{STAR}.magnitude", "30"),
    (f"{STAR}.magnitude", "5.3", f"{STAR}.magnitude", "number"),
    (f"{STAR}.time_offset_s", 1e6, f"{STAR}.time_offset_s", "3600"),
    (f"{STAR}.sigma_arcsec", 0, f"{STAR}.sigma_arcsec", "0.001"),
    (f"{STAR}.color", 0.5, f"{STAR}.color", "no such field"),
    ("options.tolerances.separation_deg", -1, "options.tolerances.separation_deg", "0"),
    ("options.tolerances.SEPTOL", 1, "options.tolerances.SEPTOL", "no such field"),
    ("options.tests.magnitude", "perhaps", "options.tests.magnitude", "true or false"),
    ("options.identifier", "guess", "options.identifier", "starid"),
    ("options.zone_grid_deg", -1, "options.zone_grid_deg", "0"),
    ("comment", "hello", "comment", "no such field"),
]


@pytest.mark.parametrize(("path", "value", "field", "words"), REFUSED)
def test_what_is_wrong_is_named_by_its_field(path, value, field, words):
    with pytest.raises(BadBatch) as refusal:
        read(changed(path, value))
    faults = refusal.value.faults
    assert any(fault.field.endswith(field) and words in str(fault) for fault in faults), faults


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
@pytest.mark.parametrize(
    "path",
    [
        f"{STAR}.magnitude",
        f"{STAR}.vector",
        "a_priori.quaternion",
        "velocity_km_per_s",
        "options.zone_grid_deg",
    ],
)
def test_numbers_that_are_none_are_refused_by_the_field_s_name(path, number):
    old = changed(path, "@")
    replacement = number if path.endswith(("magnitude", "deg")) else f"[{number}, 0, 0, 0]"
    if path.endswith(("vector", "s")):
        replacement = f"[{number}, 0, 0]"
    with pytest.raises(BadBatch) as refusal:
        submission_from_json(json.dumps(old).replace('"@"', replacement))
    assert refusal.value.faults[0].field.startswith(path)
    assert "finite" in str(refusal.value)


@pytest.mark.parametrize(
    "text", ["", "{", '{"spacecraft": "XTE"', "[]", "5", "null", '"x"', "\x00", "{'a': 1}"]
)
def test_what_is_no_batch_at_all_is_refused(text):
    with pytest.raises(BadBatch):
        submission_from_json(text)


def test_bytes_that_are_no_text_are_refused():
    with pytest.raises(BadBatch):
        submission_from_json(b'{"spacecraft": "\xff\xfe"}')


def test_every_fault_is_told_at_once():
    body = changed(f"{STAR}.magnitude", 500)
    body["time"] = "yesterday"
    body["aberration"] = "maybe"
    with pytest.raises(BadBatch) as refusal:
        read(body)
    assert {fault.field for fault in refusal.value.faults} >= {
        "time",
        "aberration",
        f"{STAR}.magnitude",
    }
    assert "500" in str(refusal.value)
    assert "yesterday" in str(refusal.value)


def test_ten_thousand_stars_are_refused_with_the_limit():
    many = [{"h_deg": 0.0, "v_deg": 0.0}] * 10_000
    with pytest.raises(BadBatch, match=str(MAX_STARS_PER_TRACKER)):
        read(changed("observations.0.stars", many))


def test_one_tracker_twice_is_refused():
    body = copy.deepcopy(BATCH)
    body["observations"] *= 2
    with pytest.raises(BadBatch, match="STARTRACKER_1"):
        read(body)


def test_a_deeply_nested_body_is_refused():
    with pytest.raises(BadBatch):
        submission_from_json('{"a_priori": ' + "[" * 5000 + "]" * 5000 + "}")


def test_without_a_prior_and_with_any_identifier_a_batch_is_read():
    assert read(changed("a_priori", None)).batch.a_priori is None
    for identifier in ("starid", "verified", "ptp", "lost_in_space"):
        options = read(changed("options.identifier", identifier)).batch.options
        assert options.identifier == identifier


def test_a_key_of_any_length_gets_a_message_of_a_few_words():
    body = {**BATCH, "x" * 1_000_000: 1}
    with pytest.raises(BadBatch) as refusal:
        submission_from_json(json.dumps(body))
    fault = refusal.value.faults[0]
    assert fault.field == "x" * 80
    assert len(str(refusal.value)) < 500


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ({"from": "last", "fro": 1}, "did you mean from?"),
        ({"from": "last", "boresigh": 1}, "did you mean boresight?"),
        ({"from": "last", "sun_counts": [1, 1, 1, 1]}, "beside from"),
        ({"quaternion": [0, 0, 0, 1], "from": "last"}, "beside quaternion"),
    ],
)
def test_a_field_of_a_priori_knowledge_has_the_name_that_is_sent(prior, words):
    with pytest.raises(BadBatch) as refused:
        read(BATCH | {"a_priori": prior})
    assert words in str(refused.value)
    assert "from_" not in str(refused.value)

"""SKY2000 records, written by the published description of their bytes, and read again."""

import gzip
import json
import math

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.acquire import acquire
from service.errors import BadFile
from service.observations.schema import submission_from_json
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.sky2000 import FIELDS, is_sky2000, read_sky2000
from service.sky.catalog.star_catalog import import_catalog, load, save
from service.sky.model import SkyModel
from tests.sky.sky2000_records import LAYOUT, SIRIUS, written


def at(ra_deg, dec_deg):
    """The bytes of a position, rounded as they are."""
    _, time = erfa.a2tf(4, math.radians(ra_deg))
    sign, arc = erfa.a2af(3, math.radians(dec_deg))
    return {
        "RAh": int(time["h"]) % 24,
        "RAm": int(time["m"]),
        "RAs": int(time["s"]) + int(time["f"]) / 1e4,
        "DE-": bytes(sign).decode(),
        "DEd": int(arc["h"]),
        "DEm": int(arc["m"]),
        "DEs": int(arc["s"]) + int(arc["f"]) / 1e3,
    }


@pytest.fixture
def file(tmp_path):
    def write(*records, name="sky2kv4.dat", end="\n"):
        path = tmp_path / name
        path.write_bytes("".join(record + end for record in records).encode("latin-1"))
        return path

    return write


def test_the_bytes_that_are_read_are_those_of_the_description():
    for label, field in FIELDS.items():
        first, last, form = LAYOUT[label]
        assert (field.first, field.last, field.whole) == (first, last, form[0] == "I")


def test_a_star_comes_with_its_number_and_in_the_units_of_the_service(file):
    """Seconds of time become an arc; the values are those of Hipparcos to their last digits."""
    catalog = import_catalog(file(written(**SIRIUS)))
    assert catalog.star_id(0) == "SKYMAP 6450085"
    assert (catalog.hip[0], catalog.hd[0], catalog.sao[0]) == (0, 48915, 151881)
    assert catalog.ra_deg[0] == pytest.approx(101.28715542, abs=1e-7)
    assert catalog.dec_deg[0] == pytest.approx(-16.71611583, abs=1e-7)
    assert catalog.pm_ra_mas_per_year[0] == pytest.approx(-552.7, abs=0.2)
    assert catalog.pm_dec_mas_per_year[0] == pytest.approx(-1205.3)
    assert catalog.parallax_mas[0] == pytest.approx(375.0)
    assert (catalog.magnitude_v_mag[0], catalog.color_bv_mag[0]) == (-1.46, 0.009)
    assert catalog.position_sigma_arcsec[0] == 0.01


positions = st.fixed_dictionaries(
    {
        "RAh": st.integers(0, 23),
        "RAm": st.integers(0, 59),
        "RAs": st.integers(0, 600_000).map(lambda n: n / 1e4),
        "DE-": st.sampled_from("+-"),
        "DEd": st.integers(0, 89),
        "DEm": st.integers(0, 59),
        "DEs": st.integers(0, 60_000).map(lambda n: n / 1e3),
    }
)
optional = st.fixed_dictionaries(
    {
        "HD": st.none() | st.integers(1, 359_083),
        "SAO": st.none() | st.integers(1, 258_997),
        "e_pos": st.none() | st.integers(0, 99_999).map(lambda n: n / 1e4),
        "pmRA": st.none() | st.integers(-99_999, 99_999).map(lambda n: n / 1e5),
        "pmDE": st.none() | st.integers(-99_999, 99_999).map(lambda n: n / 1e4),
        "Plx": st.none() | st.integers(-99_999, 99_999).map(lambda n: n / 1e5),
        "Vmag": st.none() | st.integers(-1500, 15_000).map(lambda n: n / 1e3),
        "Vder": st.none() | st.integers(-150, 1500).map(lambda n: n / 1e2),
        "Bmag": st.none() | st.integers(-1500, 15_000).map(lambda n: n / 1e3),
        "B-V": st.none() | st.integers(-999, 5_000).map(lambda n: n / 1e3),
        "varAmp": st.none() | st.integers(0, 2_000).map(lambda n: n / 1e2),
    }
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sky2000")


@settings(max_examples=40, deadline=None)
@given(stars=st.lists(st.tuples(positions, optional), min_size=1, max_size=6))
def test_what_is_written_by_the_description_is_what_is_read(folder, stars):
    """To the last digit that the bytes have, blank fields as unknown, saved and loaded again."""
    path = folder / "stars.dat"
    values = [{"ID": 10 + k, **place, **more} for k, (place, more) in enumerate(stars)]
    path.write_text("".join(written(**each) + "\n" for each in values))
    known = [v for v in values if v["Vmag"] is not None or v["Vder"] is not None]
    if not known:
        with pytest.raises(BadFile, match="no star"):
            read_sky2000(path)
        return
    assert len(read_sky2000(path).without_magnitude) == len(values) - len(known)
    save(import_catalog(path), folder / "stars.npz")
    catalog = load(folder / "stars.npz")
    assert len(catalog) == len(known)
    for star in known:
        row = catalog.row_of(f"SKYMAP {star['ID']}")
        ra = 15 * (star["RAh"] + star["RAm"] / 60 + star["RAs"] / 3600) % 360
        dec = star["DEd"] + star["DEm"] / 60 + star["DEs"] / 3600
        assert catalog.ra_deg[row] == pytest.approx(ra, abs=1e-10)
        assert catalog.dec_deg[row] == pytest.approx(dec if star["DE-"] == "+" else -dec, abs=1e-10)
        assert catalog.magnitude_v_mag[row] == (
            star["Vder"] if star["Vmag"] is None else star["Vmag"]
        )
        for name, label, scale in (
            ("parallax_mas", "Plx", 1000.0),
            ("variability_mag", "varAmp", 1.0),
            ("position_sigma_arcsec", "e_pos", 1.0),
        ):
            expected = math.nan if star[label] is None else scale * star[label]
            assert getattr(catalog, name)[row] == pytest.approx(expected, nan_ok=True)
        motion = 15_000 * (star["pmRA"] or 0.0) * math.cos(math.radians(catalog.dec_deg[row]))
        assert catalog.pm_ra_mas_per_year[row] == pytest.approx(motion)
        assert catalog.pm_dec_mas_per_year[row] == pytest.approx(1000 * (star["pmDE"] or 0.0))
        assert (catalog.hd[row], catalog.sao[row]) == (star["HD"] or 0, star["SAO"] or 0)
        color = star["B-V"]
        if color is None and None not in (star["Bmag"], star["Vmag"]):
            color = star["Bmag"] - star["Vmag"]
        assert catalog.color_bv_mag[row] == pytest.approx(
            math.nan if color is None else color, nan_ok=True
        )


def test_signs_that_stand_off_from_their_digits_are_read(file):
    """As the catalog has them: the sign in the first byte, the digits at the right."""
    record = list(written(**SIRIUS))
    record[157:165] = "- 1.2053"
    record[175:183] = "+ .37500"
    catalog = import_catalog(file("".join(record)))
    assert catalog.pm_dec_mas_per_year[0] == pytest.approx(-1205.3)
    assert catalog.parallax_mas[0] == pytest.approx(375.0)


def test_cut_off_blanks_other_line_ends_and_compression_change_nothing(file, tmp_path):
    records = [written(**SIRIUS), written(**(SIRIUS | {"ID": 7, "Vmag": 3.0}))]
    plain = import_catalog(file(*records))
    cut = import_catalog(file(*(r.rstrip() for r in records), name="cut.dat", end="\r\n"))
    packed = tmp_path / "packed.dat.gz"
    packed.write_bytes(gzip.compress(file(*records, name="raw.dat").read_bytes()))
    assert is_sky2000(packed)
    for other in (cut, import_catalog(packed)):
        assert other.digest == plain.digest


def test_a_file_that_was_cut_off_within_a_record_is_refused(file):
    """Also where the record has its magnitudes: what it lacks is not blank."""
    path = file(written(**SIRIUS), written(**(SIRIUS | {"ID": 7})))
    for kept in (300, 521 + 300):
        cut = path.with_name(f"cut{kept}.dat")
        cut.write_bytes(path.read_bytes()[:kept])
        with pytest.raises(BadFile, match="without a line end"):
            read_sky2000(cut)


def test_a_component_whose_light_is_blended_into_another_is_not_counted_twice(file):
    """A and B in one blended magnitude, A's; of two that both show the sum, the first keeps it."""
    pair = {"ID_A": 1, "ID_B": 2}
    a = SIRIUS | pair | {"ID": 1, "Vmag": 4.0, "f_Vmag": "b"}
    b = SIRIUS | pair | {"ID": 2, "Vmag": 5.0}
    catalog = import_catalog(file(written(**a), written(**b)))
    assert catalog.light_elsewhere.tolist() == [False, True]
    catalog = import_catalog(file(written(**a), written(**(b | {"Vmag": 4.0, "f_Vmag": "b"}))))
    assert catalog.light_elsewhere.tolist() == [False, True]
    catalog = import_catalog(file(written(**(a | {"f_Vmag": " "})), written(**b)))
    assert catalog.light_elsewhere.tolist() == [False, False]


def damaged(**changes):
    record = list(written(**SIRIUS))
    for place, text in changes.items():
        first = int(place[1:])
        record[first - 1 : first - 1 + len(text)] = text
    return "".join(record)


@pytest.mark.parametrize(
    ("record", "told"),
    [
        (damaged(b28="        "), "line 2, bytes 28-35 (ID): must not be blank"),
        (damaged(b28=" 123x567"), "line 2, bytes 28-35 (ID): must be a whole number"),
        (damaged(b119="24"), "line 2, bytes 119-120 (RAh): must be between 0 and 23"),
        (damaged(b123="60.0001"), "line 2, bytes 123-129 (RAs): must be between 0 and 60"),
        (damaged(b123="  nan  "), "line 2, bytes 123-129 (RAs): must be a number"),
        (damaged(b130="*"), "line 2, byte 130 (DE-): must be + or -"),
        (damaged(b131="90"), "line 2, bytes 131-132 (DEd): is beyond the pole"),
        (damaged(b131="  "), "line 2, bytes 131-132 (DEd): must not be blank"),
        (damaged(b150="  1 2   "), "line 2, bytes 150-157 (pmRA): must be a number"),
        (damaged(b233=" 1e3  "), "line 2, bytes 233-238 (Vmag): must be a number"),
        (damaged(b233="99.000"), "line 2, bytes 233-238 (Vmag): must be between -5 and 30"),
        (damaged(b1="SKYMAP2"), "line 2: must begin with SKY2000"),
        (damaged() + "x", "line 2: must not be longer than 520 bytes"),
        (damaged()[:200], "line 2: must be 520 bytes long"),
        (damaged(b99="caf\xe9"), "line 2: must hold printable ASCII"),
        (damaged(b99="a\0b"), "line 2: must hold printable ASCII"),
        (damaged(b28="      99"), "line 2, bytes 28-35 (ID): is already on line 1"),
    ],
)
def test_a_damaged_record_is_refused_with_line_bytes_and_value(file, record, told):
    path = file(written(**(SIRIUS | {"ID": 99})), record)
    with pytest.raises(BadFile) as refusal:
        import_catalog(path)
    assert told in str(refusal.value)


def test_a_thousand_faults_are_not_all_told(file):
    path = file(*(damaged(b119="99") for _ in range(1000)))
    with pytest.raises(BadFile) as refusal:
        import_catalog(path)
    assert len(refusal.value.faults) == 20


def test_a_compressed_file_that_was_cut_off_is_refused(tmp_path):
    whole = gzip.compress((written(**SIRIUS) + "\n").encode() * 50)
    path = tmp_path / "cut.dat.gz"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadFile):
        import_catalog(path, "sky2000")


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=1200), at=st.integers(0, 520))
def test_whatever_a_file_holds_it_is_read_or_refused(folder, data, at):
    path = folder / "any.dat"
    record = written(**SIRIUS).encode()
    for content in (data, record[:at] + data + record[at:], record[:at] + data[: 520 - at]):
        path.write_bytes(content)
        faults = ()
        try:
            assert len(read_sky2000(path).columns["label"]) >= 1
        except BadFile as refusal:
            faults = refusal.faults
        assert len(faults) <= 20


def test_a_site_that_has_the_catalog_identifies_by_its_numbers(missions, sky, seed, tmp_path):
    """The embedded stars as SKY2000 records: whatever is named has the right number."""
    mission, shipped = missions["XTE"], sky.catalog
    path, names = tmp_path / "sky2kv4.dat", {}
    with path.open("w") as out:
        for row in np.flatnonzero(shipped.magnitude_v_mag <= 6.9).tolist():
            names[f"SKYMAP {row + 1}"] = shipped.star_id(row)
            cosine = math.cos(math.radians(float(shipped.dec_deg[row])))
            record = at(float(shipped.ra_deg[row]), float(shipped.dec_deg[row])) | {
                "ID": row + 1,
                "pmRA": float(shipped.pm_ra_mas_per_year[row]) / (15_000 * cosine),
                "pmDE": float(shipped.pm_dec_mas_per_year[row]) / 1000,
                "Vmag": float(shipped.magnitude_v_mag[row]),
            }
            out.write(written(**record) + "\n")
    site = SkyModel(import_catalog(path), LruCache(64 << 20))
    wanted = Pass(12, seed, troubles=NO_TROUBLES)
    named = by_shipped = 0
    for drawn in draw_pass(mission, sky, wanted):
        batch = submission_from_json(json.dumps(drawn.batch)).batch
        found = acquire(batch, mission, site)
        for tracker in acquire(batch, mission, sky).trackers:
            by_shipped += int(np.count_nonzero(tracker.identification.star >= 0))
        for tracker, truth in zip(found.trackers, drawn.truth["observations"], strict=True):
            for star, true in zip(tracker.identification.star, truth["stars"], strict=True):
                if star >= 0:
                    assert names[found.run_catalog.star_id[star]] == true
                    named += 1
    # Without the fainter stars a batch of few stars may stay without an answer.
    assert named >= 0.5 * by_shipped > 10

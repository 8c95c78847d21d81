"""The pipeline from a batch to an attitude, end to end, by hand and on the real sky."""

import copy
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.choices import choices_of
from service.acquire.prewarm import prewarm_kernels, prewarm_zones
from service.attitude.solution import NoAttitude
from service.errors import BadBatch, Busy
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission
from service.observations.batch import BoresightPrior
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache, NotAtHand
from service.sky.catalog.star_catalog import import_csv
from service.sky.model import SkyModel
from service.storage.recording.answer import star_rows
from service.times import parse_utc
from service.vectors import attitude_error_arcsec, matrix_from_quaternion, to_ra_dec
from tests.reference import batches
from tests.reference.compare import (
    Judge,
    answer_as_json,
    answered,
    plain_view,
    zone_searched,
)
from tests.reference.plain_starid import PlainCatalog

TIME = "2000-01-01T12:00:00.000Z"

IN_ZONES = sorted(name for name, entry in IDENTIFIERS.items() if entry.searches_zone)


def read(body):
    return submission_from_json(json.dumps(body)).batch


def without_clock(answer):
    """An answer less what may differ from one time to the next: times, and what was cached."""
    answer = copy.deepcopy(answer)
    del answer["timings_us"]
    for tracker in answer["observations"]:
        del tracker["zone"]["cached"]
    return answer


class TestByHand:
    """Three stars around right ascension 90 deg on the equator; the body's axes turned by 90 deg.

    Body X then lies along inertial Y, where the first star stands.  The second,
    one degree east, is seen one degree towards body Y: h = 1.  The third, two
    degrees north, two towards body Z: v = 2.
    """

    STARS = ("A 1,90,0,3.0", "B 2,91,0,4.0", "C 3,90,2,5.0", "D 4,200,40,2.0")
    SEEN = ((0.0, 0.0, 3.0), (1.0, 0.0, 4.0), (0.0, 2.0, 5.0))
    TRUTH = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))

    @pytest.fixture
    def sky_of(self, tmp_path):
        def made(*stars):
            path = tmp_path / f"{len(stars)}.csv"
            path.write_text("\n".join(["id,ra_deg,dec_deg,magnitude", *stars]) + "\n")
            return SkyModel(import_csv(path), LruCache(1 << 20))

        return made

    @pytest.fixture
    def small_sky(self, sky_of):
        return sky_of(*self.STARS)

    def batch(self, seen=SEEN, off_deg=1.0, **other):
        half = math.radians(90.0 + off_deg) / 2.0
        return {
            "spacecraft": "XTE",
            "batch": "by hand",
            "time": TIME,
            "a_priori": {"quaternion": [0.0, 0.0, math.sin(half), math.cos(half)]},
            "aberration": "ignore",
            "options": {"identifier": "starid"},
            "observations": [
                {
                    "tracker": "STARTRACKER_1",
                    "stars": [{"h_deg": h, "v_deg": v, "magnitude": m} for h, v, m in seen],
                }
            ],
            **other,
        }

    def test_the_stars_are_named_and_the_attitude_is_the_true_one(self, small_sky, missions):
        found = acquire(read(self.batch()), missions["XTE"], small_sky)
        answer = answer_as_json(found, id="1")
        stars = answer["observations"][0]["stars"]
        assert [star["star"]["id"] for star in stars] == ["A 1", "B 2", "C 3"]
        assert [(star["votes"], star["runner_up"]) for star in stars] == [(2, 0)] * 3
        assert answer["counts"] == {"observed": 3, "unique": 3, "ambiguous": 0, "unmatched": 0}
        attitude = answer["attitude"]
        assert attitude["quaternion"] == pytest.approx(self.TRUTH, abs=1e-9)
        assert (attitude["frame"], attitude["method"]) == ("EME2000", "quest")
        assert attitude["status"] == "good"
        assert attitude["triad"] == pytest.approx(self.TRUTH, abs=1e-9)
        assert answer["reason"] is None
        assert max(star["residual_arcsec"] for star in stars) < 1e-3

    def test_the_covariance_is_the_one_of_three_stars_by_hand(self, small_sky, missions):
        """Sum of sigma^-2 (I - b b^T) over (1,0,0), (c,s,0) at 1 and (c,0,s) at 2 deg."""
        found = acquire(read(self.batch()), missions["XTE"], small_sky)
        b = np.array(
            [
                [1.0, 0.0, 0.0],
                [math.cos(math.radians(1)), math.sin(math.radians(1)), 0.0],
                [math.cos(math.radians(2)), 0.0, math.sin(math.radians(2))],
            ]
        )
        matrix = (3 * np.eye(3) - b.T @ b) / 2.1213203**2
        assert found.solution.covariance_arcsec2 == pytest.approx(np.linalg.inv(matrix), rel=1e-6)
        assert np.argmax(np.diag(found.solution.covariance_arcsec2)) == 0

    def test_the_boresight_alone_is_enough_where_magnitudes_tell_the_order(
        self, small_sky, missions
    ):
        prior = {"boresight": {"ra_deg": 88.0, "dec_deg": 1.0}}
        found = acquire(read(self.batch(a_priori=prior)), missions["XTE"], small_sky)
        assert found.solution.quaternion == pytest.approx(self.TRUTH, abs=1e-9)
        assert not found.choices.tests.cross_product

    def test_triad_is_the_solution_where_it_is_asked_for(self, small_sky, missions):
        options = {"identifier": "starid", "solver": "triad"}
        found = acquire(read(self.batch(options=options)), missions["XTE"], small_sky)
        assert found.solution.method == "triad"
        assert (found.solution.quaternion == found.solution.triad).all()

    @pytest.mark.parametrize("count", [1, 2])
    def test_fewer_than_two_unique_stars_are_a_reason_and_no_error(
        self, small_sky, missions, count
    ):
        options = {"identifier": "starid", "tests": {"magnitude": False, "cross_product": False}}
        body = self.batch(self.SEEN[:count], options=options)
        answer = answer_as_json(acquire(read(body), missions["XTE"], small_sky), id="1")
        assert answer["attitude"] is None
        assert answer["reason"] == "fewer_than_two_unique_stars"
        assert answer["counts"]["unmatched" if count == 1 else "ambiguous"] == count
        if count == 2:
            assert answer["observations"][0]["stars"][0]["rivals"] == ["A 1", "B 2"]

    @pytest.mark.parametrize("identifier", IN_ZONES)
    def test_a_zone_without_stars_leaves_all_unmatched(self, small_sky, missions, identifier):
        body = self.batch(a_priori={"boresight": {"ra_deg": 10.0, "dec_deg": -60.0}})
        body["options"] = {"identifier": identifier}
        mission = missions["XTE"].within_zones
        answer = answer_as_json(acquire(read(body), mission, small_sky), id="1")
        assert answer["counts"]["unmatched"] == 3
        assert answer["observations"][0]["zone"]["stars"] == 0

    def test_two_stars_under_one_name_are_told(self, small_sky, missions):
        """The third star's double is seen beside it: both are taken for the one catalog star."""
        seen = (*self.SEEN, (0.001, 2.0, 5.0))
        found = acquire(read(self.batch(seen)), missions["XTE"], small_sky)
        assert [row.star_id for row in star_rows(found)][2:] == ["C 3", "C 3"]
        assert any("same_star_twice" in warning for warning in found.warnings)

    def test_a_star_is_unique_from_a_probability_of_999_in_1000(self, sky_of, missions):
        """One star moved away step by step: from certain to improbable, through all between."""
        sky = sky_of(*self.STARS, "E 5,90.5,1,4.5", "F 6,89.2,-0.7,3.6")
        found = []
        for off_arcsec in np.arange(0.0, 100.0, 2.0):
            seen = (*self.SEEN, (0.5 + off_arcsec / 3600.0, 1.0, 4.5), (-0.8, -0.7, 3.6))
            body = self.batch(seen, options={"identifier": "verified"})
            answer = answer_as_json(acquire(read(body), missions["XTE"].within_zones, sky), id="1")
            found += answer["observations"][0]["stars"]
        assert all((each["outcome"] == "unique") == (each["star"] is not None) for each in found)
        named = [each["probability"] for each in found if each["outcome"] == "unique"]
        ambiguous = [each["probability"] for each in found if each["outcome"] == "ambiguous"]
        assert min(named) >= 0.999
        assert max(ambiguous) < 0.999
        # Without such a one the bound would not have been put to the test.
        assert any(each > 0.99 for each in ambiguous)

    def test_a_list_of_rivals_that_was_cut_is_told(self, sky_of, missions):
        """Pairs of one separation all over the zone: any of their stars may be the two seen."""
        for pairs, told in ((10, False), (11, True)):
            places = [(87.0 + k % 4 * 1.3, -4.0 + k // 4 * 2.3) for k in range(pairs)]
            sky = sky_of(
                *(f"P {ra}{dec},{ra},{dec},4" for ra, dec in places),
                *(f"Q {ra}{dec},{ra},{dec + 0.5},4" for ra, dec in places),
            )
            for identifier in ("starid", "verified"):
                options = {"identifier": identifier, "tests": {"cross_product": False}}
                body = self.batch(((0.0, 0.0, 4.0), (0.5, 0.0, 4.0)), options=options)
                body["a_priori"] = {"boresight": {"ra_deg": 89.0, "dec_deg": 0.0}}
                answer = answer_as_json(
                    acquire(read(body), missions["XTE"].within_zones, sky), id="1"
                )
                rivals = [star["rivals"] for star in answer["observations"][0]["stars"]]
                assert [len(each) for each in rivals] == [20, 20]
                warned = [each for each in answer["warnings"] if each.startswith("rivals_cut: ")]
                assert len(warned) == told
                if told:
                    assert "STARTRACKER_1 end at 20; stars with more rivals: 2" in warned[0]

    def test_a_field_past_the_zone_s_edge_is_told(self, small_sky, missions):
        for off_deg, told in ((6.0, False), (7.0, True)):
            found = acquire(read(self.batch(off_deg=off_deg)), missions["XTE"], small_sky)
            assert any("field_of_view_past_zone_edge" in w for w in found.warnings) == told

    def test_flags_tell_what_is_odd_about_a_star(self, small_sky, missions):
        body = self.batch((*self.SEEN, (4.5, 0.0, 5.0)))
        del body["observations"][0]["stars"][0]["magnitude"]
        stars = answer_as_json(acquire(read(body), missions["XTE"], small_sky), id="1")[
            "observations"
        ][0]["stars"]
        assert [star["flags"] for star in stars] == [
            ["no_magnitude"], [], [], ["outside_field_of_view"]
        ]  # fmt: skip

    def test_star_rows_are_the_answer_s_stars_in_their_order(self, small_sky, missions):
        found = acquire(read(self.batch((*self.SEEN, (3.0, 3.0, 5.0)))), missions["XTE"], small_sky)
        rows = star_rows(found)
        assert [row.position for row in rows] == [0, 1, 2, 3]
        assert [row.star_id for row in rows] == ["A 1", "B 2", "C 3", None]
        assert rows[3].residual_arcsec is None
        assert {row.tracker for row in rows} == {"STARTRACKER_1"}


def test_a_zone_of_another_run_catalog_is_never_used(sky, missions):
    """One mission name, one shelf: a catalog of another limit and of another epoch."""
    mission = missions["XTE"]
    settings = mission.model_dump()
    settings["catalog"]["magnitude_limit_mag"] = 4.0
    brighter = Mission.model_validate(settings)
    prior = {"boresight": {"ra_deg": 83.6, "dec_deg": -1.0}}
    stars = [{"h_deg": 0.0, "v_deg": 0.0}, {"h_deg": 1.0, "v_deg": 0.0}]
    body = {
        "spacecraft": "XTE",
        "batch": "zones",
        "a_priori": prior,
        "observations": [{"tracker": "STARTRACKER_1", "stars": stars}],
    }
    shared = SkyModel(sky.catalog, LruCache(64 << 20))
    catalogs = set()
    for its_mission, year in ((mission, 1995), (brighter, 1995), (mission, 1975), (mission, 1995)):
        batch = read({**body, "time": f"{year}-06-01T00:00:00.000Z"})
        alone = acquire(batch, its_mission, SkyModel(sky.catalog, LruCache(64 << 20)))
        found = acquire(batch, its_mission, shared)
        catalogs.add(found.provenance.run_catalog)
        zone = zone_searched(found, shared)
        expected = zone_searched(alone, SkyModel(sky.catalog, LruCache(64 << 20)))
        assert zone.run_catalog == found.provenance.run_catalog
        assert zone.direction.tolist() == expected.direction.tolist()
        assert without_clock(answer_as_json(found, id="1")) == without_clock(
            answer_as_json(alone, id="1")
        )
    assert len(catalogs) == 3


class TestFit:
    """What does not fit the mission is refused with its field."""

    def refused(self, missions, sky, name, prior, field, **other):
        body = {**TestByHand().batch(), "spacecraft": name, "a_priori": prior, **other}
        with pytest.raises(BadBatch) as refusal:
            acquire(read(body), missions[name], sky)
        assert refusal.value.faults[0].field == field

    def test_a_boresight_for_a_band(self, missions, sky):
        prior = {"boresight": {"ra_deg": 0.0, "dec_deg": 0.0}}
        self.refused(missions, sky, "SOHO", prior, "a_priori.boresight")

    def test_a_sun_pointed_cap(self, missions, sky):
        self.refused(missions, sky, "XTE", {"sun_pointed": True}, "a_priori.sun_pointed")

    @pytest.mark.parametrize(
        ("test", "prior"),
        [
            ("pole", {"quaternion": [0, 0, 0, 1]}),
            ("cross_product", {"boresight": {"ra_deg": 0.0, "dec_deg": 0.0}}),
            ("fov_rotation", {"boresight": {"ra_deg": 0.0, "dec_deg": 0.0}}),
        ],
    )
    def test_a_test_that_cannot_be_made_is_off_and_the_answer_says_so(
        self, missions, sky, test, prior
    ):
        body = TestByHand().batch(a_priori=prior, options={"tests": {test: True}})
        found = acquire(read(body), missions["XTE"], sky)
        assert not getattr(found.choices.tests, test)
        assert any(warning.startswith(f"test_off: {test}") for warning in found.warnings)

    def test_a_boresight_for_a_tracker_that_looks_elsewhere(self, mission_files, sky):
        mission = Mission.model_validate(batches.with_trackers(mission_files["XTE"], 2))
        body = TestByHand().batch(a_priori={"boresight": {"ra_deg": 0.0, "dec_deg": 0.0}})
        body["observations"][0]["tracker"] = "STARTRACKER_2"
        with pytest.raises(BadBatch, match="give a quaternion") as refusal:
            acquire(read(body), mission, sky)
        assert refusal.value.faults[0].field == "observations.0.tracker"


def nominal(rng, judge, number, **fixed):
    toml = judge.toml
    attitude = batches.prior_attitudes(rng, toml, 3)[2]
    fixed = {
        "prior": "quaternion", "error_deg": 0.1, "stars": 5, "spurious": 0, "missing": 0.0,
        "noise_arcsec": 2.1, "magnitude_noise": 0.1, "options": {}, "time": batches.TIMES[1],
        **fixed,
    }  # fmt: skip
    return batches.draw_batch(rng, toml, judge.catalog(fixed["time"]), attitude, number, **fixed)


@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_an_answer_depends_neither_on_the_batches_before_it_nor_on_other_threads(
    name, rng, mission_files, sky
):
    judge = Judge(mission_files[name], sky)
    bodies = [nominal(rng, judge, k) for k in range(24)]
    alone = [
        without_clock(answered(body, judge.mission, SkyModel(sky.catalog, LruCache(64 << 20))))
        for body in bodies[:4]
    ]
    shared = SkyModel(sky.catalog, LruCache(8 << 20))
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda body: answered(body, judge.mission, shared), bodies * 2))
    assert [without_clock(answer) for answer in together[:4]] == alone
    assert [without_clock(a) for a in together[:24]] == [without_clock(a) for a in together[24:]]


@pytest.mark.parametrize("name", ["XTE", "SWAS", "SOHO"])
def test_what_is_solved_at_once_is_what_takes_its_time_and_nothing_is_built_for_it(
    name, rng, mission_files, sky
):
    judge = Judge(mission_files[name], sky)
    fresh, had_at_once = SkyModel(sky.catalog, LruCache(64 << 20)), 0
    kinds = ({}, {"error_deg": 20.0}, {"spurious": 8})
    drawn = [nominal(rng, judge, k, **kinds[k % 3]) for k in range(24)]
    options = [{"options": {"identifier": IN_ZONES[k % 2]}} for k in range(24)]
    sent = [read(body | option) for body, option in zip(drawn, options, strict=True)]
    for batch in sent:
        with pytest.raises(NotAtHand):
            acquire(batch, judge.mission, fresh, at_once=True)
    assert fresh.cache.state().entries == ()
    for number, batch in enumerate(sent):
        usual = acquire(batch, judge.mission, fresh)
        entries = fresh.cache.state().misses
        try:
            at_once = acquire(batch, judge.mission, fresh, at_once=True)
        except NotAtHand:
            # Its stars are all real, and near the a priori attitude.
            assert number % 3 > 0
            continue
        finally:
            assert fresh.cache.state().misses == entries
        had_at_once += 1
        one, other = (answer_as_json(each, id="1") for each in (usual, at_once))
        assert without_clock(one) == without_clock(other)
    assert had_at_once >= 8


def test_fifty_first_requests_for_one_zone_build_it_once(mission_files, sky, rng):
    judge = Judge(mission_files["SOHO"], sky)
    body = nominal(rng, judge, 0)
    fresh = SkyModel(sky.catalog, LruCache(64 << 20))
    fresh.run_catalog(judge.mission, parse_utc(body["time"]))
    with ThreadPoolExecutor(50) as pool:
        answers = list(pool.map(lambda _: answered(body, judge.mission, fresh), range(50)))
    cached = [answer["observations"][0]["zone"]["cached"] for answer in answers]
    assert cached.count(False) == 1
    # One run catalog and one zone.
    assert fresh.cache.state().misses == 2


def test_a_pole_far_from_the_sun_is_told_and_not_refused(rng, mission_files, sky):
    judge = Judge(mission_files["SOHO"], sky)
    answer = answered(nominal(rng, judge, 0), judge.mission, sky)
    assert any("pole_off_sun" in warning for warning in answer["warnings"])


@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_residuals_of_whole_passes_are_as_predicted(name, rng, mission_files, sky):
    """Through identification, alignment and rates: TASTE as expected, all but a few good."""
    judge = Judge(mission_files[name], sky)
    sigma = judge.mission.trackers[0].sigma_arcsec
    tastes, good = [], 0
    for number in range(120):
        body = nominal(rng, judge, number, rates_deg_per_s=0.06, aberration="ignore", stars=6)
        body["options"] = {"identifier": "starid", "zone_grid_deg": 0.25}
        found = acquire(read(body), judge.mission, sky)
        if found.solution is None or found.counts["unique"] < 5:
            continue
        assert found.solution.degrees_of_freedom == 2 * found.counts["unique"] - 3
        tastes.append(found.solution.taste / found.solution.degrees_of_freedom)
        good += not found.solution.suspect
        assert np.nanmax(found.trackers[0].residual_arcsec) < 10 * sigma or found.solution.suspect
    assert len(tastes) > 60
    assert good >= len(tastes) - 4
    assert np.median(tastes) == pytest.approx(0.95, abs=0.35)


def test_several_trackers_give_one_attitude_and_each_its_own_zone(rng, mission_files, sky):
    judge = Judge(batches.with_trackers(mission_files["XTE"], 3), sky)
    for number in range(12):
        body = nominal(rng, judge, number, aberration="ignore", rates_deg_per_s=0.0)
        answer = answered(body, judge.mission, sky)
        zones = {(t["zone"]["ra_deg"], t["zone"]["dec_deg"]) for t in answer["observations"]}
        assert len(zones) == 3
        attitude = answer["attitude"]
        assert [t["tracker"] for t in attitude["trackers"]] == [
            f"STARTRACKER_{k}" for k in (1, 2, 3)
        ]
        assert sum(t["taste"] for t in attitude["trackers"]) == pytest.approx(attitude["taste"])


def test_a_misaligned_tracker_is_identified_all_the_same_and_named(rng, mission_files, sky):
    """Two arcminutes: far within its zone, far beyond what the joint attitude can hold."""
    toml = batches.with_trackers(mission_files["XTE"], 3)
    judge = Judge(toml, sky)
    turn = batches.rotation([0.2, 1.0, 0.3], 2.0 / 60.0)
    bent = copy.deepcopy(toml)
    for axis in "xyz":
        key = f"{axis}_axis_body"
        bent["trackers"][1][key] = (turn @ np.array(toml["trackers"][1][key])).tolist()
    mission = Mission.model_validate(bent)
    named = 0
    for number in range(20):
        body = nominal(rng, judge, number, aberration="ignore", rates_deg_per_s=0.0, stars=6)
        answer = answered(body, mission, sky)
        named += answer["attitude"]["outlier"] == "STARTRACKER_2"
        # Where its two stars are ambiguous, it has no part in the attitude.
        is_used = answer["attitude"]["trackers"][1]["stars"] > 0
        assert answer["attitude"]["status"] == "suspect" or not is_used
    assert named >= 17


def test_the_true_attitude_is_found_to_a_thousandth_of_an_arcsecond_without_noise(
    rng, mission_files, sky
):
    judge = Judge(mission_files["XTE"], sky)
    run = sky.run_catalog(judge.mission, parse_utc(TIME))
    of_day = to_ra_dec(run.direction_at(parse_utc(TIME)))
    catalog = PlainCatalog(list(run.star_id), *of_day, run.magnitude_mag)
    for number in range(20):
        truth = batches.quaternion_matrix(batches.random_quaternion(rng))
        # The a priori attitude is two degrees off; the stars are seen as they are.
        prior = batches.rotation(rng.normal(size=3), 2.0) @ truth
        body = batches.draw_batch(
            rng, {**judge.toml, "zone": {**judge.toml["zone"]}}, catalog, truth, number,
            prior="quaternion", error_deg=0.0, stars=6, spurious=0, missing=0.0, noise_arcsec=0.0,
            magnitude_noise=0.05, options={}, time=TIME, aberration="ignore", rates_deg_per_s=0.0,
        )  # fmt: skip
        body["a_priori"]["quaternion"] = batches.matrix_quaternion(prior).tolist()
        found = acquire(read(body), judge.mission, sky)
        if found.counts["unique"] < 4:
            continue
        solved = matrix_from_quaternion(found.solution.quaternion)
        assert np.linalg.norm(attitude_error_arcsec(solved, truth)) < 1e-3


def test_a_batch_s_own_year_decides_its_run_catalog(mission_files, sky):
    judge = Judge(mission_files["XTE"], sky)
    for text, year in (
        ("1996-01-10T12:00:00Z", 1996.0),
        ("1996-07-10T12:00:00Z", 1997.0),
        ("2026-11-21T00:00:00Z", 2027.0),
    ):
        run = sky.run_catalog(judge.mission, parse_utc(text))
        assert run.epoch_year == year
    early, late = (
        sky.run_catalog(judge.mission, parse_utc(f"{year}-01-01T00:00:00Z"))
        for year in (1980, 2030)
    )
    # Groombridge 1830 moves by 7 arcsec a year; at V 6.4 both hold it.
    rows = [run.star_id.index("HIP 57939") for run in (early, late)]
    moved = np.linalg.norm(early.direction[rows[0]] - late.direction[rows[1]]) * 206264.8
    assert moved == pytest.approx(7.06 * 50.0, rel=0.01)


def test_provenance_and_counts_say_what_an_answer_was_made_of(rng, mission_files, sky):
    judge = Judge(mission_files["XTE"], sky)
    answer = answered(nominal(rng, judge, 0), judge.mission, sky)
    made_of = answer["provenance"]
    assert made_of["catalog"] == sky.catalog.digest
    assert made_of["mission"] == judge.mission.digest
    assert made_of["epoch_year"] == 1996.0
    counts = answer["counts"]
    assert counts["observed"] == sum(counts[k] for k in ("unique", "ambiguous", "unmatched"))
    assert set(answer["timings_us"]) == {"zone", "identify", "solve", "record"}


def test_warmed_zones_are_those_that_batches_ask_for(rng, mission_files, missions, sky):
    fresh = SkyModel(sky.catalog, LruCache(64 << 20))
    prewarm_zones(fresh, missions["XTE"], BoresightPrior(83.0, -5.0), parse_utc(TIME))
    body = TestByHand().batch(a_priori={"boresight": {"ra_deg": 83.05, "dec_deg": -5.05}})
    assert answered(body, missions["XTE"], fresh)["observations"][0]["zone"]["cached"]
    assert fresh.drop_zones("SWAS") == 0
    assert fresh.drop_zones("XTE") == 1
    assert not answered(body, missions["XTE"], fresh)["observations"][0]["zone"]["cached"]


def test_warming_up_leaves_nothing_on_the_shelf(missions, sky):
    fresh = SkyModel(sky.catalog, LruCache(64 << 20))
    prewarm_kernels(fresh, missions)
    assert fresh.cache.state().entries == ()


def test_a_batch_s_options_take_the_place_of_the_mission_s_settings(missions):
    body = TestByHand().batch(
        options={
            "identifier": "starid",
            "solver": "triad",
            "tests": {"magnitude": False},
            "tolerances": {"separation_deg": 0.02},
            "zone_grid_deg": 0,
        }
    )
    choices = choices_of(read(body), missions["XTE"])
    assert (choices.identifier, choices.solver, choices.zone_grid_deg) == ("starid", "triad", 0.0)
    assert choices.tolerances.separation_deg == 0.02
    assert choices.tolerances.magnitude_mag == 0.6
    assert not choices.tests.magnitude
    assert choices.tests.cross_product
    assert not choices.tests.pole
    plain = choices_of(read(TestByHand().batch()), missions["XTE"])
    assert (plain.solver, plain.zone_grid_deg) == ("quest", 1.0)


def test_never_an_older_attitude_after_a_batch_that_has_none(rng, mission_files, sky):
    judge = Judge(mission_files["XTE"], sky)
    assert answered(nominal(rng, judge, 0), judge.mission, sky)["attitude"] is not None
    alone = answered(nominal(rng, judge, 1, stars=1), judge.mission, sky)
    assert alone["attitude"] is None
    assert alone["reason"] == str(NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS)
    assert plain_view(alone)[0][0].outcome in {"unmatched", "ambiguous"}


def test_what_needs_the_whole_sky_waits_for_its_kernels_and_a_zone_does_not(
    rng, mission_files, missions, sky
):
    judge, mission = Judge(mission_files["XTE"], sky), missions["XTE"]

    def not_yet():
        raise Busy("the service is compiling its kernels", 10)

    compiling = replace(sky, require_whole_sky=not_yet)
    batch = nominal(rng, judge, 0) | {"options": {"identifier": "verified"}}
    answers = [without_clock(answered(batch, mission, each)) for each in (sky, compiling)]
    assert answers[0] == answers[1]
    assert answers[0]["path"] == "zone"
    wrong = batch | {"a_priori": {"quaternion": [0.0, 0.0, 0.0, 1.0]}}
    assert answered(wrong, mission, sky)["path"] == "zone_then_lost_in_space"
    without = batch | {"a_priori": None}
    ptp = batch | {"options": {"identifier": "ptp"}}
    for each in (wrong, without, ptp):
        with pytest.raises(Busy, match="compiling"):
            answered(each, mission, compiling)

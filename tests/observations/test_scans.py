"""Counts and times of scanning trackers: places and sigmas against drawn truth, faults by name."""

import json
import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.result import Path
from service.errors import BadBatch, BadConfiguration, BadFile
from service.identify.prior_attitude import prior_attitude, search_region
from service.missions.mission import SHIPPED_FOLDER, parse_mission, read_mission
from service.observations.batch import SunPointedPrior
from service.observations.calibrate import correct
from service.observations.csv_rows import write_batches_csv
from service.observations.scans.reduce import reduced, sun_body
from service.observations.schema import BatchIn, submission_from_json
from service.observations.telemetry import read_lines
from service.simulate.sightings import readings
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.ephemeris import sun_direction
from service.trends.measures import a_priori_angle_deg
from service.vectors import matrix_from_quaternion, rotate_about, unit
from studies.star_image_report.scanning import by_two_scans, sigmas
from studies.star_image_report.sun_tracker import SunTracker as Screen
from tests.observations.example import BATCH

FILE = FilePath(__file__).resolve().parents[2] / "docs" / "scanning-mission.toml"
GOOD_TIMES = {"h_times": [420_000.0, 430_000.0, 450_000.0], "v_times": [1.0, 10_001.0, 30_001.0]}


@pytest.fixture(scope="module")
def scanner():
    return read_mission(FILE)


def batch_of(tracker, rates=(0.0, 0.0, 0.0), **given):
    observation = {"tracker": tracker, "stars": [], **given}
    own = {"spacecraft": "SCANNER", "body_rates_deg_per_s": list(rates)}
    return {**BATCH, **own, "observations": [observation]}


def read(mission, *of, **given):
    return reduced(submission_from_json(json.dumps(batch_of(*of, **given))).batch, mission)


def fault_of(mission, tracker, **given):
    with pytest.raises(BadBatch) as refused:
        read(mission, tracker, **given)
    (fault,) = refused.value.faults
    return fault


def lines_of(scan, stars, rng=None):
    """Sums of columns and rows of Gaussian stars (h, v, light), with noise where there is `rng`."""
    sums = []
    for axis, lines in (("h", scan.columns), ("v", scan.rows)):
        place = np.arange(lines)
        level = np.full(lines, scan.background_counts)
        for h, v, light in stars:
            at = (h if axis == "h" else v) / scan.step_deg + (lines - 1) / 2
            image = np.exp(-0.5 * ((place - at) / 1.2) ** 2)
            level += light * image / (1.2 * math.sqrt(math.tau))
        if rng is not None:
            variance = scan.noise_counts**2 + level / scan.gain_e_per_count
            level = level + rng.normal(0.0, np.sqrt(variance))
        sums.append(level.tolist())
    return {"column_counts": sums[0], "row_counts": sums[1]}


class TestLinesThroughAStar:
    def test_the_place_is_the_moment_over_the_sum(self, scanner):
        """Equations 7.21 and 7.22 written out, from the middle that the batch tells."""
        counts = [50.0] * 11 + [60.0, 90.0, 250.0, 130.0, 70.0] + [50.0] * 9
        star = {"h_deg": 1.5, "v_deg": -0.7, "h_counts": counts, "v_counts": counts[::-1]}
        stars = read(scanner, "LINES", stars=[star]).observations[0]
        light = [each - 50.0 for each in counts]
        d = 15.0 * sum((n - 12) * each for n, each in enumerate(light)) / sum(light) / 3600.0
        assert stars.angles_deg[0] == pytest.approx([1.5 + d, -0.7 - d], abs=1e-12)
        # sigma² sum (n - d)² / (sum Phi)² with read and photon noise, and the floor.
        shift = d * 3600.0 / 15.0
        variance = sum((n - 12 - shift) ** 2 * (16.0 + each / 2.0) for n, each in enumerate(counts))
        told = math.hypot(1.0, 15.0 * math.sqrt(variance) / sum(light))
        assert stars.sigma_arcsec[0] == pytest.approx(told, rel=1e-12)

    def test_places_scatter_as_their_sigmas_say(self, scanner, rng):
        tracker, direction = scanner.tracker("LINES", ""), unit(np.array([0.02, -0.03, 1.0]))
        true = np.degrees(np.arctan2(direction[:2], direction[2]))
        ratios = []
        for _ in range(400):
            star = readings(tracker, direction, np.zeros(3), 5.5, rng)
            stars = read(scanner, "LINES", stars=[star]).observations[0]
            of_scan = math.sqrt(stars.sigma_arcsec[0] ** 2 - 1.0)
            ratios.extend((stars.angles_deg[0] - true) * 3600.0 / of_scan)
        assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=5 / math.sqrt(1600))

    def test_two_stars_give_the_roll_of_the_report(self, scanner, rng):
        """Equations 7.23 to 7.25, with displacements from the counts of a turned field."""
        u0, roll = 2.0, 0.01
        tracker, turn = scanner.tracker("LINES", ""), np.array([0.0, 0.0, roll])
        off, told_arcsec = [], []
        for place in (-u0, u0):
            direction = rotate_about(turn, unit([math.tan(math.radians(place)), 0.0, 1.0]))
            star = readings(tracker, direction, np.zeros(3), -1.0, rng)
            stars = read(scanner, "LINES", stars=[star]).observations[0]
            off += [stars.angles_deg[0, 0] - place, stars.angles_deg[0, 1]]
            told_arcsec.append(stars.sigma_arcsec[0])
        _, sigma_rad = sigmas(max(told_arcsec) / 3600.0, u0)
        assert sigma_rad < 3e-4
        assert by_two_scans(*off, u0).roll_rad == pytest.approx(roll, abs=4 * sigma_rad)

    def test_a_place_behind_the_tracker_is_refused(self, scanner):
        counts = [50.0] * 21 + [300.0] * 3 + [50.0]
        star = {"h_deg": 88.99, "v_deg": 0, "h_counts": counts, "v_counts": counts}
        fault = fault_of(scanner, "LINES", stars=[star])
        assert fault.field == "observations.0.stars.0"
        assert "outside of any field of view" in fault.message

    @pytest.mark.parametrize(
        ("changed", "field", "message"),
        [
            ({"h_counts": [60.0] * 24}, "h_counts", "has 24 samples"),
            ({"v_counts": [50.0] * 25}, "v_counts", "leave the star out"),
            ({"h_counts": [50.0] * 12 + [4095.0] + [50.0] * 12}, "h_counts.12", "is full"),
            # The level has fallen to zero: what is subtracted too much pushes the moment out.
            ({"v_counts": [0.0] * 23 + [1500.0, 50.0]}, "v_counts", "a line that ends at 180"),
        ],
    )
    def test_counts_that_cannot_be_are_named(self, scanner, changed, field, message):
        counts = [50.0] * 11 + [300.0] * 3 + [50.0] * 11
        star = {"h_deg": 0, "v_deg": 0, "h_counts": counts, "v_counts": counts} | changed
        fault = fault_of(scanner, "LINES", stars=[star])
        assert fault.field == f"observations.0.stars.0.{field}"
        assert message in fault.message


class TestTimesOfWires:
    def test_each_time_is_a_place_of_the_sweep(self, scanner):
        stars = read(scanner, "WIRES", stars=[GOOD_TIMES]).observations[0]
        assert stars.angles_deg[0] == pytest.approx([0.0, -4.2 + 1e-5], abs=1e-12)
        assert stars.sigma_arcsec[0] == pytest.approx(3600 * 10.0 * 1e-4 / math.sqrt(3))
        # The direction holds when the star crossed along h.
        assert stars.time_offset_s[0] == pytest.approx((0.42 + 0.43 + 0.45) / 3)

    def test_a_turning_body_moves_no_star(self, scanner, rng):
        """Both sweeps a second apart, at .3 deg/s: the vector at the batch's epoch is the same."""
        exact = scanner.model_dump(mode="json")
        exact["trackers"][1]["scan"]["time_sigma_s"] = 1e-12
        still = type(scanner).model_validate(exact)
        tracker, direction = still.tracker("WIRES", ""), unit(np.array([0.03, -0.02, 1.0]))
        rates = (0.2, -0.3, 0.25)
        about = tracker.body_from_tracker.T @ np.radians(rates)
        star = readings(tracker, direction, about, 5.0, rng)
        batch = submission_from_json(json.dumps(batch_of("WIRES", rates, stars=[star]))).batch
        (found,) = correct(batch, still)
        expected = tracker.body_from_tracker @ direction
        assert np.degrees(np.linalg.norm(found.direction_body[0] - expected)) * 3600.0 < 0.01

    @pytest.mark.parametrize(
        ("changed", "field", "message"),
        [
            ({"h_times": [420_000.0, 430_000.0]}, "h_times", "has 2 times; the tracker has 3"),
            ({"h_times": [4e5, 3.9e5, 4.3e5]}, "h_times.1", "is not after the time before it"),
            ({"v_times": [4e5, 4.1e5, 9.1e5]}, "v_times.2", "outside of the scan"),
        ],
    )
    def test_times_that_cannot_be_are_named(self, scanner, changed, field, message):
        fault = fault_of(scanner, "WIRES", stars=[GOOD_TIMES | changed])
        assert fault.field == f"observations.0.stars.0.{field}"
        assert message in fault.message

    def test_a_body_too_fast_for_two_sweeps_is_refused(self, scanner):
        body = batch_of("WIRES", (120.0, 0.0, 0.0), stars=[GOOD_TIMES])
        with pytest.raises(BadBatch, match="the body turns too fast") as refused:
            reduced(submission_from_json(json.dumps(body)).batch, scanner)
        assert refused.value.faults[0].field == "observations.0.stars.0.v_times"


class TestLinesOfARaster:
    STARS = ((1.2, -2.0, 4e4), (-3.1, 0.4, 1e4), (0.3, 3.3, 2.2e4))

    def test_stars_are_paired_by_their_light(self, scanner):
        given = lines_of(scanner.tracker("RASTER", "").scan, self.STARS)
        stars = read(scanner, "RASTER", **given).observations[0]
        brightest_first = sorted(self.STARS, key=lambda star: -star[2])
        assert stars.angles_deg == pytest.approx(np.array(brightest_first)[:, :2], abs=1e-4)
        told = [18.0 - 2.5 * math.log10(light) for _, _, light in brightest_first]
        assert stars.magnitude_mag == pytest.approx(told, abs=0.01)

    def test_places_scatter_as_their_sigmas_say(self, scanner, rng):
        scan, ratios = scanner.tracker("RASTER", "").scan, []
        truth = {light: (h, v) for h, v, light in self.STARS}
        for _ in range(200):
            stars = read(scanner, "RASTER", **lines_of(scan, self.STARS, rng)).observations[0]
            for angles, sigma, mag in zip(
                stars.angles_deg, stars.sigma_arcsec, stars.magnitude_mag, strict=True
            ):
                light = min(truth, key=lambda each: abs(math.log10(each) - (18.0 - mag) / 2.5))
                ratios.extend((angles - truth[light]) * 3600.0 / sigma)
        assert len(ratios) > 1100
        spread = np.sqrt(np.mean(np.square(ratios)))
        assert spread == pytest.approx(1.0, abs=5 / math.sqrt(2 * len(ratios)) + 0.02)

    def test_stars_that_cannot_be_told_apart_are_left_out(self, scanner):
        """Two of one light, and two in one band of columns."""
        scan = scanner.tracker("RASTER", "").scan
        alike = ((1.0, 1.0, 1e4), (2.0, -1.0, 1e4), *self.STARS[:1])
        assert read(scanner, "RASTER", **lines_of(scan, alike)).observations[0].count == 1
        band = ((1.0, 1.0, 1e4), (1.06, -1.0, 2e4), (-3.1, 3.0, 4e4))
        assert read(scanner, "RASTER", **lines_of(scan, band)).observations[0].count == 1

    def test_a_faint_star_in_the_columns_of_a_bright_one_is_in_its_sigma(self, scanner):
        """1.5 % of its light, three columns beside it, pull it by nearly 3 arcsec."""
        scan = scanner.tracker("RASTER", "").scan
        bright, faint = (1.0, 1.0, 4e5), (1.06, -2.0, 6e3)
        stars = read(scanner, "RASTER", **lines_of(scan, (bright, faint))).observations[0]
        assert stars.count == 1
        off_arcsec = abs(stars.angles_deg[0] - bright[:2]) * 3600.0
        assert off_arcsec.max() > 2.0
        assert off_arcsec.max() < 2.0 * stars.sigma_arcsec[0]

    def test_lines_that_cannot_be_are_named(self, scanner):
        good = lines_of(scanner.tracker("RASTER", "").scan, self.STARS)
        fault = fault_of(scanner, "RASTER", **good | {"row_counts": good["row_counts"][1:]})
        assert fault.field == "observations.0.row_counts"
        assert "has 400 lines; the raster has 401" in fault.message
        empty = {"column_counts": [5000.0] * 401, "row_counts": [5000.0] * 401}
        assert "no star" in fault_of(scanner, "RASTER", **empty).message


@pytest.mark.parametrize(
    ("tracker", "given"),
    [
        (
            "WIRES",
            {"stars": [{"h_deg": 0, "v_deg": 0, "h_counts": [1] * 9, "v_counts": [1] * 9}]},
        ),
        ("LINES", {"stars": [GOOD_TIMES]}),
        ("LINES", {"column_counts": [1.0] * 9, "row_counts": [1.0] * 9}),
    ],
)
def test_readings_of_another_kind_of_scan_are_refused_by_name(scanner, tracker, given):
    fault = fault_of(scanner, tracker, **given)
    assert fault.field.startswith("observations.0.")
    assert f"gives {tracker} a scan of the kind" in fault.message


@pytest.mark.parametrize(
    ("star", "field"),
    [
        ({"h_deg": 0, "v_deg": 0, "h_counts": [-1.0, 2, 3], "v_counts": [1, 2, 3]}, "h_counts.0"),
        ({"h_deg": 0, "v_deg": 0, "h_counts": [1, math.nan, 3], "v_counts": [1, 2, 3]}, "h_counts"),
        ({"h_times": [1.0, 2.0, -3.0], "v_times": [1.0, 2.0, 3.0]}, "h_times.2"),
        ({"h_deg": 0, "v_deg": 0, "h_counts": [1, 2, 3]}, "stars.0"),
        ({"h_times": [1.0], "v_times": [1.0], "h_deg": 0.0, "v_deg": 0.0}, "stars.0"),
        ({"vector": [0, 0, 1], "h_counts": [1, 2, 3], "v_counts": [1, 2, 3]}, "stars.0"),
    ],
)
def test_a_star_that_no_scan_gives_is_refused_by_its_form(star, field):
    with pytest.raises(BadBatch) as refused:
        submission_from_json(json.dumps(batch_of("LINES", stars=[star])))
    assert any(field in fault.field for fault in refused.value.faults)


def test_a_tracker_takes_stars_or_lines_and_not_both():
    lines = {"column_counts": [1.0] * 9, "row_counts": [1.0] * 9}
    for given in ({"stars": [GOOD_TIMES], **lines}, {"column_counts": [1.0] * 9}):
        with pytest.raises(BadBatch, match="column_counts and row_counts"):
            submission_from_json(json.dumps(batch_of("RASTER", **given)))


def test_rows_of_a_csv_file_hold_readings(tmp_path, scanner, rng):
    tracker = scanner.tracker("LINES", "")
    counts = readings(tracker, unit([0.02, 0.01, 1.0]), np.zeros(3), 5.0, rng)
    sent = batch_of("LINES", stars=[{**counts, "magnitude": 5.0}, {"h_deg": 1.0, "v_deg": 2.0}])
    sent["observations"] += [
        {"tracker": "WIRES", "stars": [GOOD_TIMES]},
        {"tracker": "RASTER", "stars": [], **lines_of(scanner.tracker("RASTER", "").scan, ())},
    ]
    path = tmp_path / "readings.csv"
    checked = BatchIn.model_validate(sent)
    with path.open("w", newline="") as stream:
        write_batches_csv([checked], stream)
    (line,) = read_lines(path)
    assert BatchIn.model_validate_json(line.body) == checked


def test_the_lines_of_the_largest_raster_are_one_cell(tmp_path, rng):
    lines = {f"{each}_counts": rng.uniform(1e3, 9e3, 8192).tolist() for each in ("column", "row")}
    checked = BatchIn.model_validate(batch_of("RASTER", **lines))
    path = tmp_path / "raster.csv"
    with path.open("w", newline="") as stream:
        write_batches_csv([checked], stream)
    (line,) = read_lines(path)
    assert BatchIn.model_validate_json(line.body) == checked


def test_a_raster_in_repeated_rows_counts_once(tmp_path):
    """A file that was appended to itself; another raster of the tracker is refused."""
    head = "spacecraft,batch,time,tracker,column_counts,row_counts"
    row = "SCANNER,1,1996-01-10T12:00:00Z,RASTER,1 2 3,4 5 6"
    path = tmp_path / "twice.csv"
    path.write_text("\n".join((head, row, head, row)))
    (line,) = read_lines(path)
    found = json.loads(line.body)
    raster = {"tracker": "RASTER", "stars": [], "column_counts": [1, 2, 3], "row_counts": [4, 5, 6]}
    assert found["observations"] == [raster]
    assert "counted once" in found["remarks"][0]
    path.write_text("\n".join((head, row, row.replace("4 5", "5 4"))))
    (line,) = read_lines(path)
    assert "a second time" in line.fault.message


@pytest.mark.parametrize(
    ("cell", "message"), [("1 2 x", "must be a number"), ("1 1e999 3", "must be a finite number")]
)
def test_a_cell_of_readings_that_cannot_be_read_is_named(tmp_path, cell, message):
    path = tmp_path / "bad.csv"
    head = "spacecraft,batch,time,tracker,h_times,v_times"
    path.write_text(f"{head}\nSCANNER,1,1996-01-10T12:00:00Z,WIRES,1 2 3,{cell}\n")
    (line,) = read_lines(path)
    assert line.fault.field == "line 2, column v_times"
    assert message in line.fault.message


def test_columns_of_readings_come_in_pairs(tmp_path):
    path = tmp_path / "half.csv"
    path.write_text("spacecraft,batch,time,tracker,h_times\n")
    with pytest.raises(BadFile, match="v_times"):
        list(read_lines(path))


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("samples = 25", "samples = 24", "trackers.0.scan.samples: must be odd"),
        ("wires_deg = [0.0, 0.1, 0.3]", "wires_deg = [0.0, 0.3, 0.1]", "trackers.1.scan.wires_deg"),
        ('kind = "raster"', 'kind = "spiral"', "trackers.2.scan"),
        ("duration_s = 0.9", "duration_s = 9.4", "trackers.1.scan: reaches"),
        ("step_deg = 0.02", "step_deg = 0.45", "trackers.2.scan: reaches 90 deg"),
        ("time_unit_s = 1e-6", "time_unit = 1e-6", "trackers.1.scan.time_unit: no such key"),
    ],
)
def test_a_wrong_key_of_a_scan_is_named(old, new, key):
    text = FILE.read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(BadConfiguration) as refused:
        parse_mission(text.replace(old, new), "x.toml")
    assert key in str(refused.value)


def test_a_batch_without_readings_is_left_as_it_is(missions):
    batch = submission_from_json(json.dumps(BATCH)).batch
    assert reduced(batch, missions["XTE"]) is batch


class TestSunTracker:
    AXES = """
[sun_tracker]
x_axis_body = [0.0, 1.0, 0.0]
y_axis_body = [0.0, 0.0, 1.0]
z_axis_body = [1.0, 0.0, 0.0]
slope_per_arcmin = 0.11
straight_to_arcmin = 5.0
background_counts = 100.0
noise_counts = 10.0
"""

    @pytest.fixture
    def soho(self):
        """SOHO's band lies about body X."""
        text = (SHIPPED_FOLDER / "soho.toml").read_text(encoding="utf-8")
        return parse_mission(text + self.AXES, "soho.toml")

    def counts(self, p_arcmin, q_arcmin):
        """By the tails of the report's screen, not by the straight line."""
        signals = Screen().errors(p_arcmin, q_arcmin)
        return [100.0 + 5e4 * (1.0 + side * e) for e in signals for side in (1.0, -1.0)]

    @pytest.mark.parametrize(("p", "q"), [(0.0, 0.0), (1.0, -2.0), (-3.0, 0.5)])
    def test_the_sun_is_where_the_tails_of_the_screen_put_it(self, soho, p, q):
        found = sun_body(np.array(self.counts(p, q)), soho, "sun_counts")
        true = unit(np.array([1.0, *np.tan(np.radians(np.array([p, q]) / 60.0))]))
        assert np.degrees(np.linalg.norm(found - true)) * 60.0 < 0.1

    def test_the_presumed_attitude_has_the_sun_where_it_was_seen(self, soho):
        """A star's angle to the Sun, of which the votes make use, is then that of the body."""
        body = batch_of("T", stars=[{"vector": [0, 0, 1]}]) | {
            "a_priori": {"sun_pointed": True, "sun_counts": self.counts(3.0, -2.0)}
        }
        batch = submission_from_json(json.dumps(body)).batch
        prior = prior_attitude(batch.a_priori, batch.time, soho)
        sun = sun_direction(batch.time, None)
        seen = sun_body(batch.a_priori.sun_counts, soho, "")
        assert prior.attitude @ sun == pytest.approx(seen, abs=1e-12)
        assert not prior.roll_known
        without = SunPointedPrior(None, None)
        nominal = prior_attitude(without, batch.time, soho).attitude @ sun
        assert np.degrees(np.arccos(nominal @ seen)) * 60.0 == pytest.approx(3.6, abs=0.1)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ([100.0, 100.0, 5e4, 5e4], "along X has no sunlight"),
            ([5e4, 5e4, 9e4, 1e4], "along Y is beyond 0.55"),
        ],
    )
    def test_counts_without_a_sun_are_named(self, soho, given, message):
        with pytest.raises(BadBatch, match=message) as refused:
            sun_body(np.array(given), soho, "a_priori.sun_counts")
        assert refused.value.faults[0].field == "a_priori.sun_counts"

    def test_a_body_that_looks_beside_the_sun_gets_its_attitude(self, soho, sky):
        solved = 0
        wanted = Pass(batches=8, seed=3, troubles=NO_TROUBLES, prior="direction")
        for each in draw_pass(soho, sky, wanted):
            truth = matrix_from_quaternion(np.array(each.truth["quaternion"]))
            time = submission_from_json(json.dumps(each.batch)).batch.time
            sun = truth @ sun_direction(time, np.array(each.batch["position_km"]))
            p, q = np.degrees(np.arctan2(sun[1:], sun[0])) * 60.0
            if max(abs(p), abs(q)) < 4.0:
                prior = {"sun_pointed": True, "sun_counts": self.counts(p, q)}
                sent = json.dumps(each.batch | {"a_priori": prior})
                found = acquire(submission_from_json(sent).batch, soho, sky)
                assert found.path is Path.ZONE
                across = found.solution.matrix @ truth.T
                assert abs(across[1, 2]) < 1e-3
                assert math.degrees(math.hypot(*across[2, :2])) * 3600.0 < 60.0
                solved += 1
        assert solved > 2

    @pytest.mark.parametrize(("grid_deg", "room_deg"), [(0.0, 0.0), (0.25, 0.25)])
    def test_stars_are_sought_where_the_tracker_looks_beside_a_sun_far_off(
        self, soho, sky, grid_deg, room_deg
    ):
        """The boresight is 2.5 deg nearer to the Sun than the band's middle, which is 2.1 wide."""
        told = soho.model_dump(mode="json")
        told["zone"]["grid_deg"] = grid_deg
        told["sun_tracker"] |= {"slope_per_arcmin": 1e-3, "straight_to_arcmin": 300.0}
        wide = type(soho).model_validate(told)
        tracker, off_deg = wide.trackers[0], 2.5
        off = np.degrees(np.arctan(tracker.boresight_body[1:] * np.tan(np.radians(off_deg)))) * 60.0
        counts = [100.0 + 5e4 * (1.0 + side * 1e-3 * each) for each in off for side in (1.0, -1.0)]
        (drawn,) = draw_pass(wide, sky, Pass(batches=1, seed=3, troubles=NO_TROUBLES))
        time = submission_from_json(json.dumps(drawn.batch)).batch.time
        prior = SunPointedPrior(None, np.array(drawn.batch["position_km"]), np.array(counts))
        presumed = prior_attitude(prior, time, wide)
        region = search_region(tracker, presumed, wide, "")
        middle_deg = 90.0 - off_deg
        assert region.least_deg <= middle_deg - 2.1 + 1e-9
        assert region.most_deg >= middle_deg + 2.1 - 1e-9
        assert region.most_deg - region.least_deg <= 4.2 + room_deg + 1e-9

        # The drawn body, turned so that the Sun is where the counts have it.
        truth = matrix_from_quaternion(np.array(drawn.truth["quaternion"]))
        seen = presumed.axis_body(wide)
        sun = truth @ sun_direction(time, np.array(drawn.batch["position_km"]))
        turn = np.cross(sun, seen)
        turn *= math.asin(np.linalg.norm(turn)) / np.linalg.norm(turn)
        attitude = np.stack([rotate_about(turn, column) for column in truth.T], axis=1)
        run_catalog = sky.run_catalog(wide, time)
        inside = run_catalog.direction @ (tracker.boresight_body @ attitude) > np.cos(
            np.radians(0.9 * tracker.field_of_view_radius_deg)
        )
        brightest = np.flatnonzero(inside)[np.argsort(run_catalog.magnitude_mag[inside])][:6]
        assert len(brightest) >= 4
        vectors = run_catalog.direction[brightest] @ attitude.T @ tracker.body_from_tracker
        stars = [
            {"vector": vector, "magnitude": magnitude}
            for vector, magnitude in zip(
                vectors.tolist(), run_catalog.magnitude_mag[brightest].tolist(), strict=True
            )
        ]
        sent = drawn.batch | {
            "a_priori": {"sun_pointed": True, "sun_counts": counts},
            "aberration": "ignore",
            "body_rates_deg_per_s": [0, 0, 0],
            "observations": [{"tracker": tracker.name, "stars": stars}],
        }
        found = acquire(submission_from_json(json.dumps(sent)).batch, wide, sky)
        assert found.path is Path.ZONE
        assert np.degrees(np.arccos(found.solution.matrix[2] @ attitude[2])) * 3600.0 < 60.0
        # Where the Sun was measured is where it was found: the a priori knowledge was right.
        assert a_priori_angle_deg(found) < 0.02
        assert not any("off_a_priori" in each for each in found.warnings)

    def test_a_mission_without_one_refuses_its_counts(self, missions):
        with pytest.raises(BadBatch, match="has no sun_tracker"):
            sun_body(np.ones(4), missions["SOHO"], "a_priori.sun_counts")

    def test_a_row_of_a_csv_file_holds_its_counts(self, tmp_path):
        prior = {"sun_pointed": True, "sun_counts": self.counts(1.0, 2.0)}
        stars = [{"vector": [0, 0, 1]}]
        checked = BatchIn.model_validate(batch_of("T", stars=stars) | {"a_priori": prior})
        path = tmp_path / "sun.csv"
        with path.open("w", newline="") as stream:
            write_batches_csv([checked], stream)
        (line,) = read_lines(path)
        assert BatchIn.model_validate_json(line.body) == checked

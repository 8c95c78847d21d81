"""Lost in space: right where it answers, and silent where chance could have drawn the field."""

import dataclasses
import json
import math
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.attitude.solution import NoAttitude
from service.identify.lost_in_space.decision import star_probabilities
from service.identify.lost_in_space.finder import magnitude_offset, search_sky
from service.identify.lost_in_space.matching import nearest_stars
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace, _solve
from service.missions.mission import RunCatalogSettings
from service.sky.catalog.run_catalog import build_run_catalog
from service.sky.catalog.star_catalog import load_embedded
from service.sky.whole_sky.index import build_sky_index
from service.vectors import locked, unit
from studies.scenes import (
    Conditions,
    PinholeCamera,
    Scene,
    SceneSky,
    draw_random_points,
    draw_scenes,
)
from tests.chance import at_least, at_most
from tests.scale import draws, some_in_a_sitting

INDEX_LIMIT_MAG = 6.5
SCENES = draws(30, 60)
RIGHT_BORESIGHT_DEG, RIGHT_ROTATION_DEG = 0.1, 1.0


@pytest.fixture(scope="module")
def sky():
    return SceneSky.for_conditions(Conditions())


@pytest.fixture(scope="module")
def index(sky):
    return build_sky_index(sky.run_catalog, INDEX_LIMIT_MAG, FieldOfView.square(10.0).radius_deg)


@pytest.fixture(scope="module")
def solver(index):
    return LostInSpace(index, FieldOfView.square(10.0))


def solved(solver, scene, sigma=1.0, offset_mag=0.0):
    return solver.solve(scene.direction, scene.magnitude_mag + offset_mag, scene.sigma_rad * sigma)


def is_right(scene, result):
    boresight_deg, rotation_deg = scene.off_from(result.attitude)
    return boresight_deg < RIGHT_BORESIGHT_DEG and rotation_deg < RIGHT_ROTATION_DEG


def right_and_wrong(results):
    answered = [is_right(scene, each) for scene, each in results if each.attitude is not None]
    return answered.count(True), answered.count(False)


CONDITIONS = {
    "hardly any noise, many stars": (Conditions(position_px=0.005, fewest=35), {}),
    "no noise": (Conditions(position_px=0.05, magnitude_sigma_mag=0.0), {}),
    "one pixel": (Conditions(), {}),
    "two pixels": (Conditions(position_px=2.0), {}),
    "five brightest of a circle": (
        Conditions(position_px=0.1, radius_deg=4.0, brightest=5, fewest=5),
        {},
    ),
    "ten spurious points": (Conditions(brightest=10, fewest=10, spurious=10), {}),
    "sigma half": (Conditions(fewest=5), {"sigma": 0.5}),
    "sigma double": (Conditions(fewest=5), {"sigma": 2.0}),
    "magnitudes off": (Conditions(fewest=5), {"offset_mag": 0.7}),
    "magnitudes unknown": (Conditions(fewest=5), {"offset_mag": math.nan}),
}


@pytest.mark.parametrize("name", CONDITIONS)
@pytest.mark.slow("hardly any noise")
def test_fields_are_found_and_none_is_wrong(name, sky, index, seed):
    conditions, told = CONDITIONS[name]
    field = FieldOfView.square(10.0)
    if conditions.radius_deg is not None:
        field = FieldOfView(conditions.radius_deg)
    solver = LostInSpace(index, field)
    drawn = draw_scenes(sky, conditions, SCENES, seed)
    right, wrong = right_and_wrong([(each, solved(solver, each, **told)) for each in drawn])
    assert wrong == 0
    assert right >= at_least(SCENES, 0.95)


def test_a_focal_length_that_is_a_little_off_does_no_harm(sky, solver, seed):
    drawn = draw_scenes(sky, Conditions(fewest=5), SCENES, seed)
    results = [(each, solved(solver, each.with_focal_error(0.002))) for each in drawn]
    right, wrong = right_and_wrong(results)
    assert wrong == 0
    assert right >= at_least(SCENES, 0.95)


def test_a_mirrored_sky_is_refused(sky, solver, seed):
    for scene in draw_scenes(sky, Conditions(), 2 * SCENES, seed):
        assert solved(solver, scene.mirrored()).attitude is None


@pytest.mark.parametrize("points", [3, 5, 12, 20])
def test_random_points_are_refused_and_told_so(points, sky, solver, rng):
    for _ in range(20):
        scene = draw_random_points(sky, Conditions(), points, rng)
        result = solved(solver, scene)
        assert result.attitude is None
        assert result.refusal in (NoAttitude.NO_MATCH, NoAttitude.DOUBTFUL_MATCH)


def test_a_field_of_planets_among_a_few_stars_is_refused(sky, solver, seed, rng):
    """Two stars and eight bright points that are none."""
    for scene in draw_scenes(sky, Conditions(fewest=2), 20, seed):
        planets = draw_random_points(sky, Conditions(), 8, rng)
        field = dataclasses.replace(
            scene,
            direction=np.concatenate([scene.direction[:2], planets.direction]),
            magnitude_mag=np.concatenate([scene.magnitude_mag[:2], rng.uniform(-4, 1, 8)]),
            sigma_rad=np.concatenate([scene.sigma_rad[:2], planets.sigma_rad]),
        )
        assert solved(solver, field).attitude is None


def test_the_work_is_bounded_however_many_points_there_are(sky, solver, rng):
    scene = draw_random_points(sky, Conditions(), 250, rng)
    result = solved(solver, scene)
    assert result.attitude is None
    assert not result.bounded
    assert result.work < 300_000
    # Where noise is large, much may be much.
    blurred = solved(solver, draw_random_points(sky, Conditions(), 60, rng), sigma=3.0)
    assert blurred.attitude is None
    assert blurred.bounded
    assert blurred.work < 700_000


def test_a_rich_field_is_as_sure_as_can_be(index, rng):
    """The evidence of many stars with small sigmas is beyond what an exponential can hold."""
    stars, sigma_rad = index.arrays.stars[:, :3], 2e-7
    # A table of all pairs would take seconds and gigabytes.
    chord = 2.0 * math.sin(math.radians(3.0))
    centre = stars[np.argmax(cKDTree(stars).query_ball_point(stars, chord, return_length=True))]
    field = index.arrays.stars[stars @ centre > math.cos(math.radians(6.0))]
    assert len(field) > 60
    places = unit(field[:, :3] + rng.normal(0.0, sigma_rad, (len(field), 3)))
    sigmas = np.full(len(field), sigma_rad)
    result = LostInSpace(index, FieldOfView(6.0)).solve(places, field[:, 3].copy(), sigmas)
    assert result.attitude is not None
    assert np.abs(result.attitude - np.eye(3)).max() < 1e-6
    assert 690.0 < result.log_odds < math.inf


@pytest.mark.parametrize("points", [0, 1, 2])
def test_two_stars_are_too_few(points, sky, solver, seed):
    scene = next(draw_scenes(sky, Conditions(fewest=5), 1, seed))
    result = solver.solve(
        scene.direction[:points], scene.magnitude_mag[:points], scene.sigma_rad[:points]
    )
    assert result.refusal is NoAttitude.FEWER_THAN_THREE_STARS


def test_a_cluster_that_fixes_no_roll_is_no_attitude(sky, index, seed):
    """The stars of the Pleiades alone, at two pixels: where they are is known, not how turned."""
    catalog = sky.run_catalog
    row = sky.about(unit([0.4966, 0.7689, 0.4026]), math.radians(1.2))
    row = row[catalog.magnitude_mag[row] < 6.0]
    assert len(row) >= 7
    middle = unit(catalog.direction[row].mean(axis=0))
    across = unit(np.cross(middle, [0.0, 0.0, 1.0]))
    axes = np.stack([across, np.cross(middle, across), middle])
    rng = np.random.default_rng(seed)
    direction = unit(catalog.direction[row] @ axes.T + rng.normal(size=(len(row), 3)) * 6e-4)
    result = LostInSpace(index, FieldOfView.square(10.0)).solve(
        direction, np.asarray(catalog.magnitude_mag[row]), np.full(len(row), 6e-4)
    )
    assert result.attitude is None


def test_points_that_cannot_be_written_to_are_no_other_kind_to_the_kernel(sky, solver, seed):
    """Else the kernel would be compiled again in the way of a post."""
    scene = next(draw_scenes(sky, Conditions(fewest=6), 1, seed))
    given = [np.array(each) for each in (scene.direction, scene.magnitude_mag, scene.sigma_rad)]
    result = solver.solve(*given)
    kinds = len(_solve.signatures)
    solver.chances(solver.solve(*map(locked, given)), *given)
    solver.chances(result, *map(locked, given))
    assert len(_solve.signatures) == kinds
    assert len(star_probabilities.signatures) == 1


def test_the_order_of_the_points_does_not_matter(sky, solver, seed, rng):
    for scene in draw_scenes(sky, Conditions(fewest=6), 15, seed):
        straight = solved(solver, scene)
        order = rng.permutation(len(scene.star))
        shuffled = solver.solve(
            scene.direction[order], scene.magnitude_mag[order], scene.sigma_rad[order]
        )
        assert np.array_equal(shuffled.star, straight.star[order])
        assert shuffled.log_odds == pytest.approx(straight.log_odds)


@pytest.mark.slow
def test_turning_the_camera_turns_the_attitude_alone(sky, index, seed):
    """A law: the same sky in a circle, rolled about the boresight."""
    solver = LostInSpace(index, FieldOfView(5.0))
    c, s = math.cos(1.1), math.sin(1.1)
    roll = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    for scene in draw_scenes(sky, Conditions(radius_deg=5.0, fewest=6), 15, seed):
        straight = solved(solver, scene)
        turned = solver.solve(scene.direction @ roll.T, scene.magnitude_mag, scene.sigma_rad)
        assert np.array_equal(turned.star, straight.star)
        assert turned.matrices[0] == pytest.approx(roll @ straight.matrices[0], abs=1e-9)


def test_stars_are_named_rightly_and_with_their_probability(sky, solver, seed):
    sure = wrong = 0
    for scene in draw_scenes(sky, Conditions(fewest=6), SCENES, seed):
        told = (scene.direction, scene.magnitude_mag, scene.sigma_rad)
        result = solver.solve(*told)
        if result.attitude is None:
            continue
        chances = solver.chances(result, *told)
        assert (chances.probability + chances.none <= 1.0 + 1e-9).all()
        named = chances.probability >= 0.999
        sure += int(named.sum())
        wrong += int((chances.star[named] != scene.star[named]).sum())
    assert sure > 8 * SCENES * 0.8
    assert wrong <= at_most(sure, 0.001)


def test_of_two_stars_in_one_place_neither_is_sure(sky, index):
    """A close pair stands in the index; the point between them may be either."""
    stars = np.array(index.arrays.stars)
    row = int(np.argmin(np.abs(stars[:, 3] - 5.0)))
    near = sky.about(stars[row, :3], math.radians(5.0))
    near = near[(near < index.stars) & (near != row)][:8]
    twin = dataclasses.replace(sky.run_catalog)
    direction = np.array(twin.direction)
    double = int(near[-1])
    direction[double] = unit(stars[row, :3] + 1.5e-4 * unit(np.cross(stars[row, :3], [0, 0, 1.0])))
    magnitude = np.array(twin.magnitude_mag)
    object.__setattr__(twin, "direction", direction)
    crowded = build_sky_index(twin, INDEX_LIMIT_MAG, 7.1)
    middle = unit(direction[row] + direction[double])
    axes = np.stack([unit(np.cross(middle, [0, 0, 1.0])), np.zeros(3), middle])
    axes[1] = np.cross(axes[2], axes[0])
    seen = np.concatenate([near[:-1]])
    points = np.concatenate([direction[seen], [middle]]) @ axes.T
    told = (
        points,
        np.append(magnitude[seen], 5.0),
        np.full(len(points), 1.7e-4),
    )
    solver = LostInSpace(crowded, FieldOfView.square(10.0))
    result = solver.solve(*told)
    assert result.attitude is not None
    chances = solver.chances(result, *told)
    assert {int(chances.star[-1]), int(chances.rival[-1])} == {row, double}
    assert chances.probability[-1] < 0.999


def test_the_nearest_stars_are_those_of_brute_force(index, rng):
    arrays = index.arrays
    # As the cells have them: in single precision, which is a hundredth of an arcsecond.
    places = np.empty((index.stars, 3))
    places[arrays.cell_rows] = arrays.cell_place[:, :3]
    np.testing.assert_allclose(places, arrays.stars[: index.stars, :3], rtol=0, atol=1e-7)
    for gate in (1e-4, 2e-3, 2e-2):
        for _ in range(150):
            p = unit(places[rng.integers(index.stars)] + rng.normal(size=3) * gate / 2)
            chord = np.sqrt(((places - p) ** 2).sum(axis=1))
            order = np.argsort(chord)[:2]
            expected = [int(row) if chord[row] < gate else -1 for row in order]
            found = nearest_stars(
                *(arrays.cell_place, arrays.face, arrays.cell_start, arrays.cell_rows),
                *(*p, gate, -9.0, 99.0),
            )
            assert [int(found[0]), int(found[1])] == expected


REAL_SKY = "REAL_SKY_CASES"


def real_sky_cases():
    """The folder that the environment names, or one beside the checkout; None where neither is."""
    beside = Path(__file__).parents[2].parent / "shared" / "real-sky"
    upper = Path(__file__).parents[2].parents[1] / "shared" / "real-sky"
    places = [Path(os.environ[REAL_SKY])] if REAL_SKY in os.environ else [beside, upper]
    for place in places:
        if (place / "cases.json").is_file():
            return json.loads((place / "cases.json").read_text("utf-8"))["cases"]
    return None


@cache
def real_sky():
    settings = RunCatalogSettings(magnitude_limit_mag=7.0, merge_within_arcsec=40.0)
    return build_run_catalog(load_embedded(), settings, 2019.5)


@cache
def solver_of(focal_px):
    field = FieldOfView(math.degrees(math.atan(math.hypot(512, 384) / focal_px)))
    return LostInSpace(build_sky_index(real_sky(), 7.0, field.radius_deg), field)


def scene_of(case):
    """A real image: centroids with their brightness, which is no magnitude, as points."""
    y, x = np.array(case["centroids_yx"]).T
    pixels = np.column_stack([x - case["width"] / 2, (y - case["height"] / 2) * case["y_scale"]])
    camera = PinholeCamera(side_px=case["width"], focal_px=case["focal_px"])
    n = len(pixels)
    return Scene(
        direction=camera.directions(pixels),
        magnitude_mag=-2.5 * np.log10(np.array(case["brightness"])),
        sigma_rad=np.full(n, 10.0 / 206264.8),
        star=np.full(n, -1),
        attitude=np.array(case["dcm_cam_from_icrs"]),
    )


@pytest.mark.skipif(
    real_sky_cases() is None,
    reason=f"the real images' centroids are not here: name the folder of cases.json in {REAL_SKY}",
)
@pytest.mark.parametrize("magnitudes", ["unknown", "raw", 0.0, 1.5, 2.0, 5.0])
@pytest.mark.parametrize("number", some_in_a_sitting(range(8)))
def test_real_images_of_the_sky_are_found_whatever_their_magnitudes(number, magnitudes):
    """`raw` is -2.5 log10 of the brightness; a number is its offset from the catalog's."""
    case = real_sky_cases()[number]
    scene, solver = scene_of(case), solver_of(case["focal_px"])
    magnitude_mag = np.full(len(scene.star), np.nan)
    plain = solver.solve(scene.direction, magnitude_mag, scene.sigma_rad)
    if magnitudes == "raw":
        magnitude_mag = scene.magnitude_mag
    elif magnitudes != "unknown":
        zero_mag = magnitude_offset(plain, scene.magnitude_mag, solver.index)
        magnitude_mag = scene.magnitude_mag - zero_mag + magnitudes
    search = search_sky(solver, scene.direction, magnitude_mag, scene.sigma_rad)
    result = search.result
    assert result.attitude is not None, result.refusal
    if magnitudes in ("raw", 5.0):
        assert not search.magnitudes_used
    boresight_deg, rotation_deg = scene.off_from(result.attitude)
    assert boresight_deg < 0.05
    assert rotation_deg < 0.2

"""Bodies that turn far between two attitudes: right between them, or said to be unknown."""

import io
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from service.ephemerides.aem import read_aem
from service.ephemerides.attitude_types import SEQUENCES
from service.ephemerides.files import read_attitudes
from service.ephemerides.known import Segment
from service.errors import NotFound
from service.features.products.moment import attitude_at
from service.interpolation import LARGEST_ERROR_RAD, steps_between
from service.times import parse_utc, shifted
from service.vectors import rotation_vectors
from tests import scale
from tests.features.products.series import ABOUT, START, rows, slew, written

SPIN = Path(__file__).parent / "spinners"
NOON = parse_utc(START)


def off_deg(one, other):
    return np.degrees(
        np.linalg.norm(rotation_vectors(np.atleast_2d(one), np.atleast_2d(other)), axis=1)
    )


def about_z(angle_deg):
    half = np.radians(np.asarray(angle_deg, float)) / 2
    return np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)


def tai(*times):
    return np.array([parse_utc(each).tai_ns for each in times])


def random_motion(rng, step_s, steps, points):
    """Attitudes and rates (rad/s) of a rigid body without torque, `points` to a step."""
    inertia = rng.uniform(0.5, 1.5, 3)
    while 2 * inertia.max() > inertia.sum():
        inertia = rng.uniform(0.5, 1.5, 3)
    if rng.random() < 0.5:
        inertia[1] = inertia[0]
        inertia[2] = inertia[0] * rng.uniform(0.3, 1.9)
    axis = rng.normal(size=3)
    if rng.random() < 0.5:
        axis = np.array([0, 0, 1]) + 10 ** rng.uniform(-4, -0.3) * axis * [1, 1, 0]
    rate = np.radians(rng.uniform(0, 60)) * axis / np.linalg.norm(axis)

    def derivative(_, state):
        v, c, w = state[:3], state[3], state[4:]
        return np.concatenate(
            [0.5 * (c * w - np.cross(w, v)), [-0.5 * w @ v], np.cross(inertia * w, w) / inertia]
        )

    times = np.linspace(0.0, steps * step_s, steps * points + 1)
    first = rng.normal(size=4)
    found = solve_ivp(
        derivative,
        (0.0, times[-1]),
        np.concatenate([first / np.linalg.norm(first), rate]),
        method="DOP853",
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    )
    q = found.y[:4].T
    return q / np.linalg.norm(q, axis=1)[:, None], found.y[4:].T


def test_random_spinners_are_known_within_the_bound_or_not_at_all(rng):
    """0 to 60 deg/s about any axis, nutating, sampled at .1 to 60 s; the truth is integrated."""
    bodies, steps, points = scale.draws(60, 1_000), 6, 12
    known, beyond = 0, []
    for _ in range(bodies):
        step_s = 10 ** rng.uniform(-1.0, np.log10(60.0))
        q, rate = random_motion(rng, step_s, steps, points)
        at, h = slice(None, None, points), np.full(steps, step_s)
        found = steps_between(q[at][:-1], q[at][1:], h, rate[at][:-1], rate[at][1:])
        time_ns = np.round(np.arange(steps + 1) * step_s * 1e9).astype(np.int64)
        segment = Segment("", time_ns, 0, int(time_ns[-1]), q[at], rate[at])
        for k in range(1, points):
            off = np.radians(off_deg(found.at(np.full(steps, k / points)), q[k::points]))
            worse = found.is_known & (off > found.error_rad + 1e-6)
            beyond += off[worse].tolist()
            given = segment.at(time_ns[:-1] + np.round(np.diff(time_ns) * k / points).astype(int))
            is_given = ~np.isnan(given[:, 0])
            assert np.array_equal(is_given, found.is_known)
        known += int(found.is_known.sum())
    # Few of those that turn far can nutate in step with the samples.
    assert len(beyond) <= max(2, bodies * steps * points // 5_000), beyond
    assert max(beyond, default=0.0) < 5 * LARGEST_ERROR_RAD
    assert known > 0.4 * bodies * steps


def test_the_shorter_way_of_a_spinner_is_never_taken_for_the_longer():
    """The input of a public report: 24 deg/s about z, a record every 10 s."""
    known = read_attitudes(SPIN / "spin24.aem", "FILE")
    for seconds in (5, 12, 25, 117.5):
        moment = shifted(parse_utc("1999-03-01T00:00:00Z"), seconds)
        (found,) = known.at(np.array([moment.tai_ns]))
        assert off_deg(found, about_z(24.0 * seconds))[0] < 1e-6


def aem(type, states, version="2.0", step_s=10, more=""):
    """A message of states, a tuple of numbers each."""
    start = parse_utc("1999-03-01T00:00:00Z")
    times = [shifted(start, step_s * k).text.rstrip("Z") for k in range(len(states))]
    if version == "1.0":
        more += "ATTITUDE_DIR = A2B\nQUATERNION_TYPE = LAST\n"
    lines = "".join(f"{t} {' '.join(map(repr, s))}\n" for t, s in zip(times, states, strict=True))
    text = (
        f"CCSDS_AEM_VERS = {version}\nCREATION_DATE = 2026-03-01T00:00:00\nORIGINATOR = ME\n"
        "META_START\nOBJECT_NAME = XTE\nOBJECT_ID = 1995-074A\nREF_FRAME_A = EME2000\n"
        f"REF_FRAME_B = SC_BODY_1\nTIME_SYSTEM = UTC\nSTART_TIME = {times[0]}\n"
        f"STOP_TIME = {times[-1]}\nATTITUDE_TYPE = {type}\n{more}META_STOP\nDATA_START\n{lines}"
        "DATA_STOP\n"
    )
    return read_aem("x.aem", io.BytesIO(text.encode()))


RATE = 24.0
ANGLES = [RATE * 10 * k for k in range(13)]
SPINNERS = {
    "QUATERNION/ANGVEL": [(*about_z(a).tolist(), 0.0, 0.0, RATE) for a in ANGLES],
    "QUATERNION/RATE": [(*about_z(a).tolist(), 0.0, 0.0, RATE) for a in ANGLES],
    "QUATERNION/DERIVATIVE": [
        (
            *about_z(a).tolist(),
            0.0,
            0.0,
            *(np.radians(RATE) / 2 * about_z(a)[[3, 2]] * [1, -1]).tolist(),
        )
        for a in ANGLES
    ],
    "EULER_ANGLE/RATE": [(a, 0.0, 0.0, RATE, 0.0, 0.0) for a in ANGLES],
    "EULER_ANGLE/DERIVATIVE": [(a, 0.0, 0.0, RATE, 0.0, 0.0) for a in ANGLES],
    "EULER_ANGLE/ANGVEL": [(a % 360, 0.0, 0.0, 0.0, 0.0, RATE) for a in ANGLES],
    "SPIN": [(0.0, 90.0, a - 90.0, RATE) for a in ANGLES],
    "SPIN/NUTATION": [(0.0, 90.0, a - 90.0, RATE, 0.0, 1e9, 0.0) for a in ANGLES],
    "SPIN/NUTATION_MOM": [(0.0, 90.0, a - 90.0, RATE, 0.0, 90.0, 0.0) for a in ANGLES],
}


@pytest.mark.parametrize("type", SPINNERS)
def test_each_type_with_rates_tells_how_often_the_body_turned(type):
    version = "1.0" if type.endswith("/RATE") else "2.0"
    more = "EULER_ROT_SEQ = ZXZ\n" if type.startswith("EULER") else ""
    known = aem(type, SPINNERS[type], version, more=more)
    for seconds in (0, 5, 12.5, 111):
        moment = shifted(parse_utc("1999-03-01T00:00:00Z"), seconds)
        (found,) = known.at(np.array([moment.tai_ns]))
        assert off_deg(found, about_z(RATE * seconds))[0] < 1e-6


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("frame", ["SC_BODY_1", "REF_FRAME_A"])
def test_every_sequence_of_euler_angles_is_that_of_scipy(sequence, frame, rng):
    angles = rng.uniform([-180, 20, -180], [180, 70, 180], (5, 3))
    turned = Rotation.from_euler(sequence, angles, degrees=True)
    known = aem("EULER_ANGLE", angles.tolist(), more=f"EULER_ROT_SEQ = {sequence}\n")
    # scipy turns vectors by the axes of the body, which is the conjugate of a transform's matrix.
    assert off_deg(known.segments[0].quaternion, turned.as_quat()).max() < 1e-12
    # The rates of the angles against the angular velocity, by differences.
    rates = rng.normal(size=(5, 3))
    given = np.hstack([angles, rates]).tolist()
    known = aem("EULER_ANGLE/DERIVATIVE", given, more=f"EULER_ROT_SEQ = {sequence}\n")
    step = 1e-4
    moved = Rotation.from_euler(sequence, angles + rates * step, degrees=True)
    before = Rotation.from_euler(sequence, angles - rates * step, degrees=True)
    velocity = (before.inv() * moved).as_rotvec() / (2 * step)
    assert known.segments[0].rate_rad_s == pytest.approx(velocity, abs=1e-9)
    # An angular velocity in either frame.
    w = np.degrees(velocity) if frame == "SC_BODY_1" else np.degrees(turned.apply(velocity))
    more = f"EULER_ROT_SEQ = {sequence}\nANGVEL_FRAME = {frame}\n"
    known = aem("EULER_ANGLE/ANGVEL", np.hstack([angles, w]).tolist(), more=more)
    assert known.segments[0].rate_rad_s == pytest.approx(velocity, abs=1e-9)


def test_without_rates_a_turn_of_more_than_a_quarter_is_not_known_between():
    for step_deg, is_known in ((80.0, True), (100.0, False), (179.0, False), (240.0, False)):
        known = aem("QUATERNION", [tuple(about_z(step_deg * k).tolist()) for k in range(4)])
        records = known.at(tai("1999-03-01T00:00:10Z", "1999-03-01T00:00:20Z"))
        assert not np.isnan(records).any()
        between = known.at(tai("1999-03-01T00:00:15Z"))
        assert np.isnan(between).any() != is_known


def test_rates_of_another_source_tell_how_often_the_body_turned():
    known = aem("QUATERNION", [tuple(about_z(30.0 * 10 * k).tolist()) for k in range(4)])
    moment = tai("1999-03-01T00:00:15Z")
    (found,) = known.at(moment, np.radians([[0.0, 0.0, 30.0]]))
    assert off_deg(found, about_z(450.0))[0] < 1e-6
    assert np.isnan(known.at(moment, np.radians([[0.0, 0.0, 20.0]]))).all()


def test_rates_that_contradict_the_attitudes_leave_unknown_what_is_between():
    for rate in ((0.0, 0.0, -24.0), (24.0, 0.0, 0.0), (0.0, 0.0, 30.0), (0.0, 0.0, 0.5)):
        known = aem("QUATERNION/ANGVEL", [(*about_z(a).tolist(), *rate) for a in ANGLES])
        assert np.isnan(known.at(tai("1999-03-01T00:00:15Z"))).all()


def test_rates_of_zeros_are_none_where_the_attitude_turns():
    states = [(*about_z(2.0 * k).tolist(), 0.0, 0.0, 0.0) for k in range(4)]
    (found,) = aem("QUATERNION/ANGVEL", states).at(tai("1999-03-01T00:00:15Z"))
    assert off_deg(found, about_z(3.0))[0] < 1e-9


TURNS = about_z([240.0 * k for k in range(6)])
OWN = [[0.0, 0.0, 24.0]] * 6


def test_between_batches_the_rates_tell_how_often_the_body_turned():
    """The input of a public report: batches every 10 s with body rates of 24 deg/s."""
    page = rows(TURNS, step_s=10.0, rates=OWN)
    for seconds in (5.0, 12.0, 25.0):
        found = attitude_at(ABOUT, [page], shifted(NOON, seconds), "interpolated")
        assert off_deg(found.quaternion, about_z(24.0 * seconds))[0] < 1e-6
        nearest = attitude_at(ABOUT, [page], shifted(NOON, seconds), "nearest")
        error = off_deg(nearest.quaternion, about_z(24.0 * seconds))[0] * 3600
        assert np.sqrt(nearest.covariance_arcsec2[2][2]) >= error * (1 - 1e-9)


def test_between_batches_whose_turn_cannot_be_told_nothing_is_given():
    wrong = [[0.0, 0.0, 24.0], [3.0, 0.0, 24.0]] * 3
    for page in (rows(TURNS, step_s=10.0), rows(TURNS, step_s=10.0, rates=wrong)):
        with pytest.raises(NotFound, match="cannot be told from their rates"):
            attitude_at(ABOUT, [page], shifted(NOON, 5.0), "interpolated")


def test_the_covariance_between_batches_holds_the_motion(rng):
    """The true error of nutating bodies over the sigma that is claimed, of those that are given."""
    given = 0
    for _ in range(scale.draws(40, 300)):
        step_s = 10 ** rng.uniform(0.0, np.log10(60.0))
        q, rate = random_motion(rng, step_s, 3, 8)
        page = rows(q[::8], step_s=step_s, rates=np.degrees(rate[::8]))
        moment = shifted(NOON, step_s * 1.5)
        try:
            found = attitude_at(ABOUT, [page], moment, "interpolated")
        except NotFound:
            continue
        given += 1
        sigma = np.sqrt(np.linalg.eigvalsh(np.array(found.covariance_arcsec2))[-1])
        assert off_deg(found.quaternion, q[12])[0] * 3600 < 3 * sigma + 0.1
    assert given > 5


@pytest.mark.parametrize("form", ["aem", "aem-xml", "acm", "ck"])
def test_an_export_ends_a_stretch_where_the_shorter_way_would_be_wrong(form, tmp_path):
    page = rows(TURNS, step_s=10.0, rates=OWN)
    content = written(form, page)
    if form == "acm":
        assert content.count(b"ATT_START") == len(TURNS)
        return
    (tmp_path / "x").write_bytes(content)
    known = read_attitudes(tmp_path / "x", "FILE")
    assert len(known.segments) == len(TURNS)
    moments = NOON.tai_ns + np.arange(0, 50) * 10**9
    found = known.at(moments)
    at_batches = np.arange(0, 50) % 10 == 0
    assert np.isnan(found[~at_batches]).all()
    assert off_deg(found[at_batches], TURNS[:5]).max() < 1e-6
    slow = written(form, rows(slew(6, 10.0), step_s=10.0))
    (tmp_path / "y").write_bytes(slow)
    assert len(read_attitudes(tmp_path / "y", "FILE").segments) == 1

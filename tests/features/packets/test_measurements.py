"""Quaternions of trackers from packets: as batches, with their accuracy, named where they fail."""

import io
import json
import math
import struct

import numpy as np
import pytest

from service.acquire import acquire
from service.errors import BadConfiguration, BadInput
from service.features.packets.definition import PacketDefinition
from service.features.packets.reader import PacketReader
from service.observations.schema import submission_from_json
from service.vectors import matrix_from_quaternion
from tests.features.packets.packing import (
    ATTITUDE_APID,
    NAMESPACES,
    cds,
    mission_with,
    packet,
    xtce,
)

TIME = "1999-03-01T00:00:00.250Z"
THIRTY_DEG = [0.0, 0.0, math.sin(math.radians(15.0)), math.cos(math.radians(15.0))]
"""A coordinate transform, inertial to body: +30 degrees about z."""
COVARIANCE = (36.0, 1.0, 0.0, 36.0, 2.0, 1600.0)
NUMBERS = [*(f"SIG_{axis}" for axis in "XYZ"), *(f"P_{k}" for k in range(1, 7)), "Q_VALID"]
TIMES = """
[packets]
[packets.time]
kind = "cds"
day = "ST_DAY"
millisecond = "ST_MS"
microsecond = "ST_US"
"""
MEASURED = """
[[packets.measurements]]
quaternion = ["Q1", "Q2", "Q3", "Q4"]
"""
SIGMAS = 'sigma = ["SIG_X", "SIG_Y", "SIG_Z"]\n'
RATES = '[packets.rates]\ncomponents = ["SIG_X", "SIG_Y", "SIG_Z"]\n'
UPPER = 'covariance = ["P_1", "P_2", "P_3", "P_4", "P_5", "P_6"]\n'


def described():
    """The XTCE file of the pass, with sigmas and a covariance after the quaternion."""
    _, p = NAMESPACES["default"]
    parameters = "".join(
        f'<{p}Parameter name="{name}" parameterTypeRef="DOUBLE_T"/>\n' for name in NUMBERS
    )
    refs = "".join(f'<{p}ParameterRefEntry parameterRef="{name}"/>\n' for name in NUMBERS)
    head, attitude, rest = xtce("default", "", parameters).decode().partition('name="ATTITUDE"')
    return (head + attitude + rest.replace("</EntryList>", f"{refs}</EntryList>", 1)).encode()


def reader_of(table):
    mission = mission_with(TIMES + table)
    return PacketReader(mission, PacketDefinition(described(), "q.xml", "CCSDSPacket"))


def packed(quaternion, sigmas=(6.0, 6.0, 40.0), covariance=COVARIANCE, valid=1.0, count=7):
    data = struct.pack(">HIH", *cds(TIME)) + struct.pack(">4d", *quaternion)
    data += struct.pack(">10d", *sigmas, *covariance, valid)
    return packet(data, count, ATTITUDE_APID)


def read(table, *packets):
    reader = reader_of(table)
    return list(reader.lines(io.BytesIO(b"".join(packets)), "q.dat")), reader.totals()


def measured_by(table, *packets):
    (line,), _ = read(table, *packets)
    assert line.fault is None
    return submission_from_json(line.body).batch


def test_thirty_degrees_about_z_are_the_transform_from_inertial_to_body(sky):
    batch = measured_by(MEASURED + SIGMAS, packed(THIRTY_DEG))
    assert batch.measurement.quaternion == pytest.approx([0.0, 0.0, 0.2588190451, 0.9659258263])
    x, y, _ = matrix_from_quaternion(batch.measurement.quaternion) @ [1.0, 0.0, 0.0]
    # Seen from the body, which turned by +30 degrees, the inertial x axis lies at -30.
    assert (x, y) == pytest.approx((math.cos(math.pi / 6), -0.5))
    assert (batch.time.text, batch.batch) == (TIME, f"{ATTITUDE_APID}-{TIME}-7-body")
    solution = acquire(batch, mission_with(""), sky).solution
    assert solution.quaternion == pytest.approx(THIRTY_DEG)
    assert np.diag(solution.covariance_arcsec2) == pytest.approx([36.0, 36.0, 1600.0])


@pytest.mark.parametrize(
    ("keys", "sent"),
    [
        ('scalar = "first"\n', [THIRTY_DEG[3], *THIRTY_DEG[:3]]),
        ('direction = "body_to_inertial"\n', [0.0, 0.0, -THIRTY_DEG[2], THIRTY_DEG[3]]),
    ],
)
def test_other_orders_and_directions_are_turned_to_the_service_s(keys, sent):
    batch = measured_by(MEASURED + SIGMAS + keys, packed(sent))
    assert batch.measurement.quaternion == pytest.approx(THIRTY_DEG)


@pytest.mark.parametrize(("unit", "arcsec"), [("arcsec", 1.0), ("deg", 3600.0), ("rad", 206264.8)])
def test_accuracies_are_of_the_unit_that_the_table_names(unit, arcsec):
    sigmas, covariance = np.array([6.0, 6.0, 40.0]) / arcsec, np.array(COVARIANCE) / arcsec**2
    unit = f'angle_unit = "{unit}"\n'
    body = packed(THIRTY_DEG, sigmas, covariance)
    by_sigma = measured_by(MEASURED + SIGMAS + unit, body).measurement.covariance_arcsec2
    assert by_sigma == pytest.approx(np.diag([36.0, 36.0, 1600.0]), rel=1e-6)
    by_covariance = measured_by(MEASURED + UPPER + unit, body).measurement.covariance_arcsec2
    rows = [[36.0, 1.0, 0.0], [1.0, 36.0, 2.0], [0.0, 2.0, 1600.0]]
    assert by_covariance == pytest.approx(np.array(rows), rel=1e-6)
    constant = measured_by(MEASURED + "sigma_arcsec = [6.0, 6.0, 40.0]\n", body)
    assert constant.measurement.covariance_arcsec2 == pytest.approx(np.diag([36.0, 36.0, 1600.0]))


@pytest.mark.parametrize(("unit", "scale"), [("deg_per_s", 1.0), ("rad_per_s", 57.29577951308232)])
def test_rates_of_the_packets_go_with_measured_attitudes(unit, scale):
    """A body at 36 deg/s with an attitude every ten seconds would look still without them."""
    table = MEASURED + "sigma_arcsec = [6.0, 6.0, 40.0]\n" + RATES + f'unit = "{unit}"\n'
    batch = measured_by(table, packed(THIRTY_DEG, sigmas=(0.1, -0.2, 0.6)))
    assert batch.body_rates_deg_per_s == pytest.approx(scale * np.array([0.1, -0.2, 0.6]))
    without = measured_by(MEASURED + SIGMAS, packed(THIRTY_DEG))
    assert not without.body_rates_deg_per_s.any()


def test_rates_that_no_body_has_are_refused_by_their_parameters():
    table = MEASURED + "sigma_arcsec = [6.0, 6.0, 40.0]\n" + RATES
    (line,), _ = read(table, packed(THIRTY_DEG, sigmas=(0.0, 0.0, 9999.0)))
    assert "SIG_X, SIG_Y, SIG_Z" in line.fault.field
    assert "body_rates_deg_per_s" in line.fault.message


def test_a_tracker_s_axes_are_turned_by_its_alignment(sky):
    keys = SIGMAS + 'tracker = "STARTRACKER_1"\n'
    batch = measured_by(MEASURED + keys, packed(THIRTY_DEG))
    assert batch.measurement.tracker == "STARTRACKER_1"
    mission = mission_with("")
    turn = mission.tracker("STARTRACKER_1", "").body_from_tracker
    expected = turn @ matrix_from_quaternion(np.array(THIRTY_DEG))
    assert acquire(batch, mission, sky).solution.matrix == pytest.approx(expected)


@pytest.mark.parametrize(
    "sent", [packed([0.0] * 4), packed([math.nan] * 4), packed(THIRTY_DEG, valid=0.0)]
)
def test_a_packet_that_holds_no_attitude_gives_no_batch(sent):
    lines, totals = read(MEASURED + SIGMAS + 'valid = "Q_VALID"\n', sent)
    assert (lines, totals.batches, totals.without_stars) == ([], 0, 1)


@pytest.mark.parametrize(
    ("keys", "sent", "told"),
    [
        (SIGMAS, packed([0.0, 0.0, 0.0, 1.01]), "Q1, Q2, Q3, Q4: must have norm 1"),
        (SIGMAS, packed(THIRTY_DEG, (6.0, 0.0, 6.0)), "SIG_X, SIG_Y, SIG_Z: measurement.sigma"),
        (SIGMAS, packed(THIRTY_DEG, (6.0, math.nan, 6.0)), "SIG_Y: must be finite"),
        (
            UPPER,
            packed(THIRTY_DEG, covariance=(1.0, 2.0, 0.0, 1.0, 0.0, 1.0)),
            "P_6: measurement.covariance_arcsec2: must be positive definite",
        ),
    ],
)
def test_a_bad_attitude_costs_its_packet_alone_and_names_the_parameters(keys, sent, told):
    lines, totals = read(MEASURED + keys, sent, packed(THIRTY_DEG, count=8))
    (fault,) = [each.fault for each in lines if each.fault]
    assert told in f"{fault.field}: {fault.message}"
    assert "packet 1" in fault.field
    assert (totals.batches, totals.refused) == (1, 1)
    assert json.loads(lines[1].body)["batch"].endswith("-8-body")


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (MEASURED, "one of sigma, covariance and sigma_arcsec"),
        (MEASURED + SIGMAS + UPPER, "one of sigma, covariance"),
        (2 * (MEASURED + SIGMAS), "axes twice: the body, the body"),
        (MEASURED + SIGMAS + 'tracker = "OTHER"\n', "measurements: OTHER: the mission has"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(table, told):
    with pytest.raises(BadConfiguration, match=told):
        reader_of(table)


def test_a_parameter_that_xtce_lacks_is_named():
    with pytest.raises(BadInput, match=r"packets.measurements.0.sigma.*SIG_W"):
        reader_of(MEASURED + SIGMAS.replace("SIG_Y", "SIG_W"))


def test_a_mission_without_the_table_keeps_its_digest():
    without = mission_with(TIMES + '[packets.prior]\nquaternion = ["Q1", "Q2", "Q3", "Q4"]\n')
    assert "measurements" not in without.model_dump_json()

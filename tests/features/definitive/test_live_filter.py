"""The live filter: in portions as at once, late data included, and the same after a kill."""

import json
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import httpx
import numpy as np
import pytest

from service.errors import Busy, NotFound
from service.features.archive.archiving import PartFilter, archive, restore
from service.features.definitive import inputs as recorded_inputs
from service.features.definitive.carried import CarriedFilter, live_window
from service.features.definitive.day import definitive_day, window_of
from service.features.definitive.inputs import recorded_in
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.live_filter import LiveFilter
from service.features.definitive.part import Definitive
from service.features.definitive.stretches import attitudes_where
from service.features.products.part import Products
from service.observations.schema import submission_from_json
from service.storage.upkeep.verify import verify
from service.times import DAY_S, parse_utc
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec, matrix_from_quaternion
from tests.features.definitive.passes import (
    GYRO,
    MODEL,
    NOON,
    NOON_NS,
    mission_with,
    recorded_of,
    spun,
)
from tests.features.definitive.records import at, put_attitudes, put_gyro
from tests.features.definitive.simulated import attitudes_of, gyro_of, slews, truth_of
from tests.missions.without_gyro import mission_without_gyro, text_without_gyro
from tests.waiting import wait_until
from tests.web.serving import served

FIELDS = ("tai_ns", "quaternion", "covariance_arcsec2", "rate_deg_per_s", "bias_deg_per_h")
TABLES = """
[gyro]
sigma_v_rad_s0_5 = 3.1622776601683795e-07
sigma_u_rad_s1_5 = 3.1622776601683795e-10

[live_filter]
every_s = 0.1
"""


def before(recorded, seconds, *, left_out=()):
    """What was recorded of a pass until so many seconds after noon, less some of the attitudes."""
    end = NOON_NS + seconds * 10**9
    gyro = recorded.gyro_ns <= end
    a = recorded.attitudes
    kept = (a.tai_ns <= end) & ~np.isin(np.arange(len(a.tai_ns)), left_out)
    return replace(
        recorded,
        gyro_ns=recorded.gyro_ns[gyro],
        rates_rad_s=recorded.rates_rad_s[gyro],
        attitudes=AttitudeMeasurements(a.tai_ns[kept], a.quaternion[kept], a.covariance_rad2[kept]),
    )


def assert_same(found, other):
    for name in FIELDS:
        assert np.array_equal(
            getattr(found.sample, name), getattr(other.sample, name), equal_nan=True
        ), name


@pytest.mark.parametrize("has_gyro", [True, False])
def test_in_portions_it_gives_the_last_filtered_attitude_of_the_day(missions, half_hour, has_gyro):
    mission = mission_without_gyro("XTE")
    if has_gyro:
        mission = mission_with(missions["XTE"], gyro=GYRO)
    carried, given = CarriedFilter(), 0
    for seconds in range(100, 1801, 100):
        recorded = before(half_hour[1], seconds)
        if not has_gyro:
            none = recorded.gyro_ns[:0], recorded.rates_rad_s[:0]
            recorded = replace(recorded, gyro_ns=none[0], rates_rad_s=none[1])
        found = carried.carry_on(recorded, mission)
        (stretch,) = definitive_day(recorded, mission, NOON.bucket(DAY_S)).stretches
        whole = stretch.samples["filtered"]
        assert found.model == stretch.model
        last = replace(found, sample=whole.taken(slice(-1, None)))
        assert_same(found, last)
        given += len(recorded.gyro_ns) if has_gyro else len(recorded.attitudes.tai_ns)
    # Marks stand every ten minutes: no more than those are filtered again each time.
    assert carried.filtered < 0.5 * given


def test_late_attitudes_and_late_rates_are_filtered_from_the_mark_before(missions, half_hour):
    mission = mission_with(missions["XTE"], gyro=GYRO)
    whole = half_hour[1]
    carried = CarriedFilter()
    carried.carry_on(before(whole, 1800, left_out=[120, 121, 122]), mission)
    begun = carried.filtered
    found = carried.carry_on(whole, mission)
    assert_same(found, CarriedFilter().carry_on(whole, mission))
    # 120 measurements are 16 minutes: the first mark still holds, the second does not.
    assert 1000 < carried.filtered - begun < 1500
    begun = carried.filtered
    assert_same(carried.carry_on(whole, mission), found)
    assert carried.filtered - begun < 650


def test_attitudes_after_the_last_rates_wait_for_them(missions, half_hour):
    mission = mission_with(missions["XTE"], gyro=GYRO)
    recorded = before(half_hour[1], 1500)
    gyro = recorded.gyro_ns <= NOON_NS + 1200 * 10**9
    late = replace(recorded, gyro_ns=recorded.gyro_ns[gyro], rates_rad_s=recorded.rates_rad_s[gyro])
    found = CarriedFilter().carry_on(late, mission)
    assert found.model == "gyro"
    assert int(found.sample.tai_ns[0]) == NOON_NS + 1200 * 10**9
    assert CarriedFilter().carry_on(before(half_hour[1], -1), mission) is None


def bodies(attitudes):
    """The attitudes as trackers' own, which need no stars."""
    p = attitudes.covariance_rad2 * ARCSEC_PER_RADIAN**2
    return [
        {
            "spacecraft": "XTE",
            "batch": f"q{int(ns)}",
            "time": at(ns).text,
            "a_priori": None,
            "measurement": {"quaternion": q.tolist(), "covariance_arcsec2": each.tolist()},
        }
        for ns, q, each in zip(attitudes.tai_ns, attitudes.quaternion, p, strict=True)
    ]


def send(app, attitudes):
    for body in bodies(attitudes):
        submission = submission_from_json(json.dumps(body))
        wait_until(lambda each=submission: is_taken(app, each), why="the service stays busy")


def is_taken(app, submission):
    try:
        app.submissions.submit(submission)
    except Busy:
        return False
    return True


@pytest.fixture
def live(opened):
    return opened(live_filter={})


def test_it_answers_what_smooth_records_and_another_process_answers_the_same(
    live, opened, half_hour, database, tmp_path
):
    first, whole = before(half_hour[1], 900), half_hour[1]
    with pytest.raises(NotFound):
        live.part(Definitive).live_filter.latest("XTE")
    put_gyro(live, first.gyro_ns, first.rates_rad_s)
    send(live, first.attitudes)
    live.part(Definitive).live_filter.refresh("XTE")
    assert live.part(Definitive).live_filter.latest("XTE").time == "1999-03-01T12:15:00.000Z"
    rest = slice(len(first.gyro_ns), None)
    put_gyro(live, whole.gyro_ns[rest], whole.rates_rad_s[rest])
    send(live, whole.attitudes)
    live.part(Definitive).live_filter.refresh("XTE")
    found = live.part(Definitive).live_filter.latest("XTE")
    assert (found.time, found.status, found.model) == (
        "1999-03-01T12:30:00.000Z",
        "good",
        "gyro",
    )
    live.part(Definitive).days.smooth("XTE")
    *_, block = live.part(Products).attitudes("XTE", grade="filtered").blocks
    assert block.time[-1] == found.time
    # The record keeps quaternions to the bit, covariances to seven digits.
    along = np.abs(block.quaternion[-1] @ found.quaternion)
    assert along == pytest.approx(1.0, abs=1e-15)
    assert np.diag(found.covariance_arcsec2) == pytest.approx(
        block.covariance_arcsec2[-1][[0, 3, 5]], rel=1e-6
    )
    live.close()
    live = opened(live_filter={})
    assert live.part(Definitive).live_filter.latest("XTE") == found
    # Batches without stars are sound records, and come back from the archive.
    assert verify(database) == []
    archive(live.store, tmp_path, parse_utc("1999-03-01T12:10:00Z"))
    restore(live.store, tmp_path, PartFilter())
    assert verify(database) == []
    (again,) = live.part(Definitive).days.smooth("XTE").days
    assert again.revision == 1


def test_it_depends_on_the_six_hours_before_the_hour_of_the_latest_batch(live, missions, rng):
    """Eight and a half hours from noon on, so that the record of the window begins at 14:00."""
    mission = mission_with(missions["XTE"], gyro=GYRO)
    truth = truth_of(slews, 8.5 * 3600.0, step_s=10.0)
    gyro, _ = gyro_of(truth, MODEL, rng)
    attitudes = attitudes_of(truth, np.arange(0, len(truth.time_s), 8), (6.0, 6.0, 40.0), rng)
    recorded = recorded_of(gyro.tai_ns, gyro.rate_rad_s, attitudes)
    put_gyro(live, recorded.gyro_ns, recorded.rates_rad_s)
    day, end = NOON.bucket(DAY_S), at(NOON_NS + 30_600 * 10**9)
    assert live_window(end)[0].text == "1999-03-01T14:00:00.000Z"

    def last_of(window):
        with live.store.reading() as connection:
            found = recorded_in(connection, live.sky, "XTE", "live", *window)
        (stretch,) = definitive_day(found, mission, day).stretches
        return stretch.samples["filtered"].taken(slice(-1, None))

    def latest():
        live.part(Definitive).live_filter.refresh("XTE")
        return live.part(Definitive).live_filter.latest("XTE")

    def assert_is_of_the_window(found):
        expected = last_of(live_window(end))
        assert found.time == end.text
        assert found.quaternion == expected.quaternion[0].tolist()
        p11, p12, p13, p22, p23, p33 = expected.covariance_arcsec2[0].tolist()
        assert found.covariance_arcsec2 == [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]
        assert found.bias_deg_per_h == expected.bias_deg_per_h[0].tolist()

    # One attitude every 80 s: those of 13:00 to 13:01:20 and of 15:00 to 15:01:20 come late.
    row = np.arange(len(attitudes.tai_ns))
    early, late = (row == 45) | (row == 46), (row == 135) | (row == 136)
    put_attitudes(live, attitudes_where(recorded.attitudes, ~(early | late)))
    first = latest()
    assert_is_of_the_window(first)
    # The whole day began two hours earlier, which makes no difference any more.
    whole = last_of(window_of(day))
    apart_arcsec = attitude_error_arcsec(
        matrix_from_quaternion(first.quaternion), matrix_from_quaternion(whole.quaternion[0])
    )
    sigma_arcsec = np.sqrt(np.diag(first.covariance_arcsec2))
    assert (np.abs(apart_arcsec) < 1e-3 * sigma_arcsec).all()
    assert np.diag(first.covariance_arcsec2) == pytest.approx(
        whole.covariance_arcsec2[0][[0, 3, 5]], rel=1e-3
    )
    send(live, attitudes_where(recorded.attitudes, early))
    assert latest() == first
    send(live, attitudes_where(recorded.attitudes, late))
    second = latest()
    assert_is_of_the_window(second)
    assert second.bias_deg_per_h != first.bias_deg_per_h


def test_readers_have_the_last_attitude_while_the_next_is_computed(live, half_hour):
    first, whole = before(half_hour[1], 300), half_hour[1]
    put_gyro(live, first.gyro_ns, first.rates_rad_s)
    send(live, first.attitudes)
    live.part(Definitive).live_filter.refresh("XTE")
    done = threading.Event()

    def read():
        times = set()
        while not done.is_set():
            times.add(live.part(Definitive).live_filter.latest("XTE").time)
        return times

    with ThreadPoolExecutor(1) as reader:
        reading = reader.submit(read)
        for begin in range(len(first.gyro_ns), 1801, 100):
            part = slice(begin, begin + 100)
            put_gyro(live, whole.gyro_ns[part], whole.rates_rad_s[part])
            live.part(Definitive).live_filter.refresh("XTE")
        done.set()
    assert len(reading.result()) > 1


def test_a_request_does_not_wait_for_the_first_look_of_the_thread(live, half_hour):
    recorded = before(half_hour[1], 300)
    put_gyro(live, recorded.gyro_ns, recorded.rates_rad_s)
    send(live, recorded.attitudes)
    live.part(Definitive).live_filter.stop()
    # A thread that ends before it looks.
    live.part(Definitive).live_filter.start()
    with pytest.raises(NotFound, match="no filtered attitude"):
        live.part(Definitive).live_filter.latest("XTE")
    live.part(Definitive).live_filter.refresh("XTE")
    assert live.part(Definitive).live_filter.latest("XTE").time == "1999-03-01T12:05:00.000Z"


def test_the_thread_waits_for_the_kernels(live, half_hour):
    recorded = before(half_hour[1], 300)
    put_gyro(live, recorded.gyro_ns, recorded.rates_rad_s)
    send(live, recorded.attitudes)
    kernels = SimpleNamespace(is_needed=True)
    waiting = LiveFilter(live.context, kernels)
    waiting.start()

    def is_there():
        try:
            return waiting.latest("XTE").time == "1999-03-01T12:05:00.000Z"
        except NotFound:
            return False

    try:
        time.sleep(0.3)
        assert not is_there()
        kernels.is_needed = False
        give_up = time.monotonic() + 60.0
        while not is_there():
            assert time.monotonic() < give_up
            time.sleep(0.05)
    finally:
        waiting.stop()


def test_a_mission_without_the_table_has_none(app):
    with pytest.raises(NotFound, match="no live filter"):
        app.part(Definitive).live_filter.latest("XTE")


@pytest.mark.slow
def test_a_service_that_is_killed_and_started_again_gives_the_same_state(
    database, tmp_path, half_hour, missions, monkeypatch
):
    mission = mission_with(missions["XTE"], gyro=GYRO)
    folder = tmp_path / "missions"
    folder.mkdir()
    text = text_without_gyro("XTE") + TABLES
    (folder / "xte.toml").write_text(text, encoding="utf-8")
    monkeypatch.setenv("ACQUIRE_MISSIONS", str(folder))

    def latest(api, left_out=()):
        """The answer, once it is made of all that was sent."""
        known = before(half_hour[1], 300, left_out=left_out)
        expected = CarriedFilter().carry_on(known, mission).sample
        give_up = time.monotonic() + 120.0
        while True:
            answer = httpx.get(f"{api}/spacecraft/XTE/attitude/latest")
            if answer.status_code == 200:
                found = answer.json()
                variances = np.diag(found["covariance_arcsec2"])
                if np.allclose(variances, expected.covariance_arcsec2[0][[0, 3, 5]], rtol=1e-5):
                    assert np.allclose(found["quaternion"], expected.quaternion[0], atol=1e-9)
                    return found
            assert time.monotonic() < give_up, answer.text
            time.sleep(0.05)

    recorded = before(half_hour[1], 300)
    measured = bodies(recorded.attitudes)
    left_out = range(len(measured) - 5, len(measured))
    block = {
        "block": "g1",
        "start": NOON.text,
        "step_s": 1.0,
        "rates_rad_per_s": recorded.rates_rad_s.tolist(),
    }
    with served(database) as (server, url), httpx.Client(base_url=url, timeout=60) as client:
        assert client.post("/api/v1/spacecraft/XTE/gyro", json=block).status_code == 201
        for body in measured[:-5]:
            assert client.post("/api/v1/batches", json=body).status_code == 201
        first = latest(f"{url}/api/v1", left_out)
        assert (first["time"], first["status"]) == ("1999-03-01T12:05:00.000Z", "good")
        server.send_signal(signal.SIGKILL)
        server.wait()
    with served(database) as (server, url), httpx.Client(base_url=url, timeout=60) as client:
        assert latest(f"{url}/api/v1", left_out) == first
        for body in measured[-5:]:
            assert client.post("/api/v1/batches", json=body).status_code == 201
        second = latest(f"{url}/api/v1")
        assert second["covariance_arcsec2"][0][0] < first["covariance_arcsec2"][0][0]


@pytest.mark.parametrize("is_gyro_off", [False, True])
def test_rates_of_recorded_batches_lead_a_spinning_body_through_the_day_and_live(
    live, rng, is_gyro_off
):
    """36 deg/s and a batch every ten seconds: a turn a batch, by the attitudes a body at rest.

    A gyro that is off may send zeros: it says the same.
    """
    rate_deg_per_s = [0.0, 0.0, 36.0]
    truth = truth_of(lambda t: np.tile(np.radians(rate_deg_per_s), (len(t), 1)), 400.0, 0.5)
    measured = attitudes_of(truth, np.arange(0, 801, 20), (6.0, 6.0, 40.0), rng)
    recorded = recorded_of([], np.zeros((0, 3)), measured).attitudes
    if is_gyro_off:
        gyro_ns = np.arange(recorded.tai_ns[0], recorded.tai_ns[-1] + 1, 10**9)
        put_gyro(live, gyro_ns, np.zeros((len(gyro_ns), 3)))
    for body in bodies(recorded):
        told = json.dumps(body | {"body_rates_deg_per_s": rate_deg_per_s})
        live.submissions.submit(submission_from_json(told))
    window = live_window(at(recorded.tai_ns[-1]))
    with live.context.reading() as connection:
        found = recorded_in(connection, live.sky, "XTE", "live", *window)
    np.testing.assert_allclose(np.degrees(found.carried_rad_s), [rate_deg_per_s] * 41, rtol=1e-12)
    mission = live.context.missions["XTE"]
    (stretch,) = definitive_day(found, mission, NOON.bucket(DAY_S)).stretches
    carried = CarriedFilter().carry_on(found, mission)
    assert (stretch.model, carried.model) == ("constant_rate", "constant_rate")
    for rates in (stretch.samples["smoothed"].rate_deg_per_s[5:], carried.sample.rate_deg_per_s):
        np.testing.assert_allclose(rates, np.tile(rate_deg_per_s, (len(rates), 1)), atol=0.02)


def test_rates_that_vary_leave_the_marks_where_they_are(rng):
    """A body that nutates, a batch more at each look: an hour is not filtered each time."""
    mission = mission_without_gyro("XTE")
    _, _, whole, _ = spun((0.0, 0.0, 36.0), rng, duration_s=3600.0, wander=0.5)
    carried, given = CarriedFilter(), 0
    for count in range(300, 361):
        recorded = replace(
            whole,
            attitudes=attitudes_where(whole.attitudes, slice(0, count)),
            carried_rad_s=whole.carried_rad_s[:count],
        )
        found = carried.carry_on(recorded, mission)
        given += count
    assert_same(found, CarriedFilter().carry_on(recorded, mission))
    assert carried.filtered < 0.4 * given


def test_a_look_reads_the_rates_of_new_batches_only(live, rng, monkeypatch):
    read = []
    inputs = recorded_inputs._inputs

    def counted(connection, ids):
        read.append(len(ids))
        return inputs(connection, ids)

    monkeypatch.setattr(recorded_inputs, "_inputs", counted)
    truth = truth_of(lambda t: np.tile([0.0, 0.0, 0.1], (len(t), 1)), 300.0, 0.5)
    measured = attitudes_of(truth, np.arange(0, 601, 20), (6.0, 6.0, 40.0), rng)
    recorded = recorded_of([], np.zeros((0, 3)), measured).attitudes
    sent = [body | {"body_rates_deg_per_s": [0.0, 0.0, 5.7]} for body in bodies(recorded)]
    for first, end in ((0, 25), (25, 26), (26, 31)):
        for body in sent[first:end]:
            live.submissions.submit(submission_from_json(json.dumps(body)))
        live.part(Definitive).live_filter.refresh("XTE")
    assert live.part(Definitive).live_filter.latest("XTE").model == "constant_rate"
    assert read == [25, 1, 5]

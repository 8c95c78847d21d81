"""Kalman filter of attitude and gyro bias, from gyro samples and attitude measurements.

A multiplicative extended Kalman filter (Lefferts, Markley & Shuster, 1982).
"""

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from service.attitude.definitive import Status
from service.errors import BadInput, Fault
from service.features.definitive.kernels.forward import (
    AFTER_GAP,
    AGREED,
    IN_A_ROW,
    SINCE_NS,
    Epochs,
    Track,
    run_filter,
)
from service.features.definitive.kernels.inputs import (
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
    FilterSettings,
    no_attitudes,
    no_directions,
)
from service.features.definitive.kernels.propagation import Noise, Timeline, workspace
from service.features.definitive.kernels.result import (
    AttitudeHistory,
    FilterResult,
    FilterState,
    Innovations,
    Steps,
)
from service.features.definitive.kernels.updates import ATTITUDE, DIRECTION, Measured
from service.features.definitive.kernels.updates import Innovations as WrittenInnovations
from service.gyro.samples import GyroModel, GyroSamples
from service.vectors import Vector, read_only

NS = 1e-9
LEAST_REDUNDANCY = 0.25
"""Least redundancy counted for an accepted measurement, so that a start ends even in a gyro gap."""
ESTABLISHED = 10.0
"""Redundancy from which contradicting measurements need `reset_after_s` to replace an attitude."""


def filter_attitude(
    model: GyroModel | ConstantRateModel,
    gyro: GyroSamples | None = None,
    attitudes: AttitudeMeasurements | None = None,
    directions: DirectionMeasurements | None = None,
    state: FilterState | None = None,
    settings: FilterSettings | None = None,
) -> FilterResult:
    """Filter measurements from `state` on, or from the first measured attitude if None.

    Epochs are all times of gyro samples and, up to the last sample, of measurements.  A `GyroModel`
    needs `gyro`; for a `ConstantRateModel` the epochs are the times of measurements, and `gyro` has
    a rate for each of them, or is None.  Filtering in parts, each from the final state of the part
    before, gives the same bytes as at once.

    Raises `BadInput` for a rate beyond the gyro's limit, samples not later than the state,
    measurements before it, and input without any epoch.
    """
    attitudes, directions = attitudes or no_attitudes(), directions or no_directions()
    least_redundancy = LEAST_REDUNDANCY
    if isinstance(model, ConstantRateModel):
        times = np.unique(np.concatenate([attitudes.tai_ns, directions.tai_ns]))
        if gyro is not None and not np.array_equal(gyro.tai_ns, times):
            expected = "must be the times of the measurements where the model is of a constant rate"
            raise BadInput(Fault("gyro.tai_ns", expected, f"{len(gyro.tai_ns)} times"))
        rates = np.zeros((len(times), 3)) if gyro is None else gyro.rate_rad_s
        begin = 0 if state is None else np.searchsorted(times, state.tai_ns)
        gyro, model = GyroSamples(times[begin:], rates[begin:]), model.as_gyro()
        # A rate that nothing measures may be too uncertain ever to check an attitude.
        least_redundancy = 1.0
    elif gyro is None:
        raise BadInput(Fault("gyro", "must be given where the model is of a gyro"))
    else:
        gyro.check(model)
        if state is not None and len(gyro.tai_ns) and gyro.tai_ns[0] <= state.tai_ns:
            found = str(int(gyro.tai_ns[0]))
            raise BadInput(Fault("gyro.tai_ns[0]", f"must be after {state.tai_ns}", found))
    if not len(gyro.tai_ns):
        raise BadInput(Fault("gyro", "must have at least one sample"))
    kind, row = _order(attitudes, directions, state, gyro)
    measured, tai_ns = _measured(attitudes, directions, kind, row)
    timeline = _timeline(gyro, tai_ns, model, state)
    noise = noise_of(model, settings, least_redundancy)
    track = _track(state, noise)
    epochs, written = _room(len(timeline.tai_ns), len(kind))
    run_filter(track, timeline, measured, noise, epochs, written, workspace())
    for array in (*timeline, *epochs, *written, tai_ns, kind, row):
        read_only(array)
    outside = len(attitudes.tai_ns) + len(directions.tai_ns) - len(kind)
    return FilterResult(
        history=AttitudeHistory(
            timeline.tai_ns,
            epochs.quaternion,
            epochs.rate,
            epochs.bias,
            epochs.covariance,
            epochs.doubt_rad,
            epochs.status,
        ),
        innovations=Innovations(tai_ns, kind, row, *written),
        steps=Steps(
            timeline.step_s,
            timeline.rate_rad_s,
            timeline.gap_s,
            epochs.started,
            epochs.updated,
            epochs.shift,
        ),
        state=_state(track, int(timeline.tai_ns[-1]), gyro.rate_rad_s[-1]),
        outside=outside,
    )


def _order(
    attitudes: AttitudeMeasurements,
    directions: DirectionMeasurements,
    state: FilterState | None,
    gyro: GyroSamples,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Kind and row of measurements within the period of gyro samples, in order of time."""
    for name, measurements in (("attitudes", attitudes), ("directions", directions)):
        if state is not None and len(measurements.tai_ns) and measurements.tai_ns[0] < state.tai_ns:
            expected = f"must be no earlier than the state, {state.tai_ns}"
            raise BadInput(Fault(f"{name}.tai_ns[0]", expected, str(int(measurements.tai_ns[0]))))
    a, d = len(attitudes.tai_ns), len(directions.tai_ns)
    times = np.concatenate([attitudes.tai_ns, directions.tai_ns])
    kind = np.repeat(np.array([ATTITUDE, DIRECTION]), [a, d])
    row = np.concatenate([np.arange(a), np.arange(d)])
    order = np.argsort(times, kind="stable")
    begin = gyro.tai_ns[0] if state is None else state.tai_ns
    order = order[(times[order] >= begin) & (times[order] <= gyro.tai_ns[-1])]
    return kind[order], row[order]


def _measured(
    attitudes: AttitudeMeasurements,
    directions: DirectionMeasurements,
    kind: npt.NDArray[np.int64],
    row: npt.NDArray[np.int64],
) -> tuple[Measured, npt.NDArray[np.int64]]:
    """Convert measurements in a given order to arrays for the kernels, and list their times."""
    m = len(kind)
    found = Measured(
        kind, np.zeros((m, 4)), np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((m, 3))
    )
    tai_ns = np.zeros(m, dtype=np.int64)
    a, d = kind == ATTITUDE, kind == DIRECTION
    tai_ns[a], tai_ns[d] = attitudes.tai_ns[row[a]], directions.tai_ns[row[d]]
    q = attitudes.quaternion[row[a]]
    found.quaternion[a] = q / np.linalg.norm(q, axis=1, keepdims=True)
    found.covariance[a] = attitudes.covariance_rad2[row[a]]
    found.body[d], found.inertial[d] = directions.body[row[d]], directions.inertial[row[d]]
    found.covariance[d] = directions.sigma_rad[row[d]][:, None, None] ** 2 * np.eye(3)
    return found, tai_ns


def _timeline(
    gyro: GyroSamples,
    measured_ns: npt.NDArray[np.int64],
    model: GyroModel,
    state: FilterState | None,
) -> Timeline:
    """Epochs of the filter, with the time step and rate that lead to each."""
    tai_ns = np.unique(np.concatenate([gyro.tai_ns, measured_ns]))
    begin_ns = int(gyro.tai_ns[0]) if state is None else state.tai_ns
    before = gyro.rate_rad_s[:1] if state is None else state.rate_rad_s[None]
    # The gyro's interval that each step is a part of: it ends with sample `sample`.
    sample = np.searchsorted(gyro.tai_ns, tai_ns)
    interval_begin_ns = np.append(begin_ns, gyro.tai_ns[:-1])[sample]
    interval_s = (gyro.tai_ns[sample] - interval_begin_ns) * NS
    step_begin_ns = np.append(begin_ns, tai_ns[:-1])
    gap = interval_s > model.largest_step_s
    rate = gyro.rate_rad_s[sample]
    rate_before = np.concatenate([before, gyro.rate_rad_s[:-1]])[sample]
    return Timeline(
        tai_ns=tai_ns,
        step_s=(tai_ns - step_begin_ns) * NS,
        rate_rad_s=np.where(gap[:, None], 0.5 * (rate_before + rate), rate),
        interval_s=interval_s,
        gap_s=np.where(gap, (step_begin_ns - interval_begin_ns) * NS, -1.0),
        first=np.append(0, np.searchsorted(measured_ns, tai_ns, side="right")),
    )


def noise_of(
    model: GyroModel,
    settings: FilterSettings | None = None,
    least_redundancy: float = LEAST_REDUNDANCY,
) -> Noise:
    """Model and filter settings as plain numbers for the compiled kernels."""
    settings = settings or FilterSettings()
    gate_2, gate_3 = _gates(settings.gate_tail)
    start_gate_3 = _gates(max(settings.gate_tail, settings.start_gate_tail))[1]
    return Noise(
        angle=float(model.sigma_v_rad_s0_5**2),
        bias=float(model.sigma_u_rad_s1_5**2),
        coast=float(model.coast_rad_s1_5**2),
        clock_step_s=float(model.clock_step_s),
        first_bias=float(model.bias_sigma_rad_s**2),
        scale=float(model.scale**2),
        misalignment=float(model.misalignment_rad**2),
        gate_2=gate_2,
        gate_3=gate_3,
        start_gate_3=start_gate_3,
        start_redundancy=settings.start_redundancy,
        least_redundancy=least_redundancy,
        established=max(ESTABLISHED, settings.start_redundancy),
        confirmations=settings.confirmations,
        reset_after_ns=round(settings.reset_after_s / NS),
        lost=float(settings.lost_rad**2),
    )


@lru_cache(maxsize=64)
def _gates(tail: float) -> tuple[float, float]:
    """Values that chi-square with 2 and 3 degrees of freedom exceeds with probability `tail`."""
    low, high = 0.0, 2000.0
    # Halved until no number lies between: scipy's inverse takes a tenth of a start to load.
    while low < (middle := 0.5 * (low + high)) < high:
        chance = math.erfc(math.sqrt(0.5 * middle))
        chance += math.sqrt(2.0 * middle / math.pi) * math.exp(-0.5 * middle)
        low, high = (middle, high) if chance > tail else (low, middle)
    return -2.0 * math.log(tail), high


def _track(state: FilterState | None, noise: Noise) -> Track:
    """Working copy of a filter state, or an empty one."""
    counts, redundancy, doubt_rad = np.zeros(5, dtype=np.int64), np.zeros(1), np.zeros(1)
    if state is None:
        covariance = np.diag([0.0, 0.0, 0.0, *[noise.first_bias] * 3])
        none, zero = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        status = np.array([int(Status.NONE)])
        rest = (status, counts, redundancy, doubt_rad)
        return Track(none, zero, covariance, zero.copy(), none.copy(), *rest)
    counts[IN_A_ROW], counts[AGREED] = state.rejected, state.agreed
    counts[SINCE_NS], counts[AFTER_GAP] = state.rejected_since_ns, state.after_gap
    redundancy[0], doubt_rad[0] = state.redundancy, state.doubt_rad
    return Track(
        state.quaternion.copy(),
        state.bias_rad_s.copy(),
        state.covariance.copy(),
        state.anchor_rad_s.copy(),
        state.rival.copy(),
        np.array([int(state.status)]),
        counts,
        redundancy,
        doubt_rad,
    )


def _state(track: Track, tai_ns: int, rate_rad_s: Vector) -> FilterState:
    counts = track.counts.tolist()
    return FilterState(
        tai_ns=tai_ns,
        quaternion=read_only(track.quaternion),
        bias_rad_s=read_only(track.bias),
        covariance=read_only(track.covariance),
        rate_rad_s=rate_rad_s.copy(),
        anchor_rad_s=read_only(track.anchor),
        rival=read_only(track.rival),
        status=Status(int(track.status[0])),
        redundancy=float(track.redundancy[0]),
        rejected=counts[IN_A_ROW],
        agreed=counts[AGREED],
        rejected_since_ns=counts[SINCE_NS],
        doubt_rad=float(track.doubt_rad[0]),
        after_gap=bool(counts[AFTER_GAP]),
    )


def _room(n: int, m: int) -> tuple[Epochs, WrittenInnovations]:
    """Empty output arrays of the kernel for n epochs and m measurements."""
    epochs = Epochs(
        quaternion=np.empty((n, 4)),
        bias=np.empty((n, 3)),
        rate=np.empty((n, 3)),
        covariance=np.empty((n, 6, 6)),
        doubt_rad=np.empty(n),
        status=np.empty(n, dtype=np.int64),
        started=np.zeros(n, dtype=np.bool_),
        updated=np.zeros(n, dtype=np.int64),
        shift=np.zeros((n, 3)),
    )
    written = WrittenInnovations(
        innovation=np.full((m, 3), np.nan),
        covariance=np.full((m, 3, 3), np.nan),
        nis=np.full(m, np.nan),
        outcome=np.zeros(m, dtype=np.int64),
    )
    return epochs, written

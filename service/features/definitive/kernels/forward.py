"""Compiled recursion of the attitude filter over epochs and measurements."""

import math
from typing import Any, NamedTuple

from service.attitude.covariance import cholesky, copy, solve_factored
from service.attitude.definitive import Outcome, Status
from service.attitude.quaternions import rotation_between, turn
from service.compiled.jit import njit_no_refcount
from service.features.definitive.kernels.propagation import bias_shift, predict
from service.features.definitive.kernels.updates import (
    ATTITUDE,
    add_curvature,
    chi_square,
    correct,
    innovate,
    innovation_covariance,
    redundancy_of,
)

NONE, STARTING, GOOD = int(Status.NONE), int(Status.STARTING), int(Status.GOOD)
DOUBTFUL, LOST = int(Status.DOUBTFUL), int(Status.LOST)
UNUSED, ACCEPTED = int(Outcome.UNUSED), int(Outcome.ACCEPTED)
REJECTED, STARTED = int(Outcome.REJECTED), int(Outcome.STARTED)
UNDECIDED = int(Outcome.UNDECIDED)
IN_A_ROW, AGREED, SINCE_NS, HERE, AFTER_GAP = 0, 1, 2, 3, 4
"""Indices of `Track.counts`; HERE counts measurements accepted at the present epoch, and AFTER_GAP
is 1 from a gap of the gyro until the next accepted measurement.
"""
UPDATED, UNCHECKED = 1, 2
"""Values of `Epochs.updated`: a confirmed and an unconfirmed update of an epoch."""
PREDICTED = 0.25
"""Redundancy number from which a measurement was predicted well enough to be checked."""
WIDER = 4.0
"""Factor on the variance of the gyro bias after each start that the next measurement rejects."""


class Track(NamedTuple):
    """Working state of the filter, changed in place; see `FilterState`.

    `status` (1,), `counts` (5,) by the indices above, `redundancy` (1,), `doubt_rad` (1,).
    """

    quaternion: Any
    bias: Any
    covariance: Any
    anchor: Any
    rival: Any
    status: Any
    counts: Any
    redundancy: Any
    doubt_rad: Any


class Epochs(NamedTuple):
    """Output arrays of the filter for n epochs, each after its measurements.

    `quaternion` (n, 4), `bias` (n, 3), `rate` (n, 3) less the bias, `covariance` (n, 6, 6),
    `doubt_rad` (n,), `status` (n,), and `shift` (n, 3), the argument of `propagation.predict`.
    `started` (n,) is true where the state was replaced; `updated` (n,) is UPDATED there and where a
    measurement was accepted, UNCHECKED if that followed a gap of the gyro and has to be confirmed
    like a start, and 0 elsewhere.
    """

    quaternion: Any
    bias: Any
    rate: Any
    covariance: Any
    doubt_rad: Any
    status: Any
    started: Any
    updated: Any
    shift: Any


@njit_no_refcount
def run_filter(track, timeline, measured, noise, epochs, innovations, work):  # type: ignore[no-untyped-def]
    """Filter all epochs of a timeline; `track` is advanced in place to the last one."""
    for k in range(len(timeline.tai_ns)):
        _propagate(track, k, timeline, noise, epochs.shift[k], work)
        track.counts[HERE], after_gap = 0, track.counts[AFTER_GAP]
        for m in range(timeline.first[k], timeline.first[k + 1]):
            _measure(track, m, timeline.tai_ns[k], measured, noise, innovations, work)
            if innovations.outcome[m] == STARTED:
                epochs.started[k] = True
        if epochs.started[k] or track.counts[HERE] > 0:
            is_unchecked = after_gap == 1 and not epochs.started[k] and track.status[0] == STARTING
            epochs.updated[k] = UNCHECKED if is_unchecked else UPDATED
        _write(track, k, timeline, epochs)


@njit_no_refcount
def _propagate(track, k, timeline, noise, shift, work):  # type: ignore[no-untyped-def]
    """Propagate the state to epoch k; `shift` (3,) receives the variance added to the bias."""
    rate = timeline.rate_rad_s[k]
    if track.status[0] == NONE:
        for i in range(3):
            track.anchor[i] = rate[i]
        return
    dt = timeline.step_s[k]
    # A step of no length changes nothing, not even the last bit.
    if dt <= 0.0:
        return
    if timeline.gap_s[k] >= 0.0:
        track.counts[AFTER_GAP] = 1
    bias_shift(track.anchor, rate, timeline.interval_s[k], noise, shift)
    for i in range(3):
        work.rate[i] = rate[i] - track.bias[i]
        work.theta[i] = work.rate[i] * dt
    predict(track.covariance, work.rate, dt, timeline.gap_s[k], shift, noise, work)
    turn(track.quaternion, work.theta, track.quaternion)
    turn(track.rival, work.theta, track.rival)
    for i in range(3):
        if track.covariance[i, i] > noise.lost:
            track.status[0] = LOST


@njit_no_refcount
def _measure(track, m, tai_ns, measured, noise, innovations, work):  # type: ignore[no-untyped-def]
    """Use one measurement: accept it, reject it, or start the filter from it."""
    kind, counts = measured.kind[m], track.counts
    if track.status[0] == NONE or track.status[0] == LOST:
        if kind != ATTITUDE:
            innovations.outcome[m] = UNUSED
        else:
            # What was known of the bias before the attitude was lost still holds.
            _start(track, m, measured, noise, track.status[0] == LOST)
            innovations.outcome[m] = STARTED
        return
    z, s, h, r = innovations.innovation[m], innovations.covariance[m], work.partials, work.noise
    size, angle = innovate(track.quaternion, measured, m, z, h, work.small)
    copy(measured.covariance[m], r)
    if kind != ATTITUDE:
        add_curvature(track.covariance, r)
    sound = innovation_covariance(track.covariance, h, size, r, s, work)
    nis = chi_square(z, size, work) if sound else math.inf
    innovations.nis[m] = nis
    # Before the start is confirmed, the older measurement is no better than the new one.
    confirmed = track.redundancy[0] >= noise.start_redundancy
    gate = noise.gate_3 if size == 3 else noise.gate_2
    redundancy = 0.0
    if sound and (track.redundancy[0] < noise.established or counts[AFTER_GAP] == 1):
        redundancy = redundancy_of(r, size, work)
        # An attitude that was hardly predicted checks the first guess of the bias, which may be
        # far off, and not the start.
        if not confirmed and size == 3 and redundancy >= PREDICTED:
            gate = noise.start_gate_3
    if nis <= gate and (counts[IN_A_ROW] == 0 or _decides(track, measured, m, gate, noise, work)):
        innovations.outcome[m] = ACCEPTED
        if counts[AFTER_GAP] == 1:
            # What supported the attitude before the gap supports the share of it that is left.
            track.redundancy[0] *= redundancy
            counts[AFTER_GAP] = 0
        if track.redundancy[0] < noise.established:
            track.redundancy[0] += max(redundancy, noise.least_redundancy)
        correct(track.covariance, z, h, size, r, work)
        _accept(track, noise, work)
        return
    innovations.outcome[m] = REJECTED if nis > gate else UNDECIDED
    again = not confirmed
    if confirmed and counts[HERE] == 0:
        _contradict(track, m, tai_ns, nis > gate, angle, measured, noise, work)
        again = tai_ns - counts[SINCE_NS] >= noise.reset_after_ns or (
            # A young attitude has less support than the measurements that contradict it.
            track.redundancy[0] < noise.established and counts[IN_A_ROW] > track.redundancy[0]
        )
    if again and kind == ATTITUDE:
        _start(track, m, measured, noise, False)
        innovations.outcome[m] = STARTED


@njit_no_refcount
def _decides(track, measured, m, gate, noise, work):  # type: ignore[no-untyped-def]
    """True if a measurement that agrees with the state may end a doubt.

    The measurement has to exclude the rival attitude.  If fewer than `confirmations` measurements
    were rejected, a rival within the state's covariance suffices; more rejections are no chance,
    and a wide covariance may contain the true and the wrong attitude.  `work.small` holds the
    factor of the innovation's covariance, and keeps it.
    """
    copy(work.small, work.psi)
    size, _ = innovate(track.rival, measured, m, work.dx, work.psi_square, work.small)
    copy(work.psi, work.small)
    if chi_square(work.dx, size, work) > gate:
        return True
    if track.counts[IN_A_ROW] >= noise.confirmations:
        return False
    rotation_between(track.quaternion, track.rival, work.dx)
    if not cholesky(track.covariance, 3, work.psi):
        return False
    for i in range(3):
        work.theta[i] = work.dx[i]
    solve_factored(work.psi, 3, work.theta)
    apart = 0.0
    for i in range(3):
        apart += work.dx[i] * work.theta[i]
    return apart <= noise.gate_3


@njit_no_refcount
def _contradict(track, m, tai_ns, rejected, angle, measured, noise, work):  # type: ignore[no-untyped-def]
    """Begin or continue a doubt about the attitude; rejected measurements update the rival
    attitude.

    The rival is the mean of the latest rejected measurements, and is propagated with the gyro like
    the state; a rival of the last one alone would soon be excluded by its own noise.  A measurement
    that agrees with both decides nothing.
    """
    counts = track.counts
    if counts[IN_A_ROW] == 0:
        counts[SINCE_NS] = tai_ns
        for i in range(4):
            track.rival[i] = track.quaternion[i]
    counts[AGREED] = 0
    track.status[0] = DOUBTFUL
    if not rejected:
        return
    counts[IN_A_ROW] += 1
    track.doubt_rad[0] = max(track.doubt_rad[0], angle)
    size, _ = innovate(track.rival, measured, m, work.dx, work.partials, work.small)
    weight = 1.0 / min(float(counts[IN_A_ROW]), noise.established)
    for j in range(3):
        work.theta[j] = 0.0
        for i in range(size):
            work.theta[j] += weight * work.partials[i, j] * work.dx[i]
    turn(track.rival, work.theta, track.rival)


@njit_no_refcount
def _start(track, m, measured, noise, bias_is_known):  # type: ignore[no-untyped-def]
    """Replace the attitude by a measured one; the bias keeps its value, and its variance if known.

    If the first measurement after a start already rejects it, the bias may be the reason.
    """
    p = track.covariance
    is_at_once = track.status[0] == STARTING and track.redundancy[0] == 0.0
    for i in range(4):
        track.quaternion[i] = measured.quaternion[m, i]
    for i in range(3):
        for j in range(3):
            p[i, j] = measured.covariance[m, i, j]
            p[i, j + 3] = p[j + 3, i] = 0.0
            if not bias_is_known and i != j:
                p[i + 3, j + 3] = 0.0
        if not bias_is_known:
            p[i + 3, i + 3] = WIDER * p[i + 3, i + 3] if is_at_once else noise.first_bias
    for i in range(len(track.counts)):
        track.counts[i] = 0
    track.redundancy[0] = track.doubt_rad[0] = 0.0
    track.status[0] = STARTING if noise.start_redundancy > 0.0 else GOOD


@njit_no_refcount
def _accept(track, noise, work):  # type: ignore[no-untyped-def]
    """Correct the state by `work.dx`, and end a doubt after enough agreeing measurements."""
    counts = track.counts
    turn(track.quaternion, work.dx[:3], track.quaternion)
    for i in range(3):
        track.bias[i] += work.dx[i + 3]
    counts[HERE] += 1
    if counts[IN_A_ROW] > 0:
        counts[AGREED] += 1
        # Short of a confirmation the rejected ones were single bad measurements.
        if counts[AGREED] < noise.confirmations <= counts[IN_A_ROW]:
            return
        counts[IN_A_ROW] = counts[AGREED] = 0
        track.doubt_rad[0] = 0.0
    track.status[0] = GOOD if track.redundancy[0] >= noise.start_redundancy else STARTING


@njit_no_refcount
def _write(track, k, timeline, epochs):  # type: ignore[no-untyped-def]
    """Write the state to the output arrays of epoch k; NaN while there is no attitude."""
    known = track.status[0] != NONE
    for i in range(4):
        epochs.quaternion[k, i] = track.quaternion[i] if known else math.nan
    for i in range(3):
        epochs.bias[k, i] = track.bias[i] if known else math.nan
        epochs.rate[k, i] = timeline.rate_rad_s[k, i] - epochs.bias[k, i]
    copy(track.covariance, epochs.covariance[k])
    if not known:
        for i in range(6):
            for j in range(6):
                epochs.covariance[k, i, j] = math.nan
    epochs.doubt_rad[k] = track.doubt_rad[0]
    epochs.status[k] = track.status[0]

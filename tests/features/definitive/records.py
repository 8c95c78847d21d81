"""Simulated passes put into the records, as if batches of stars had given the attitudes."""

import numpy as np
from sqlalchemy import insert

from service.gyro.blocks import GyroBlockIn, block_from_model
from service.storage.sql.tables import solutions
from service.times import shifted
from service.vectors import ARCSEC_PER_RADIAN
from tests.features.definitive.passes import NOON, NOON_NS
from tests.storage.bulk import put, result_row

UPPER = ("p11", "p12", "p13", "p22", "p23", "p33")


def at(ns):
    return shifted(NOON, (int(ns) - NOON_NS) * 1e-9)


def put_attitudes(app, attitudes, *, spacecraft="XTE", run="live", name="b", status="good"):
    """Record a batch for each attitude."""
    rows = [
        result_row(app, at(ns), spacecraft=spacecraft, run=run, name=name, status=status)
        for ns in attitudes.tai_ns
    ]
    put(app, rows)
    p = attitudes.covariance_rad2 * ARCSEC_PER_RADIAN**2
    upper = p[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    solved = [
        {
            "result_id": result["id"],
            **dict(zip(("q1", "q2", "q3", "qc"), (q * np.sign(q[3])).tolist(), strict=True)),
            "frame": "EME2000",
            **dict(zip(UPPER, each.tolist(), strict=True)),
            "residual_rms_arcsec": 2.0,
            "predicted_rms_arcsec": 2.0,
            "taste": 1.0,
            "method": "quest",
            "status": status,
        }
        for (_, result), q, each in zip(rows, attitudes.quaternion, upper, strict=True)
    ]
    app.context.change(lambda connection: connection.execute(insert(solutions), solved))


def put_gyro(app, tai_ns, rates, *, spacecraft="XTE", run="live", size=1000):
    """Record samples as blocks."""
    for k in range(0, len(tai_ns), size):
        times, part = tai_ns[k : k + size], rates[k : k + size]
        model = GyroBlockIn(
            block=f"g{int(times[0])}",
            start=at(times[0]).text,
            run=run,
            times_s=((times - times[0]) * 1e-9).tolist(),
            rates_rad_per_s=[tuple(each) for each in part.tolist()],
        )
        app.gyro.record(block_from_model(model, spacecraft))


def put_pass(app, recorded, **names):
    """Record a pass of `passes.recorded_of`."""
    put_gyro(app, recorded.gyro_ns, recorded.rates_rad_s, **names)
    put_attitudes(app, recorded.attitudes, **names)

"""The last good attitudes before a batch, from which its own is predicted."""

from dataclasses import dataclass

import msgspec
import numpy as np
from sqlalchemy import BigInteger, Connection, bindparam, select

from service.filtering.prediction import Known
from service.storage.queries.pages import PLACE
from service.storage.sql.tables import batches, results, solutions
from service.times import Utc, recorded_utc
from service.vectors import ARCSEC_PER_RADIAN, Vector

_SHOWN = (
    results.c.id,
    batches.c.time,
    batches.c.time_ns,
    batches.c.input,
    *(solutions.c[name] for name in ("q1", "q2", "q3", "qc")),
    *(solutions.c[name] for name in ("p11", "p12", "p13", "p22", "p23", "p33")),
)
_LAST = (
    select(*_SHOWN)
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .join(solutions, solutions.c.result_id == results.c.id)
    .where(
        results.c.current,
        results.c.spacecraft == bindparam("spacecraft"),
        results.c.run == bindparam("run"),
        results.c.time_ns <= bindparam("until_ns", type_=BigInteger),
        results.c.time_ns >= bindparam("since_ns", type_=BigInteger),
        results.c.status == "good",
    )
    .order_by(*(column.desc() for column in PLACE))
    .limit(2)
)


@dataclass(frozen=True, eq=False)
class RecordedAttitude:
    """A good attitude, the result that it is of, and the rates (3,) that its batch carried."""

    result: str
    time: Utc
    known: Known
    body_rates_deg_per_s: Vector


class _Rates(msgspec.Struct):
    body_rates_deg_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)


_RATES = msgspec.json.Decoder(_Rates)


def last_attitudes(
    connection: Connection, spacecraft: str, run: str, until: Utc, within_s: float
) -> list[RecordedAttitude]:
    """The last two good attitudes that are not after a time, nor older than so much, latest first.

    A suspect attitude is none of them.
    """
    asked = {
        "spacecraft": spacecraft,
        "run": run,
        "until_ns": until.tai_ns,
        "since_ns": until.tai_ns - round(within_s * 1e9),
    }
    found = []
    for row in connection.execute(_LAST, asked):
        p11, p12, p13, p22, p23, p33 = row[8:]
        covariance = np.array([[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]])
        known = Known(row.time_ns, np.array(row[4:8]), covariance / ARCSEC_PER_RADIAN**2)
        rates = np.array(_RATES.decode(row.input).body_rates_deg_per_s)
        found.append(RecordedAttitude(row.id, recorded_utc(row.time), known, rates))
    return found

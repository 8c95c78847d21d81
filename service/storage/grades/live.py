"""The filtered attitude of live data at its last epoch, as it is answered."""

from typing import Annotated, ClassVar, Literal

import numpy as np

from service.filtering.state import Status
from service.grades.carried import Carried
from service.gyro.block import texts_of
from service.storage.grades.rows import STATUS
from service.storage.models.base import (
    Components,
    Covariance,
    DescribedAs,
    Moment,
    Quaternion,
    Record,
    doc,
)
from service.storage.models.base import (
    Status as StatusWord,
)
from service.times import Utc


class LiveAttitude(Record, frozen=True, kw_only=True):
    """The filtered attitude of a spacecraft at the last epoch of its live data."""

    component: ClassVar[str] = "LiveAttitude"
    spacecraft: str
    time: Annotated[Moment, doc("Of the last gyro sample or, without a gyro, measurement.")]
    quaternion: Quaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Annotated[Components, doc("Of the body relative to inertial, in body axes.")]
    bias_deg_per_h: Annotated[
        Components | None, doc("Bias of the gyro, in body axes; null at a constant rate.")
    ]
    bias_sigma_deg_per_h: Annotated[
        Components, doc("One sigma of the bias or, at a constant rate, of the rate.")
    ]
    status: Annotated[
        StatusWord, doc("`suspect`: measurements contradict it, or have not confirmed it yet.")
    ]
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]


def live_attitude(name: str, day_start: Utc, carried: Carried | None) -> LiveAttitude | None:
    """What is answered of the last epoch; None where there is no attitude, or it is lost."""
    if carried is None or (word := STATUS.get(Status(int(carried.sample.status[0])))) is None:
        return None
    sample = carried.sample
    (time,) = texts_of(day_start, np.asarray((sample.tai_ns - day_start.tai_ns) * 1e-9))
    p11, p12, p13, p22, p23, p33 = sample.covariance_arcsec2[0].tolist()
    is_gyro = carried.model == "gyro"
    return LiveAttitude(
        spacecraft=name,
        time=time,
        quaternion=sample.quaternion[0].tolist(),
        covariance_arcsec2=[[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]],
        rate_deg_per_s=sample.rate_deg_per_s[0].tolist(),
        bias_deg_per_h=sample.bias_deg_per_h[0].tolist() if is_gyro else None,
        bias_sigma_deg_per_h=sample.bias_sigma_deg_per_h[0].tolist(),
        status=word,
        model=carried.model,
    )

"""What every attitude data message of the service begins with."""

from service.products.adm.forms import Pairs, one_line, time_text
from service.products.attitudes import SeriesInfo

ORIGINATOR = "ATTITUDE-ACQUISITION"
REF_FRAME_A, REF_FRAME_B = "EME2000", "SC_BODY_1"
TIME_SYSTEM = "UTC"

GRADE_WORDS = {
    "filtered": "Grade filtered: EKF of measured attitudes and gyro rates, from the past alone",
    "smoothed": "Grade smoothed: FILTER_SMOOTHER of measured attitudes and gyro rates",
}
"""How a grade is described; raw attitudes are those of batches."""
RATE_WORDS = {
    frozenset({"own"}): "as the batches gave it",
    frozenset({"derived"}): "derived from the attitudes",
    frozenset({"own", "derived"}): "of some states as the batches gave it, else derived",
    frozenset({"estimated"}): "estimated by the filter",
}
"""How a rate is described, by the origins that occur."""


def header(about: SeriesInfo) -> Pairs:
    """Comments that say where the message comes from, its date and its originator."""
    told = [f"Written by attitude-acquisition {about.version}", f"Run {about.run}"]
    told.append(
        f"Attitudes of status {about.status}"
        if about.status != "all"
        else "Attitudes good or suspect"
    )
    if about.grade in GRADE_WORDS:
        told.append(GRADE_WORDS[about.grade])
    if about.start or about.end:
        what = "Batches" if about.grade == "raw" else "Samples"
        told.append(f"{what} from {about.start or 'the first'} to before {about.end or 'the end'}")
    told.append(f"Largest gap within a segment {about.largest_gap_s!r} s")
    return [
        *(("COMMENT", one_line(each)) for each in told),
        ("CREATION_DATE", time_text(about.created)),
        ("ORIGINATOR", ORIGINATOR),
    ]


def identity(about: SeriesInfo) -> Pairs:
    """The object that a message is about."""
    return [
        ("OBJECT_NAME", one_line(about.spacecraft)),
        ("OBJECT_ID", one_line(about.object_id or about.spacecraft)),
    ]

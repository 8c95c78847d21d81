"""What attitude data messages have in common: KVN and XML, and the header.

A message is written from pairs of keyword and value, in order; the keyword `COMMENT` may
be repeated.  Both forms take the same pairs.
"""

import math
from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape

from service.products.attitudes import SeriesInfo

Pairs = Sequence[tuple[str, str]]

_SCHEMA = "https://sanaregistry.org/r/ndmxml_unqualified/ndmxml-4.0.0-master-4.0.xsd"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"


def kvn(pairs: Pairs) -> str:
    """Lines of KVN, a pair a line."""
    width = max((len(key) for key, _ in pairs if key != "COMMENT"), default=0)
    return "".join(
        f"COMMENT {value}\n" if key == "COMMENT" else f"{key:{width}} = {value}\n"
        for key, value in pairs
    )


def xml(pairs: Pairs, indent: int = 0) -> str:
    """Elements of XML, a pair a line."""
    space = " " * indent
    return "".join(f"{space}<{key}>{escape(value)}</{key}>\n" for key, value in pairs)


def xml_opening(kind: str, header: Pairs) -> str:
    """The beginning of a message of a kind, such as `aem`, up to its body."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<{kind} xmlns:xsi="{_XSI}" xsi:noNamespaceSchemaLocation="{_SCHEMA}" '
        f'id="CCSDS_{kind.upper()}_VERS" version="2.0">\n'
        f"  <header>\n{xml(header, 4)}  </header>\n  <body>\n"
    )


def xml_closing(kind: str) -> str:
    """The end of a message of a kind."""
    return f"  </body>\n</{kind}>\n"


def time_text(utc: str) -> str:
    """A time as messages have it: without the Z, for the time system is a keyword."""
    return utc.removesuffix("Z")


def one_line(text: str) -> str:
    """A text as a value: printable ASCII, without line breaks."""
    return "".join(each if " " <= each <= "~" else "?" for each in text)


def numbers(values: Iterable[float]) -> list[str]:
    """Numbers as text from which the same float64 is read again; raises for NaN."""
    texts = [repr(value) for value in values]
    assert all(math.isfinite(value) for value in values)
    return texts


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

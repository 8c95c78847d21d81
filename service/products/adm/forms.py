"""KVN and XML: the two forms of every attitude data message.

A message is written from pairs of keyword and value, in order; the keyword `COMMENT` may
be repeated.  Both forms take the same pairs.
"""

import math
from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape

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

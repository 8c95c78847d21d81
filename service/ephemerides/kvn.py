"""Writer of keyword-value notation (KVN), the text form of CCSDS messages."""

from collections.abc import Sequence

Pairs = Sequence[tuple[str, str]]
"""Pairs of keyword and value, in order; the keyword `COMMENT` may be repeated."""

ORIGINATOR = "ATTITUDE-ACQUISITION"
TIME_SYSTEM = "UTC"


def kvn(pairs: Pairs) -> str:
    """Text of pairs in keyword-value notation (KVN), one line each."""
    width = max((len(key) for key, _ in pairs if key != "COMMENT"), default=0)
    return "".join(
        f"COMMENT {value}\n" if key == "COMMENT" else f"{key:{width}} = {value}\n"
        for key, value in pairs
    )


def time_text(utc: str) -> str:
    """UTC text without its Z, as CCSDS messages have it: a keyword names the time system."""
    return utc.removesuffix("Z")


def one_line(text: str) -> str:
    """Replace all but printable ASCII in a text, so that it fits on one line."""
    return "".join(each if " " <= each <= "~" else "?" for each in text)

"""Keyword-value notation (KVN), the text form of CCSDS messages."""

from collections.abc import Sequence

Pairs = Sequence[tuple[str, str]]
"""Keywords with their values, in order; the keyword `COMMENT` may be repeated."""

ORIGINATOR = "ATTITUDE-ACQUISITION"
TIME_SYSTEM = "UTC"


def kvn(pairs: Pairs) -> str:
    """Lines of KVN, a pair a line."""
    width = max((len(key) for key, _ in pairs if key != "COMMENT"), default=0)
    return "".join(
        f"COMMENT {value}\n" if key == "COMMENT" else f"{key:{width}} = {value}\n"
        for key, value in pairs
    )


def time_text(utc: str) -> str:
    """A time as messages have it: without the Z, for the time system is a keyword."""
    return utc.removesuffix("Z")


def one_line(text: str) -> str:
    """A text as a value: printable ASCII, without line breaks."""
    return "".join(each if " " <= each <= "~" else "?" for each in text)

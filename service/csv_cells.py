"""Texts in cells of CSV files that a spreadsheet takes for one cell, and not for a formula.

As the OWASP page on CSV injection recommends, an apostrophe goes before a text that begins with a
character that begins a formula.  Reading takes it away.
"""

import re

_STARTS = "=+\\-@\t\r\n＝＋－＠"
_IS_FORMULA = re.compile(f"'*[{_STARTS}]")
_IS_NEUTRALISED = re.compile(f"'+[{_STARTS}]")
NEEDS_QUOTES = re.compile('[",;\t\r\n]')
"""A spreadsheet of another country takes a semicolon or a tab for the end of a cell."""


def neutralised(text: str) -> str:
    """The text as a cell: no spreadsheet computes it, and `original` gives the text back."""
    return f"'{text}" if _IS_FORMULA.match(text) else text


def original(cell: str) -> str:
    """The text of a cell that `neutralised` may have written."""
    return cell[1:] if _IS_NEUTRALISED.match(cell) else cell


def quoted(text: str) -> str:
    """The text as it stands between two separators: in quotes where one is in it."""
    return '"{}"'.format(text.replace('"', '""')) if NEEDS_QUOTES.search(text) else text

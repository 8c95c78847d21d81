"""Texts in cells of CSV files that a spreadsheet does not take for formulas.

As the OWASP page on CSV injection recommends, an apostrophe goes before a text that begins with a
character that begins a formula.  Reading takes it away.
"""

import re

_STARTS = "=+\\-@\t\r\n＝＋－＠"
_IS_FORMULA = re.compile(f"'*[{_STARTS}]")
_IS_NEUTRALISED = re.compile(f"'+[{_STARTS}]")


def neutralised(text: str) -> str:
    """The text as a cell: no spreadsheet computes it, and `original` gives the text back."""
    return f"'{text}" if _IS_FORMULA.match(text) else text


def original(cell: str) -> str:
    """The text of a cell that `neutralised` may have written."""
    return cell[1:] if _IS_NEUTRALISED.match(cell) else cell

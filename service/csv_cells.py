"""Text cells of CSV files, written so that no spreadsheet reads them as formulas.

As the OWASP page on CSV injection recommends, an apostrophe precedes a text that begins with a
character that begins a formula.  Reading removes it.
"""

import re

_STARTS = "=+\\-@\t\r\n＝＋－＠"
_IS_FORMULA = re.compile(f"'*[{_STARTS}]")
_IS_NEUTRALISED = re.compile(f"'+[{_STARTS}]")
NEEDS_QUOTES = re.compile('[",;\t\r\n]')
"""Characters that need quotes; some locales' spreadsheets separate cells by semicolon or tab."""


def neutralised(text: str) -> str:
    """Convert a text to a cell that no spreadsheet computes; `original` reverses this."""
    return f"'{text}" if _IS_FORMULA.match(text) else text


def original(cell: str) -> str:
    """Convert a cell back to the text that `neutralised` may have changed."""
    return cell[1:] if _IS_NEUTRALISED.match(cell) else cell


def quoted(text: str) -> str:
    """Put a cell in quotes if it contains a separator, a quote or a line end."""
    return '"{}"'.format(text.replace('"', '""')) if NEEDS_QUOTES.search(text) else text

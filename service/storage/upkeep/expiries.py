"""What ends on a known day while the service runs: its table of leap seconds, and tokens."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache

import erfa
from msgspec import Struct
from sqlalchemy import Connection, select

from service.storage.sql.access_tables import access_tokens
from service.times import Utc, parse_utc, shifted, utc_now

log = logging.getLogger(__name__)

SOON_DAYS = 30
"""From here on the service warns when it starts; the alert rules begin at the same time."""
DAY_S = 86_400.0
_FIRST_YEAR, _LAST_YEAR = 2017, 2099


class Expiries(Struct, frozen=True):
    """When something ends: UTC texts.

    `leap_seconds` is the moment from which the table no longer vouches for the difference
    between TAI and UTC.  `token` is the name of the token in force that ends first and
    `token_ends` when; None where there are no tokens.
    """

    leap_seconds: str
    token: str | None = None
    token_ends: str | None = None


@cache
def leap_seconds_end() -> Utc:
    """The first year that ERFA calls dubious: more than five years after its table was made.

    The International Earth Rotation Service announces a leap second half a year ahead in its
    Bulletin C, so the table can be out of date earlier; a newer `pyerfa` brings the newest.
    """
    # The ufunc returns its status; the function of the same name prints a warning.
    dubious = 1
    for year in range(_FIRST_YEAR, _LAST_YEAR):
        if int(erfa.ufunc.dat(year, 1, 1, 0.0)[1]) == dubious:
            return parse_utc(f"{year}-01-01T00:00:00Z", "year")
    return parse_utc(f"{_LAST_YEAR}-01-01T00:00:00Z", "year")


class ExpiryDates:
    """Reads what ends when, and warns of what ends soon."""

    def __init__(
        self,
        reading: Callable[[], AbstractContextManager[Connection]],
        now: Callable[[], Utc] = utc_now,
    ) -> None:
        self._reading = reading
        self._now = now

    def dates(self) -> Expiries:
        """What ends when; of the tokens the first."""
        with self._reading() as connection:
            first = _first_token(connection, self._now().text)
        token, ends = first if first is not None else (None, None)
        return Expiries(leap_seconds_end().text, token, ends)

    def warn(self) -> list[str]:
        """Log a warning about each thing that ends within `SOON_DAYS`, or has ended."""
        found = self.dates()
        soon = shifted(self._now(), SOON_DAYS * DAY_S).text
        said = []
        if found.leap_seconds <= soon:
            said.append(
                f"the table of leap seconds is certain until {found.leap_seconds} only: "
                "install a newer pyerfa"
            )
        if found.token_ends is not None and found.token_ends <= soon:
            said.append(
                f"the token {found.token} expires at {found.token_ends}: "
                "create another and revoke this one"
            )
        for each in said:
            log.warning(each)
        return said


def _first_token(connection: Connection, moment: str) -> tuple[str, str] | None:
    """The name and the end of the token in force that ends first."""
    query = (
        select(access_tokens.c.name, access_tokens.c.expires)
        .where(access_tokens.c.revoked.is_(None), access_tokens.c.expires > moment)
        .order_by(access_tokens.c.expires, access_tokens.c.name)
        .limit(1)
    )
    row = connection.execute(query).first()
    return None if row is None else (row.name, row.expires)

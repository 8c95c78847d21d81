"""Expiry dates that a running service watches: of its table of leap seconds, and of tokens."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import erfa
from msgspec import Struct
from sqlalchemy import Connection, select

from service.storage.sql.tables import access_tokens
from service.times import LAST_YEAR, Utc, parse_utc, recorded_utc, shifted, utc_now

log = logging.getLogger(__name__)

SOON_DAYS = 30
"""Days before an expiry at which warnings and alert rules begin."""
DAY_S = 86_400.0
_FIRST_YEAR = 2017


class TokenTerm(Struct, frozen=True):
    """Access token in force, with its creation and expiry as UTC texts."""

    name: str
    created: str
    expires: str

    def ends_soon(self, now: Utc) -> bool:
        """True in the last `SOON_DAYS` of a token's term, or in its last quarter if shorter."""
        ends = recorded_utc(self.expires)
        quarter_s = (ends.tai_ns - recorded_utc(self.created).tai_ns) / 4e9
        return (ends.tai_ns - now.tai_ns) / 1e9 <= min(quarter_s, SOON_DAYS * DAY_S)


class Expiries(Struct, frozen=True):
    """Expiry dates of the table of leap seconds and of access tokens.

    `leap_seconds` is the UTC text of the moment from which the table no longer guarantees the
    difference between TAI and UTC. `tokens` are those in force, the first to expire first.
    """

    leap_seconds: str
    tokens: tuple[TokenTerm, ...] = ()


@cache
def leap_seconds_end() -> Utc:
    """Start of the first year that ERFA calls dubious, over five years after its leap-second table.

    The International Earth Rotation Service announces a leap second half a year ahead in its
    Bulletin C, so the table can be out of date earlier; a newer `pyerfa` brings the newest.
    """
    # The ufunc returns its status; the function of the same name prints a warning.
    dubious = 1
    for year in range(_FIRST_YEAR, LAST_YEAR):
        if int(erfa.ufunc.dat(year, 1, 1, 0.0)[1]) == dubious:
            return parse_utc(f"{year}-01-01T00:00:00Z", "year")
    return parse_utc(f"{LAST_YEAR}-01-01T00:00:00Z", "year")


@dataclass(frozen=True)
class ExpiryDates:
    """Reader of expiry dates: of the leap-second table and of tokens; it warns of near ones."""

    reading: Callable[[], AbstractContextManager[Connection]]
    now: Callable[[], Utc] = utc_now

    def dates(self) -> Expiries:
        """Current expiry dates of the table of leap seconds and of tokens in force."""
        c = access_tokens.c
        query = (
            select(c.name, c.created, c.expires)
            .where(c.revoked.is_(None), c.expires > self.now().text)
            .order_by(c.expires, c.name)
        )
        with self.reading() as connection:
            tokens = tuple(TokenTerm(*row) for row in connection.execute(query))
        return Expiries(leap_seconds_end().text, tokens)

    def warn(self) -> list[str]:
        """Log and return a warning for each expiry that is near or past."""
        found, now = self.dates(), self.now()
        soon = shifted(now, SOON_DAYS * DAY_S).text
        warnings = []
        if found.leap_seconds <= soon:
            warnings.append(
                f"the table of leap seconds is certain until {found.leap_seconds} only: "
                "install a newer pyerfa"
            )
        warnings += [
            f"the token {each.name} expires at {each.expires}: create another and revoke this one"
            for each in found.tokens
            if each.ends_soon(now)
        ]
        for each in warnings:
            log.warning(each)
        return warnings

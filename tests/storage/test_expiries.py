"""What ends on a known day is told before it does."""

import erfa
import pytest

from service.access import add_token, new_secret, revoke_token
from service.app.factory import open_app
from service.settings import Settings
from service.storage.upkeep.expiries import ExpiryDates, leap_seconds_end
from service.times import parse_utc
from service.web.requests.metrics import Metrics
from tests.fresh_databases import sqlite_at

NOW = "2027-01-01T00:00:00.000Z"


@pytest.fixture
def opened(tmp_path):
    app = open_app(Settings(database=sqlite_at(tmp_path / "a.db"), replay_processes=0))
    yield app
    app.close()


def token(app, name, expires):
    app.context.change(
        lambda connection: add_token(
            connection,
            id=f"01JD00000000000000000000{name[-2:]}",
            secret=new_secret(),
            name=name,
            scopes=("read",),
            spacecraft=None,
            rate_per_s=None,
            created="2026-01-01T00:00:00.000Z",
            expires=expires,
        )
    )


def warnings_at(app, moment):
    return ExpiryDates(app.context.reading, lambda: parse_utc(moment, "now")).warn()


def test_the_leap_seconds_are_certain_until_erfa_doubts_a_year():
    year = int(leap_seconds_end().text[:4])
    with pytest.warns(erfa.ErfaWarning, match="dubious year"):
        erfa.dat(year, 1, 1, 0.0)
    # A warning is an error here.
    erfa.dat(year - 1, 12, 31, 0.0)


def test_a_month_before_their_end_leap_seconds_are_warned_of(opened):
    end = leap_seconds_end().text
    year = int(end[:4])
    assert warnings_at(opened, f"{year - 1}-11-30T00:00:00Z") == []
    (said,) = warnings_at(opened, f"{year - 1}-12-05T00:00:00Z")
    assert end in said
    assert "pyerfa" in said


def test_a_token_for_a_month_is_warned_of_in_its_last_quarter(opened):
    """Not for its whole life, as one for a year in its last 30 days."""
    opened.context.change(
        lambda connection: add_token(
            connection,
            id="01JD0000000000000000000005",
            secret=new_secret(),
            name="month-05",
            scopes=("read",),
            spacecraft=None,
            rate_per_s=None,
            created="2026-12-01T00:00:00.000Z",
            expires="2026-12-31T00:00:00.000Z",
        )
    )
    assert warnings_at(opened, "2026-12-20T00:00:00Z") == []
    (said,) = warnings_at(opened, "2026-12-25T00:00:00Z")
    assert "month-05" in said


def test_the_first_token_that_ends_is_named_and_revoked_or_ended_ones_are_not(opened):
    token(opened, "ended-01", "2026-12-31T00:00:00.000Z")
    token(opened, "revoked-02", "2027-01-02T00:00:00.000Z")
    token(opened, "pipeline-03", "2027-01-20T00:00:00.000Z")
    token(opened, "later-04", "2027-01-25T00:00:00.000Z")
    opened.context.change(lambda connection: revoke_token(connection, "revoked-02", NOW))
    said, later = warnings_at(opened, NOW)
    assert "pipeline-03 expires at 2027-01-20" in said
    assert "later-04 expires at 2027-01-25" in later
    assert warnings_at(opened, "2026-12-01T12:00:00Z")[:1] == [
        "the token ended-01 expires at 2026-12-31T00:00:00.000Z: create another and revoke this one"
    ]


def test_the_metrics_tell_both_as_posix_times(opened):
    token(opened, "pipeline-03", "2098-01-01T00:00:00.000Z")
    token(opened, "another-04", "2097-01-01T00:00:00.000Z")
    text = Metrics(opened).text().decode()
    found = dict(
        line.split()
        for line in text.splitlines()
        if "_end_timestamp" in line[:70] and line[0] != "#"
    )
    year = int(leap_seconds_end().text[:4])
    days = (year - 1970) * 365.25
    assert float(found["starid_leap_seconds_end_timestamp_seconds"]) == pytest.approx(
        days * 86400, abs=86400
    )
    assert float(found['starid_token_end_timestamp_seconds{token="pipeline-03"}']) == 4039372800.0
    assert 'starid_token_end_timestamp_seconds{token="another-04"}' in found

"""The zones that the paper counts hold about as many stars and pairs in today's catalog."""

from tests.reference.zone_counts import counts


def test_stars_agree_within_eight_and_pairs_within_fifteen_percent(sky):
    found = list(counts(sky))
    assert len(found) == 12
    assert [(c.zone, c.quantity, f"{c.off:+.1%}") for c in found if not c.passed] == []

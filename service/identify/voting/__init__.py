"""The steps of Fink & Shoup's STARID: pair tests, match groups, votes."""

"""Everything that is kept, in SQL."""

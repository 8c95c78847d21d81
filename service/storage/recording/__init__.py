"""Recording of results with their stars, of events, and of the signed chain over the record."""

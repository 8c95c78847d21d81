"""Star identification: which catalog star each observed star is."""

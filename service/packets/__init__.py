"""CCSDS space packets, described by an XTCE file and mapped by a mission, read as batches."""

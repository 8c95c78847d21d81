"""Other star identification algorithms, implemented as published, to compare with.

They belong to the simulator and are not identifiers of the service: nothing is tuned beyond the
needs of a fair comparison.
"""

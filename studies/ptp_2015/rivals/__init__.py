"""Other ways to name stars without a prior, made as their authors describe them, to compare with.

They live beside the simulator and are no identifiers of the service: nothing is
tuned here beyond what a fair comparison asks for.
"""

"""Files of batches, in this process or through HTTP.

A run that was cut short is taken up by replaying it again: a batch that is
already recorded is answered with what is stored, and nothing is written twice.
"""

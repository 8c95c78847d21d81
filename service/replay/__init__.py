"""Replay of files of batches, in this process or through HTTP.

An interrupted replay is continued by repeating it: a batch that is already recorded gets its stored
answer, and nothing is written twice.
"""

"""Commands of `acquire`, one module each: `add` declares arguments and the function to run.

Every module in this package is a command; nothing else lists them.
"""

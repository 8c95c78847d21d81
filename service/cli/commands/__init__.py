"""The commands of `acquire`, a module each: `add` declares its arguments and the function it runs.

A new module here is a new command; nothing else names it.
"""

"""The synchronous client, made from `_async`: see `client/generate.py`.

Only `backend.py` is written by hand.
"""

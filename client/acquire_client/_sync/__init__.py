"""The synchronous client, made from `_async`: see `tests/client/sync_source.py`.

Only `backend.py` is written by hand.
"""

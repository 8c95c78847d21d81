"""The asynchronous client.  `_sync` is made from these modules: see `tests/client/sync_source.py`.

Only `backend.py` is written for each by hand.
"""

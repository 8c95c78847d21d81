"""The asynchronous client.  `_sync` is made from these modules: see `client/generate.py`.

Only `backend.py` is written for each by hand.
"""

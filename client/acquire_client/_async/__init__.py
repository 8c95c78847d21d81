"""The asynchronous client; `_sync` is generated from these modules, see `client/generate.py`.

Only `backend.py` is written by hand in both folders.
"""

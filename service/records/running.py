"""Submissions under way in this process: a repeat waits for the first."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from service.records.identity import Identity


class Running:
    """Who is at work on which identity."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._done: dict[Identity, threading.Event] = {}

    @contextmanager
    def turn(self, identity: Identity) -> Iterator[bool]:
        """True: the work is the caller's, until the block ends.

        False: another did it meanwhile, and it is over now, well or badly;
        who got False looks at what is recorded and asks again.
        """
        with self._lock:
            event = self._done.get(identity)
            mine = event is None
            if event is None:
                event = self._done[identity] = threading.Event()
        if not mine:
            event.wait()
            yield False
            return
        try:
            yield True
        finally:
            with self._lock:
                del self._done[identity]
            event.set()

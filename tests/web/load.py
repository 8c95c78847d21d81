"""Clients that send batch after batch to a server that is killed under them."""

import hashlib
import http.client
import json
import threading
import time
from collections import Counter, deque
from itertools import count, cycle

CLIENTS = 8


class Load:
    """Clients that send batch after batch, and each again until it is acknowledged.

    They speak through the standard library: a client that takes as long as the server would
    leave it half of the processors.
    """

    def __init__(self, ports, template):
        """Of several `ports` a client goes to the next where one refuses or is gone."""
        self.acknowledged = {}
        """The id and the digest of the answer under each name."""
        self.met, self._counting = Counter(), threading.Lock()
        self._ports, self._template = ports if isinstance(ports, tuple) else (ports,), template
        self._names = _Locked(f"batch-{number}" for number in count())
        self._again = deque()
        self._stopping, self._given_up = threading.Event(), threading.Event()
        self._faults = []
        self._threads = [threading.Thread(target=self._send) for _ in range(CLIENTS)]
        for thread in self._threads:
            thread.start()

    def stop(self):
        """Send what is still to be sent again, then nothing more."""
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        assert not self._faults, self._faults[0]

    def give_up(self):
        """Send nothing more."""
        self._given_up.set()

    def _count(self, met):
        with self._counting:
            self.met[met] += 1

    def _next(self):
        if self._given_up.is_set():
            return None
        try:
            return self._again.popleft()
        except IndexError:
            return None if self._stopping.is_set() else next(self._names)

    def _send(self):
        ports = cycle(self._ports)
        server = http.client.HTTPConnection("127.0.0.1", next(ports), timeout=30)
        while (name := self._next()) is not None:
            body = self._template.replace("NAME", name)
            headers = {"Content-Type": "application/json", "Idempotency-Key": name}
            try:
                server.request("POST", "/api/v1/batches", body, headers)
                answer = server.getresponse()
                content = answer.read()
            except (http.client.HTTPException, OSError):
                server.close()
                server.port = next(ports)
                self._count("broken off")
                self._again.append(name)
                # More often would keep the processor from the start that is waited for.
                time.sleep(0.1)
                continue
            self._count(answer.status)
            # 502 and 504 are a balancer's.
            if answer.status in (502, 503, 504):
                server.close()
                server.port = next(ports)
                self._again.append(name)
                time.sleep(0.1)
            elif answer.status in (200, 201):
                digest = hashlib.sha256(content).hexdigest()
                self.acknowledged[name] = (json.loads(content)["id"], digest)
            else:
                self._faults.append(content)
                break
        server.close()


class _Locked:
    """An iterator that several threads may draw from."""

    def __init__(self, inner):
        self._inner, self._lock = inner, threading.Lock()

    def __next__(self):
        with self._lock:
            return next(self._inner)

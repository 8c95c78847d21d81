"""A proxy that hands bytes on, and cuts its connections when it is told to."""

import socket
import threading
from contextlib import suppress


class CuttingProxy:
    """Listens on a port of its own and hands bytes on to another; a context manager.

    `cut` ends every connection at once, wherever in an answer it is.
    """

    def __init__(self, port):
        self._target = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open = set()
        self._lock = threading.Lock()
        self.port = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.cuts = 0

    def __enter__(self):
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_):
        # Only a shutdown wakes the thread that waits for the next connection.
        _shut(self._listener)
        self._listener.close()
        self.cut()

    def cut(self):
        """Cut every connection; how many there were."""
        with self._lock:
            found, self._open = self._open, set()
        for each in found:
            # The threads of the connection wake up, and close it.
            _shut(each)
        self.cuts += len(found) // 2
        return len(found) // 2

    def _accept(self):
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(("127.0.0.1", self._target), timeout=5)
                far.settimeout(None)
            except OSError:
                near.close()
                continue
            with self._lock:
                self._open |= {near, far}
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._hand_on, args=(source, sink), daemon=True).start()

    def _hand_on(self, source, sink):
        try:
            while piece := source.recv(1 << 14):
                sink.sendall(piece)
        except OSError:
            pass
        with self._lock:
            self._open -= {source, sink}
        for each in (source, sink):
            _shut(each)
            each.close()


def _shut(end):
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)

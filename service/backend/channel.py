"""What goes over the socket between front and backend: pickled objects, each with its length."""

import os
import pickle
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

_LENGTH = struct.Struct("<Q")
_NUMBER = struct.Struct("<Q")
PIECE_BYTES = 1 << 18


def packed(message: object) -> bytes:
    """A message as it goes over the socket."""
    body = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


class Unpacker:
    """Puts messages together from the pieces in which they arrive."""

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, piece: bytes | memoryview) -> Iterator[Any]:
        """The messages that a piece completes."""
        self._held += piece
        while len(self._held) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._held)[0]
            if len(self._held) < end:
                return
            with memoryview(self._held) as held:
                message = pickle.loads(held[_LENGTH.size : end])
            del self._held[:end]
            yield message


class Channel:
    """A socket that is written and read by threads that wait for it."""

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._unpacker = Unpacker()
        self._piece = memoryview(bytearray(PIECE_BYTES))
        self._sending = threading.Lock()
        self._receiving = threading.Lock()

    def send(self, message: object) -> None:
        """Send a message; from any thread."""
        data = packed(message)
        with self._sending:
            self._line.sendall(data)

    def receive(self) -> list[Any]:
        """The next messages, one at least; raises `EOFError` where the other side is gone."""
        with self._receiving:
            while not (messages := self._received(0)):
                pass
        return messages

    def arrived(self) -> list[Any]:
        """The messages that are there; none while another thread waits for some."""
        if not self._receiving.acquire(blocking=False):
            return []
        try:
            return self._received(socket.MSG_DONTWAIT)
        except (OSError, EOFError):
            # Nothing is there, or nobody any more: of that whoever receives is told.
            return []
        finally:
            self._receiving.release()

    def hang_up(self) -> None:
        """Receive no more: who waits for a message is told that there will be none."""
        self._line.shutdown(socket.SHUT_RD)

    def _received(self, flags: int) -> list[Any]:
        count = self._line.recv_into(self._piece, 0, flags)
        if not count:
            raise EOFError("the other side is gone")
        return list(self._unpacker.feed(self._piece[:count]))


@dataclass(frozen=True)
class Handed:
    """Stands in a message for a file, which is handed over beside it under a number."""

    number: int


class Files:
    """A socket that hands open files from one process to the other."""

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._lock = threading.Lock()
        self._arrived: dict[int, int] = {}
        self._sent = 0

    def hand(self, file: IO[bytes]) -> Handed:
        """Hand over a file, its place kept; it is closed here."""
        with file, self._lock:
            self._sent += 1
            number = self._sent
            socket.send_fds(self._line, [_NUMBER.pack(number)], [file.fileno()])
        return Handed(number)

    def take(self, handed: Handed) -> IO[bytes]:
        """The file that was handed over under a number."""
        with self._lock:
            while handed.number not in self._arrived:
                data, descriptors, _, _ = socket.recv_fds(self._line, _NUMBER.size, 1)
                if not data:
                    raise EOFError("the other side is gone")
                self._arrived[_NUMBER.unpack(data)[0]] = descriptors[0]
            return os.fdopen(self._arrived.pop(handed.number), "rb")

    def close(self) -> None:
        """Hand over no more."""
        self._line.close()

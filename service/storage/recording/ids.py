"""Identifiers of results and replays: ULIDs, 26 characters that sort by time."""

import hashlib
import os
import threading
import time

_ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"  # Crockford's: no I, L, O, U
_RANDOM_BITS = 80
_AT_ONCE = 64
"""Number of identifiers whose random bits are requested together: a system call is slow."""
LENGTH = 26
_SHIFTS = range(10 * (LENGTH // 2 - 1), -1, -10)
_PAIRS = [first + second for first in _ALPHABET for second in _ALPHABET]


class Ulids:
    """Generator of identifiers that increase strictly within a process and a millisecond."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0
        self._random = b""

    def new(self) -> str:
        """Generate the next identifier: 48 bits of Unix milliseconds and 80 random bits."""
        now = time.time_ns() // 1_000_000 << _RANDOM_BITS
        with self._lock:
            if not self._random:
                self._random = os.urandom(_AT_ONCE * _RANDOM_BITS // 8)
            fresh = now | int.from_bytes(self._random[: _RANDOM_BITS // 8], "big")
            self._random = self._random[_RANDOM_BITS // 8 :]
            # In the same millisecond, or after the clock was set back, count up from the last.
            self._last = (
                fresh if fresh >> _RANDOM_BITS > self._last >> _RANDOM_BITS else self._last + 1
            )
            value = self._last
        return _text_of(value)


def following_ulid(id: str) -> str:
    """Identifier (ULID) that directly follows another one in order."""
    value = 0
    for letter in id:
        value = value << 5 | _ALPHABET.index(letter)
    return _text_of(value + 1)


def _text_of(value: int) -> str:
    return "".join([_PAIRS[value >> shift & 1023] for shift in _SHIFTS])


def derived_ulid(id: str, *of: str) -> str:
    """Identifier (ULID) of the same millisecond as another one, derived from it and from texts."""
    digest = hashlib.sha256("\0".join((id, *of)).encode()).digest()
    value = int.from_bytes(digest[: _RANDOM_BITS // 8], "big")
    shifts = range(_RANDOM_BITS - 10, -1, -10)
    return id[: LENGTH - 2 * len(shifts)] + "".join([_PAIRS[value >> k & 1023] for k in shifts])


def unguessable_ulid() -> str:
    """Generate an identifier (ULID) that cannot be guessed from another one."""
    return Ulids().new()


def is_ulid(text: str) -> bool:
    """True if a text has the form of an identifier made by this module."""
    return len(text) == LENGTH and all(letter in _ALPHABET for letter in text)

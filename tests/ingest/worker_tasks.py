"""What tests have workers do: a module that a worker imports in no time."""

import multiprocessing.connection
import os
import signal
from pathlib import Path

from tests.waiting import wait_until


class Unreadable(Exception):
    """Of two arguments, of which the exception keeps one: it cannot be read from a pickle."""

    def __init__(self, one, other):
        super().__init__(one)


def double(solver, number):
    """Twice a number; of 13 it ends its process."""
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return [2 * number]


def unreadable(solver, number):
    """A number; of 13 a result that cannot be read."""
    return [Unreadable(1, 2) if number == 13 else number]


def half_sent(solver, number):
    """A result of a megabyte; of 13 the process dies when it has sent a half of it."""
    if number == 13:

        def send_half(connection, content):
            half = len(content) // 2 if len(content) > 1_000 else len(content)
            os.write(connection.fileno(), bytes(content[:half]))
            if half == len(content):
                return
            os.kill(os.getpid(), signal.SIGKILL)

        multiprocessing.connection.Connection._send = send_half
    return [bytes(1 << 20)]


def settings_once_there(solver, file):
    """The missions' settings that a worker has, as soon as there is a file."""
    wait_until(Path(file).exists, 600.0, why=file)
    return [each.digest for each in solver.missions.values()]

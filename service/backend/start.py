"""Starting the backend; nothing heavy is loaded here, so that it can be done first of all."""

import signal
import socket
import subprocess
import sys
from dataclasses import dataclass

from service.settings import Settings

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class Started:
    """A backend that is starting: its process, and the front's ends of its sockets."""

    settings: Settings
    process: "subprocess.Popen[bytes]"
    line: socket.socket
    files: socket.socket


def start_backend(settings: Settings) -> Started:
    """Start a backend, which waits to be told its settings."""
    line, its_line = socket.socketpair()
    files, its_files = socket.socketpair()
    numbers = (its_line.fileno(), its_files.fileno())
    command = [sys.executable, "-m", "service.backend", *map(str, numbers)]
    # It hears no signal until it says how it takes them.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        process = subprocess.Popen(command, pass_fds=numbers)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        its_line.close()
        its_files.close()
    return Started(settings, process, line, files)

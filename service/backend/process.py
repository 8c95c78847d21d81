"""The backend: a process that opens the operations and does what the front asks for."""

import ctypes
import gc
import logging
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from msgspec import structs

from service import logs
from service.backend.asked import Call, Close, Gave, Open, Opened, Refused, Takes, Told
from service.backend.channel import Channel, Files, Handed
from service.errors import AcquisitionError
from service.observe.wire import Checked
from service.operations import Operations
from service.records.draft import Answered
from service.records.intake import Asked, Recorded
from service.records.served import hold_served

THREADS = 72
"""Somewhat more than the front has handlers that may wait for one."""
TURN_S = 0.001
"""How long a thread keeps others waiting that want to go on."""
_DIE_WITH_PARENT = 1
"""Linux's PR_SET_PDEATHSIG."""

log = logging.getLogger(__name__)


def run(line: int, files: int) -> None:
    """Serve the front at the other end of two sockets, given by their numbers, until it closes."""
    _end_with_parent()
    gc.disable()
    sys.setswitchinterval(TURN_S)
    channel = Channel(socket.socket(fileno=line))
    try:
        first: Open = channel.receive()[0]
    except EOFError:
        return
    logs.configure(first.settings.logs, "backend")
    try:
        operations = Operations.open(first.settings, serving=True, expected=first.file)
    except AcquisitionError as error:
        channel.send(Refused(error))
        return
    try:
        # Held until this process ends.
        _held = hold_served(first.settings.database)
    except AcquisitionError as error:
        operations.close()
        channel.send(Refused(error))
        return
    file = operations.store.file
    identity = None if file is None else file.identity
    channel.send(Opened(operations.missions, operations.started, identity))
    Backend(operations, channel, Files(socket.socket(fileno=files))).serve()


def _end_with_parent() -> None:
    # Whoever stops the whole group stops the front, which ends this process in order.
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    if sys.platform == "linux":
        # Also where the front is killed: nothing may go on writing beside its successor.
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)


class Backend:
    """Operations that are asked over a channel."""

    def __init__(self, operations: Operations, channel: Channel, files: Files) -> None:
        self._operations = operations
        self._channel = channel
        self._files = files
        self._threads = ThreadPoolExecutor(THREADS, "call")
        self._lock = threading.Lock()
        self._telling = Told([], [], [], news=False)
        self._over = False

    def serve(self) -> None:
        """Do what is asked until the front says that it is over, or is gone."""
        self._operations.observers.append(self._note)
        self._operations.listen(self._tell_news)
        try:
            while not self._over:
                if batches := self._sorted(self._channel.receive()):
                    self._operations.take_all_here(batches, self._more)
        except (EOFError, OSError):
            if not self._over:
                # The front is gone, and with it everybody who waits for an answer.
                os._exit(1)
        self._operations.close()
        self._threads.shutdown()
        self._tell()

    def _more(self) -> list[Asked]:
        return self._sorted(self._channel.arrived())

    def _sorted(self, messages: Sequence[Any]) -> list[Asked]:
        """The batches among messages; what else is asked is begun."""
        batches: list[Asked] = []
        for message in messages:
            if isinstance(message, Takes):
                for number, sent, key, caller in message.batches:
                    known = sent if isinstance(sent, bytes) else Checked(*sent)
                    batches.append(Asked(known, key, partial(self._settle, number), caller))
            elif isinstance(message, Close):
                self._over = True
                # Another thread may have heard it than the one that waits for more.
                self._channel.hang_up()
            else:
                self._threads.submit(self._call, message)
        return batches

    def _note(self, recorded: Recorded) -> None:
        with self._lock:
            self._telling.recorded.append(structs.astuple(recorded))

    def _settle(self, number: int, outcome: Answered | Exception) -> None:
        if isinstance(outcome, Exception):
            failed = (number, _portable(outcome))
            with self._lock:
                self._telling.failed.append(failed)
        else:
            answered = (number, outcome.id, outcome.body, outcome.replayed)
            with self._lock:
                self._telling.answered.append(answered)

    def _tell_news(self) -> None:
        with self._lock:
            self._telling.news = True
        self._tell()

    def _tell(self) -> None:
        """Tell the front what there is to tell, all at once."""
        with self._lock:
            told, self._telling = self._telling, Told([], [], [], news=False)
        if told.recorded or told.answered or told.failed or told.news:
            self._channel.send(told)

    def _call(self, asked: Call) -> None:
        logs.request.set(asked.request)
        try:
            method = getattr(self._operations, asked.method)
            given = [self._opened(each) for each in asked.given]
            named = {name: self._opened(each) for name, each in asked.named.items()}
            gave = Gave(asked.number, method(*given, **named), None)
        except Exception as error:
            # The front answers for it, as it would for an error of its own.
            gave = Gave(asked.number, None, _portable(error))
        self._tell()
        try:
            self._channel.send(gave)
        except OSError:
            raise  # the front is gone
        except Exception as error:
            # It cannot be packed, and nothing of it was sent: nobody shall wait for it in vain.
            self._channel.send(Gave(asked.number, None, _portable(error)))

    def _opened(self, given: Any) -> Any:
        return self._files.take(given) if isinstance(given, Handed) else given


def _portable(error: Exception) -> Exception:
    """An error that the front can be told; what cannot be packed is logged here, and named."""
    if isinstance(error, AcquisitionError):
        return error
    log.error("a call failed", exc_info=error)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        # An error may hold anything.
        return RuntimeError(repr(error))
    return error

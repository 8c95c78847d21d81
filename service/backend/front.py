"""What stands for the operations where HTTP is served: it reads by itself, and asks for the rest.

To look into the records needs the database alone, and is done here.  What
computes or writes is asked of the backend, method by method.
"""

import asyncio
import gc
import itertools
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from functools import partial, wraps
from typing import Any

from service import logs
from service.backend.asked import (
    Call,
    Close,
    Gave,
    Open,
    Opened,
    Refused,
    Take,
    Takes,
    Told,
)
from service.backend.channel import Channel, Files, Unpacker, packed
from service.backend.start import Started, start_backend
from service.errors import AcquisitionError, BadConfiguration, Busy, Stopping
from service.observe.wire import checked_from_json
from service.operations import Operations
from service.records.access import Access
from service.records.draft import Answered
from service.records.identity import own_key
from service.records.intake import Observer, Recorded
from service.records.store import Readers
from service.records.tokens import Caller
from service.settings import is_loopback
from service.times import utc_now

ASKED = (
    "about",
    "acknowledge",
    "advise",
    "backlog",
    "cancel_replay",
    "change",
    "comment",
    "compare",
    "drop_zones",
    "overlay",
    "replay_processes",
    "set_limit",
    "shelve",
    "star_field",
    "start_replay_of",
    "submit_frame",
    "sweep",
    "unshelve",
    "warm_zones",
    "watch_run",
    "what_if",
    "zones",
)
"""The methods that are asked of the backend; `answered` is, too, in a way of its own."""

RESTART_S = 5
"""How long a backend may take until it is there again, for those who ask meanwhile."""

PAUSE_S, LONGEST_PAUSE_S = 1.0, 30.0
"""Before a backend is started again that could not open its database: twice as long each time."""

CHECKED_HERE_BYTES, CHECKED_HERE_OBJECTS = 4_096, 64
"""More than thirty stars; for what takes longer to check, right or wrong, everybody would wait."""

log = logging.getLogger(__name__)


def asked_of_backend(method: Callable[..., Any]) -> Callable[..., Any]:
    """The method as a call to the backend."""

    @wraps(method)
    def ask(self: "Front", *given: Any, **named: Any) -> Any:
        return self.ask(method.__name__, *given, **named)

    return ask


class Front(Operations):
    """Operations whose work another process does.

    That process is started again where it ends by itself: what it had been
    asked is answered with `Busy`, for nobody knows what became of it.
    """

    def __init__(self, started: Started) -> None:
        """Wait until a backend has opened its operations.

        Raises what keeps it from that, such as `BadConfiguration`.
        """
        opened = _handshake(started)
        self.settings = started.settings
        self.missions = dict(opened.missions)
        self.started = opened.started
        self.readers = Readers(started.settings.database, serving=True, expected=opened.file)
        self.access = Access(self.reading, self.change, is_loopback(self.settings.host), utc_now)
        self._observers: list[Observer] = []
        self._listeners: list[Callable[[], object]] = []
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[Answered] | Future[Any]] = {}
        self._takes: list[Take] = []
        self._backend = started
        self._files = Files(started.files)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._transport: asyncio.Transport | None = None
        self._closing = False
        self._getting_ready = 0

    # ---- the loop ------------------------------------------------------------------------------

    async def attach(self) -> None:
        """Go on from the event loop that asks from now on."""
        self._loop = asyncio.get_running_loop()
        await self._connect()
        # What is there by now stays: see `Operations.ready`.
        gc.freeze()
        gc.enable()

    async def _connect(self) -> None:
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_connection(
            lambda: _Line(self), sock=self._backend.line
        )

    async def answered(
        self, sent: bytes, idempotency_key: str | None = None, caller: Caller | None = None
    ) -> Answered:
        """What became of a batch; those that are asked for in one turn of the loop go together.

        What is wrong with its form is said here, and nobody else is troubled with it.
        """
        batch: bytes | tuple[str, str] = sent
        if _is_soon_checked(sent):
            checked = checked_from_json(sent)
            batch = checked.text, checked.fingerprint
        loop = asyncio.get_running_loop()
        number = next(self._numbers)
        done: asyncio.Future[Answered] = loop.create_future()
        self._waiting[number] = done
        if not self._takes:
            loop.call_soon(self._send_takes)
        key = own_key(caller, idempotency_key)
        # Who is bound to no spacecraft need not be known there.
        bound = caller if caller is not None and caller.spacecraft is not None else None
        self._takes.append((number, batch, key, bound))
        return await done

    def _send_takes(self) -> None:
        takes, self._takes = self._takes, []
        if self._transport is None:
            self._give_up([number for number, *_ in takes])
        else:
            self._transport.write(packed(Takes(takes)))

    def ask(self, method: str, *given: Any, **named: Any) -> Any:
        """Call a method of the backend's operations, from a thread that may wait."""
        assert self._loop is not None
        number = next(self._numbers)
        done: Future[Any] = Future()
        done.set_running_or_notify_cancel()
        call = Call(
            number,
            method,
            tuple(self._handed(each) for each in given),
            {name: self._handed(each) for name, each in named.items()},
            logs.request.get(),
        )
        self._loop.call_soon_threadsafe(self._send_call, number, packed(call), done)
        return done.result()

    def ready(self) -> None:
        """Return once the backend is warm; raises as it does."""
        self._getting_ready += 1
        try:
            self.ask("ready")
        finally:
            self._getting_ready -= 1

    def stop_warming(self) -> None:
        """End a backend that is getting ready and asked for nothing else: it may take minutes."""
        if self._getting_ready and self._getting_ready == len(self._waiting):
            self._closing = True
            self._backend.process.kill()

    def _send_call(self, number: int, call: bytes, done: "Future[Any]") -> None:
        self._waiting[number] = done
        if self._transport is None:
            self._give_up([number])
        else:
            self._transport.write(call)

    def _handed(self, given: Any) -> Any:
        if not hasattr(given, "fileno"):
            return given
        try:
            return self._files.hand(given)
        except OSError:
            raise _restarting() from None

    def hear(self, message: Any) -> None:
        """Pass on what the backend says."""
        if isinstance(message, Told):
            for observer in self._observers:
                for fields in message.recorded:
                    observer(Recorded(*fields))
            for number, id, body, replayed in message.answered:
                self._finish(number, None, Answered(id, body, replayed))
            for number, error in message.failed:
                self._finish(number, error, None)
            for listener in self._listeners:
                listener()
        elif isinstance(message, Gave):
            self._finish(message.number, message.error, message.value)

    def _finish(self, number: int, error: Exception | None, value: Any) -> None:
        done = self._waiting.pop(number, None)
        if done is None or done.done():
            return  # whoever asked has gone, or was told that the backend has
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(value)

    # ---- a backend that is gone ----------------------------------------------------------------

    def _give_up(self, numbers: "list[int]") -> None:
        error: Exception = Stopping("the service is stopping")
        if not self._closing:
            error = _restarting()
        for number in numbers:
            self._finish(number, error, None)

    def lost(self) -> None:
        """The backend is gone: tell everybody who waits, and start another."""
        self._transport = None
        if not self._closing:
            log.error("the process that works on batches has ended; it is started again")
            self._backend.process.kill()
            self._backend.process.wait()
            self._files.close()
            self._restart(PAUSE_S)
        self._give_up(list(self._waiting))

    def _restart(self, pause_s: float) -> None:
        """Start another backend; where it cannot be used, again after a pause, then a longer one.

        From the loop's thread, which lasts: a backend ends with the thread that starts it.
        """
        if not self._closing:
            started = start_backend(self.settings)
            go_on = partial(self._go_on, started, pause_s)
            threading.Thread(target=go_on, name="restart", daemon=True).start()

    def _go_on(self, started: Started, pause_s: float) -> None:
        """Go on with another backend, once it has opened its operations and is warm."""
        assert self._loop is not None
        try:
            _handshake(started, self.readers)
        except AcquisitionError as error:
            log.error("it could not be started, and is in %g s again: %s", pause_s, error)
            longer_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            self._loop.call_soon_threadsafe(self._loop.call_later, pause_s, self._restart, longer_s)
            return
        self._backend, self._files = started, Files(started.files)
        asyncio.run_coroutine_threadsafe(self._connect(), self._loop).result()
        # Whoever asks for it meanwhile warms it, or is told what is wrong.
        with suppress(AcquisitionError):
            self.ready()

    def close(self) -> None:
        """Let the backend finish what it has taken, and wait until it has ended."""
        self._closing = True
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._send_close)
        else:
            self._backend.line.close()
        self._backend.process.wait()
        self._files.close()
        self.readers.close()

    def _send_close(self) -> None:
        if self._transport is not None:
            self._transport.write(packed(Close()))

    # ---- what is held here ---------------------------------------------------------------------

    @property
    def observers(self) -> list[Observer]:
        """Called with every batch that is new, after its commit."""
        return self._observers

    def listen(self, listener: Callable[[], object]) -> None:
        """Have a function called whenever something was written."""
        self._listeners.append(listener)

    def unlisten(self, listener: Callable[[], object]) -> None:
        """Have it called no more."""
        self._listeners.remove(listener)


for _name in ASKED:
    setattr(Front, _name, asked_of_backend(getattr(Operations, _name)))


class _Line(asyncio.Protocol):
    """The front's end of the socket, in its event loop."""

    def __init__(self, front: Front) -> None:
        self._front = front
        self._unpacker = Unpacker()

    def data_received(self, data: bytes) -> None:
        for message in self._unpacker.feed(data):
            self._front.hear(message)

    def connection_lost(self, error: Exception | None) -> None:
        self._front.lost()


def _is_soon_checked(sent: bytes) -> bool:
    return len(sent) <= CHECKED_HERE_BYTES and sent.count(b"{") <= CHECKED_HERE_OBJECTS


def _restarting() -> Busy:
    return Busy("the process that works on batches is being started again", RESTART_S)


def _handshake(started: Started, readers: Readers | None = None) -> Opened:
    """What a backend says first; it must find the file that the readers have, if there are any."""
    expected = None if readers is None or readers.file is None else readers.file.identity
    channel = Channel(started.line)
    with ExitStack() as on_failure:
        on_failure.callback(started.files.close)
        on_failure.callback(started.line.close)
        on_failure.callback(started.process.wait)
        try:
            channel.send(Open(started.settings, expected))
            said = channel.receive()[0]
        except (EOFError, OSError):
            code = started.process.wait()
            message = f"the process that works on batches ended with code {code}; its log says why"
            raise BadConfiguration(message) from None
        if isinstance(said, Refused):
            raise said.error
        assert isinstance(said, Opened)
        on_failure.pop_all()
    return said

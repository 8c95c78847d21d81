"""Between front and backend: messages come whole, errors as they were, files open."""

import pickle
import socket
import tempfile
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service import errors
from service.backend.channel import Channel, Files, Unpacker, packed
from service.errors import AcquisitionError, BadBatch, Busy, Fault, TooOften


@given(
    st.lists(st.one_of(st.binary(max_size=50), st.text(max_size=9), st.integers()), max_size=8),
    st.lists(st.integers(1, 60), min_size=1, max_size=8),
)
def test_in_whatever_pieces_they_arrive_messages_come_whole_and_in_order(messages, sizes):
    stream = b"".join(packed(each) for each in messages)
    unpacker, found, k = Unpacker(), [], 0
    while stream:
        size = sizes[k % len(sizes)]
        found += unpacker.feed(stream[:size])
        stream, k = stream[size:], k + 1
    assert found == messages


def test_both_sides_may_talk_at_once_however_much_there_is_to_say():
    here, there = socket.socketpair()
    with here, there:
        big = b"x" * (3 << 20)
        speaking = threading.Thread(target=Channel(there).send, args=(big,))
        speaking.start()
        assert Channel(here).receive() == [big]
        speaking.join()


def test_who_waits_for_a_side_that_is_gone_is_told():
    here, there = socket.socketpair()
    with here:
        there.close()
        with pytest.raises(EOFError):
            Channel(here).receive()


def test_files_arrive_open_whichever_is_asked_for_first():
    here, there = socket.socketpair()
    with here, there:
        sending, taking = Files(here), Files(there)
        handed = []
        for text in (b"first", b"second"):
            file = tempfile.TemporaryFile()  # noqa: SIM115 - handing it over closes it
            file.write(b"passed over " + text)
            file.seek(len(b"passed over "))
            handed.append(sending.hand(file))
            assert file.closed
        for number, text in ((1, b"second"), (0, b"first")):
            with taking.take(handed[number]) as file:
                assert file.read() == text


def _errors(kind=AcquisitionError):
    return {kind}.union(*(_errors(each) for each in kind.__subclasses__()))


def test_every_error_arrives_as_it_was():
    fault = Fault("time", "must be UTC", "'soon'")
    made = [BadBatch([fault, fault]), Busy("wait", 7), TooOften("slower", 3)]
    kinds = [each for each in _errors() if each.__module__ == errors.__name__]
    made += [
        kind(fault) if issubclass(kind, errors.BadInput) else kind("so it is") for kind in kinds
    ]
    for error in made:
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert vars(again) == vars(error)


def test_what_is_there_is_taken_without_waiting_and_by_one_thread_at_a_time():
    here, there = socket.socketpair()
    with here, there:
        channel, other = Channel(here), Channel(there)
        assert channel.arrived() == []
        other.send("one")
        other.send("two")
        assert channel.arrived() == ["one", "two"]
        received = []
        waiting = threading.Thread(target=lambda: received.extend(channel.receive()))
        waiting.start()
        while not channel._receiving.locked():
            time.sleep(0.001)
        assert channel.arrived() == []
        other.send("three")
        waiting.join()
        assert received == ["three"]
        there.close()
        assert channel.arrived() == []


def test_who_waits_is_told_when_another_thread_hangs_up():
    here, there = socket.socketpair()
    with here, there:
        channel, told = Channel(here), []

        def wait():
            try:
                channel.receive()
            except EOFError:
                told.append("over")

        waiting = threading.Thread(target=wait)
        waiting.start()
        while not channel._receiving.locked():
            time.sleep(0.001)
        channel.hang_up()
        waiting.join(10)
        assert told == ["over"]
        # What is to be said can still be said.
        channel.send("goodbye")
        assert Channel(there).receive() == ["goodbye"]

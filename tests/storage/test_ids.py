"""Identifiers that sort by time."""

import time
from concurrent.futures import ThreadPoolExecutor

from service.storage.recording.ids import Ulids, is_ulid, unguessable_ulid


def test_they_rise_strictly_also_within_a_millisecond():
    ulids = Ulids()
    made = [ulids.new() for _ in range(10_000)]
    assert made == sorted(set(made))
    assert all(is_ulid(each) for each in made)


def test_they_begin_with_the_time_in_milliseconds():
    before, made, after = time.time_ns() // 1_000_000, Ulids().new(), time.time_ns() // 1_000_000
    alphabet = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
    read = 0
    for letter in made[:10]:
        read = read * 32 + alphabet.index(letter)
    assert before <= read <= after


def test_a_lone_one_is_not_found_by_counting_up_from_another(monkeypatch):
    """Also within a millisecond, where others of one maker are neighbours."""
    monkeypatch.setattr(time, "time_ns", lambda: 1_000_000_000)
    made = [unguessable_ulid() for _ in range(1_000)]
    assert all(is_ulid(each) for each in made)
    assert len({each[:20] for each in made}) == 1_000


def test_threads_never_get_the_same():
    ulids = Ulids()
    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(lambda _: ulids.new(), range(8_000)))
    assert len(set(made)) == 8_000


def test_they_rise_when_the_clock_is_set_back(monkeypatch):
    ulids = Ulids()
    first = ulids.new()
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    assert ulids.new() > first


def test_other_texts_are_told_apart():
    for text in ("", "0" * 25, "0" * 27, "O" * 26, "0" * 25 + "i", "é" * 26, "\0" * 26):
        assert not is_ulid(text)

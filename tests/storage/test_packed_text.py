"""Long texts are compressed on SQLite, and read as they were written."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import func, select

from service.storage.sql.columns import pack, unpack
from service.storage.sql.tables import batches, results


@given(st.text())
def test_a_text_comes_back_as_it_was_and_one_that_was_never_packed_stays(text):
    assert unpack(pack(text)) == text
    assert unpack(text) == text


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_answers_and_batches_take_less_than_half_of_their_text(app, make):
    answer = app.submissions.submit(make("b1"))
    with app.store.reading_record() as connection:
        for column in (results.c.answer, batches.c.input):
            text = connection.scalar(select(column))
            packed = connection.scalar(select(func.length(column)))
            assert int(packed) < len(text) / 2, column
            assert connection.scalar(select(func.typeof(column))) == "blob"
        assert connection.scalar(select(results.c.answer)).encode() == answer.body


def test_whatever_is_done_to_a_packed_text_it_is_another_text_and_no_error(seed):
    rng = random.Random(seed)
    text = '{"spacecraft":"XTE","status":"good"}' * 5
    packed = pack(text)
    for _ in range(2_000):
        damaged = bytearray(packed)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        assert isinstance(unpack(bytes(damaged[: rng.randrange(len(damaged)) or None])), str)

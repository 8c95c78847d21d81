"""The synchronous client is made from the asynchronous one."""

import pytest

from tests.client.sync_source import BY_HAND, sources, synchronous, target


@pytest.mark.parametrize("source", sources(), ids=lambda path: path.name)
def test_a_module_is_as_it_is_made(source):
    """Where this fails: python -m tests.client.sync_source"""
    assert target(source).read_text(encoding="utf-8") == synchronous(source)


def test_no_module_is_left_over():
    made = {path.name for path in target(sources()[0]).parent.glob("*.py")}
    assert made == {path.name for path in sources()} | set(BY_HAND)

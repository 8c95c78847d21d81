"""A wrong address of NATS is refused, and its password is not shown."""

import pytest

from service.features.follow.source import server_and_stream


@pytest.mark.parametrize(
    "address",
    [
        "nats://user:secret@bus",
        "http://user:secret@bus/S",
        "nats://user:secret/x@bus",
        "nats://user:secret@[bus/S",
        "nats://user:secret@bus:secret/S",
    ],
)
def test_a_wrong_source_is_refused_without_its_password(acquire, address):
    code, _, complaint = acquire("follow", address, "--consumer", "acquire")
    assert code == 2
    assert "SOURCE: must be nats://HOST/STREAM or" in complaint
    assert "secret" not in complaint
    with pytest.raises(ValueError, match="must be") as refused:
        server_and_stream(address)
    assert "secret" not in str(refused.value)


def test_a_source_is_not_shown_where_the_package_is_absent(acquire, monkeypatch):
    monkeypatch.setattr("service.extras.find_spec", lambda package: None)
    code, _, complaint = acquire("follow", "nats://user:secret@bus/S", "--consumer", "acquire")
    assert code == 2
    assert "secret" not in complaint

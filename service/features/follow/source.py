"""Configuration of a follower: NATS stream, consumer, and subjects to publish to."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

SCHEMES = ("nats", "tls")
EXPECTED = "must be nats://HOST/STREAM or tls://HOST/STREAM"


@dataclass(frozen=True)
class Source:
    """NATS stream, consumer and subjects that a follower uses."""

    servers: str
    stream: str
    consumer: str
    refusals: str
    """Subject for refused messages, published with the problem."""
    answers: str | None = None
    """Subject for answers; None: answers are not published."""
    credentials: Path | None = None
    authority: Path | None = None
    """CA certificate (PEM) to verify the NATS server.

    None: the certificates of the system.
    """
    concurrency: int = 16
    """Greatest number of messages processed at the same time."""

    @property
    def shown(self) -> str:
        """Address of the NATS server without a password, for messages."""
        scheme, _, place = self.servers.partition("://")
        return f"{scheme}://{place.rpartition('@')[2]}"


def server_and_stream(text: str) -> tuple[str, str]:
    """Split nats://HOST/STREAM into server and stream; raises ValueError."""
    try:
        parts = urlsplit(text)
        _ = parts.port
    except ValueError:
        # The message of Python would show a part of the address, which may be a password.
        raise ValueError(EXPECTED) from None
    stream = parts.path.strip("/")
    if parts.scheme not in SCHEMES or not parts.hostname or not stream or "/" in stream:
        raise ValueError(EXPECTED)
    return f"{parts.scheme}://{parts.netloc}", stream


def refusals_of(stream: str) -> str:
    """Default subject for refused messages of a stream."""
    return f"acquire.refused.{stream}"

"""Source of a follower: a stream of NATS, its consumer, and the subjects to publish to."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

SCHEMES = ("nats", "tls")
EXPECTED = "must be nats://HOST/STREAM or tls://HOST/STREAM"


@dataclass(frozen=True)
class Source:
    """The stream, consumer and subjects that a follower uses."""

    servers: str
    stream: str
    consumer: str
    refusals: str
    """The subject that refused messages go to, with the problem."""
    answers: str | None = None
    """The subject that answers are published to; None: to none."""
    credentials: Path | None = None
    authority: Path | None = None
    """CA certificate (PEM) that the NATS server's certificate is checked with.

    None: those of the system.
    """
    concurrency: int = 16
    """Messages that are at work together."""

    @property
    def shown(self) -> str:
        """The address of NATS for messages, without a password."""
        scheme, _, place = self.servers.partition("://")
        return f"{scheme}://{place.rpartition('@')[2]}"


def server_and_stream(text: str) -> tuple[str, str]:
    """The two parts of nats://HOST/STREAM; raises ValueError."""
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
    """The subject that refused messages of a stream go to where no other is named."""
    return f"acquire.refused.{stream}"

"""Settings of the process from environment variables, and a check that its port is free."""

import errno
import ipaddress
import os
import re
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

from service.errors import BadConfiguration, shown_value
from service.logs import FORMATS, LEVELS, LogSettings

PREFIX = "ACQUIRE_"
LOCAL_MISSIONS = Path("missions")
MOST_USEFUL_PROCESSES = 4
"""Largest useful number of worker processes: the single writing process records no faster."""
_TOKEN = re.compile(r"[!-~]+")
_ROOT_PATH = re.compile(r"(/[A-Za-z0-9._~-]+)*", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9.:_-]{1,253}", re.ASCII)


@dataclass(frozen=True)
class Settings:
    """Settings for operators; each field is the environment variable ACQUIRE_<FIELD>.

    `database` is a SQLAlchemy URL.  `missions` is a folder with a site's own
    mission files, beside `./missions`; `shipped_missions` off hides XTE, SWAS, SOHO and IMAGER.
    `catalog` is a site's own star catalog; None takes the shipped one.  `shelf_mb` bounds
    the cache of zones and run catalogs.  `host`
    other than loopback is served once there are tokens.  `token` is what
    commands show that talk to a running service.  `frame_mb` and `frame_megapixels`
    bound a frame's file and what it unfolds into.  `replay_processes` is how
    many processes beside this one compute replays; 0: this one does.  A replay
    ends after `replay_seconds`, wherever it is.  `spool` is the folder of uploaded
    telemetry files whose replays are not over.  `log_format` and `log_level` are
    of `service.logs`.
    `probe_port` is a second port that answers probes alone.  One client address
    may have `connections_per_address` at a time, and one that asks for nothing is closed
    after `keep_alive_seconds`; addresses and networks in
    `trusted_proxies` may have more, and the service believes what they say about
    the clients behind them (X-Forwarded-For, X-Forwarded-Proto).  `root_path` is the path
    below which a proxy serves the service, such as /acquire.  Webhooks reach
    public addresses, and the networks in `webhook_networks`, these by http too.
    `archive_folder` is the folder of `acquire archive`, where archived batches are read.
    `follow` is a stream of NATS that the service follows, as `acquire follow` does: with the
    durable consumer `follow_consumer`, answers to the subject `follow_answers`, the file of
    credentials, and the CA certificate (PEM) that the NATS server's certificate is checked with.
    `features_off` are the features (`service.feature`) that the service leaves out.
    `record_key` signs the heads of the record: a file with a private key of Ed25519, or its PEM.
    """

    database: str = "sqlite:///acquire.db"
    missions: Path | None = None
    shipped_missions: str = "on"
    catalog: Path | None = None
    shelf_mb: int = 256
    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = None
    frame_mb: int = 64
    frame_megapixels: int = 20
    replay_processes: int = min(os.cpu_count() or 1, MOST_USEFUL_PROCESSES)
    replay_seconds: int = 6 * 3600
    log_format: str = "text"
    log_level: str = "info"
    spool: Path | None = None
    probe_port: int | None = None
    connections_per_address: int = 256
    keep_alive_seconds: int = 75
    trusted_proxies: str = "127.0.0.1,::1"
    root_path: str = ""
    webhook_networks: str = ""
    archive_folder: Path | None = None
    follow: str | None = None
    follow_consumer: str = "acquire"
    follow_answers: str | None = None
    follow_credentials: Path | None = None
    follow_authority: Path | None = None
    features_off: str = ""
    record_key: str | None = None
    mission_file: Path | None = field(default=None, metadata={"is_option": True})
    """Mission file given to a command in place of a spacecraft's name; not a variable."""

    def __post_init__(self) -> None:
        if not self.database.strip():
            raise _refusal("database", "must be a URL such as sqlite:///acquire.db", self.database)
        if not 1 <= self.shelf_mb <= 1_000_000:
            raise _refusal("shelf_mb", "must be from 1 to 1000000", self.shelf_mb)
        for name, most in (("frame_mb", 2048), ("frame_megapixels", 400)):
            if not 1 <= getattr(self, name) <= most:
                raise _refusal(name, f"must be from 1 to {most}", getattr(self, name))
        if not 0 <= self.replay_processes <= 64:
            raise _refusal("replay_processes", "must be from 0 to 64", self.replay_processes)
        if not 1 <= self.replay_seconds <= 30 * 86_400:
            raise _refusal("replay_seconds", "must be from 1 to 2592000", self.replay_seconds)
        for name, known in (("log_format", FORMATS), ("log_level", LEVELS)):
            if getattr(self, name) not in known:
                raise _refusal(name, f"must be {' or '.join(known)}", getattr(self, name))
        if self.shipped_missions not in ("on", "off"):
            raise _refusal("shipped_missions", "must be on or off", self.shipped_missions)
        if not 0 <= self.port <= 65535:
            raise _refusal("port", "must be from 0 to 65535", self.port)
        if self.probe_port is not None and not 1 <= self.probe_port <= 65535:
            raise _refusal("probe_port", "must be from 1 to 65535", self.probe_port)
        if self.probe_port is not None and self.probe_port == self.port:
            raise _refusal("probe_port", "must be another port than ACQUIRE_PORT", self.probe_port)
        if not 1 <= self.connections_per_address <= 65535:
            raise _refusal(
                "connections_per_address", "must be from 1 to 65535", self.connections_per_address
            )
        if not 1 <= self.keep_alive_seconds <= 3600:
            raise _refusal("keep_alive_seconds", "must be from 1 to 3600", self.keep_alive_seconds)
        for name in ("trusted_proxies", "webhook_networks"):
            try:
                networks(getattr(self, name))
            except ValueError:
                message = "must be addresses or networks, such as 127.0.0.1,10.0.0.0/8"
                raise _refusal(name, message, getattr(self, name)) from None
        if self.token is not None and not _TOKEN.fullmatch(self.token.strip()):
            # The value is a secret.
            raise BadConfiguration(
                f"{PREFIX}TOKEN: must be printable ASCII characters without a space"
            )
        if not _ROOT_PATH.fullmatch(self.root_path):
            message = "must be a path without a slash at its end, such as /acquire"
            raise _refusal("root_path", message, self.root_path)
        if not _HOST.fullmatch(self.host):
            raise _refusal("host", "must be an address or a name, such as 127.0.0.1", self.host)

    @property
    def mission_places(self) -> tuple[Path, ...]:
        """Folders and files with a site's own missions, in the order of the search.

        They are `./missions`, if there is such a folder, then ACQUIRE_MISSIONS; a file given to a
        command comes last, and replaces a mission of the same name.
        """
        here = (LOCAL_MISSIONS,) if LOCAL_MISSIONS.is_dir() else ()
        return (*here, *filter(None, (self.missions, self.mission_file)))

    @property
    def ships_missions(self) -> bool:
        """True if the missions that are shipped with the service are available."""
        return self.shipped_missions == "on"

    @property
    def mission_places_text(self) -> str:
        """Description of the places that are searched for missions."""
        own = "not set" if self.missions is None else str(self.missions)
        shipped = "the shipped missions" if self.ships_missions else "no shipped missions"
        return f"./{LOCAL_MISSIONS}/*.toml, ACQUIRE_MISSIONS ({own}), {shipped}"

    @property
    def spool_folder(self) -> Path:
        """Folder of uploads: `spool`, else beside SQLite's file or in the working folder."""
        if self.spool is not None:
            return self.spool
        scheme, _, file = self.database.partition(":///")
        return Path(f"{file}.spool" if scheme == "sqlite" else "acquire-spool")

    @property
    def logs(self) -> LogSettings:
        """Log settings of the service's processes."""
        return LogSettings(self.log_format, self.log_level)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> "Settings":
        """Read the settings from the ACQUIRE_ variables; an empty one counts as not set.

        Raises `BadConfiguration` for an invalid value, and for an unknown name: a misspelt
        ACQUIRE_DATABASE must not silently record elsewhere.
        """
        known = {PREFIX + each.name.upper(): each.name for each in fields(cls) if not each.metadata}
        values = {
            name: text for name, text in environment.items() if name.startswith(PREFIX) and text
        }
        for name in values:
            if name not in known:
                raise BadConfiguration(f"{name}: no such setting; there are {', '.join(known)}")
        return cls(**{known[name]: _read(known[name], text) for name, text in values.items()})


_READERS: dict[str, Callable[[str], Any]] = {
    "token": str.strip,
    "missions": Path,
    "catalog": Path,
    "spool": Path,
    "archive_folder": Path,
    "follow_credentials": Path,
    "follow_authority": Path,
    "shelf_mb": int,
    "frame_mb": int,
    "frame_megapixels": int,
    "port": int,
    "probe_port": int,
    "connections_per_address": int,
    "keep_alive_seconds": int,
    "replay_processes": int,
    "replay_seconds": int,
}


def _read(field: str, text: str) -> Any:
    try:
        return _READERS.get(field, str)(text)
    except ValueError:
        raise _refusal(field, "must be a whole number", text) from None


def _refusal(field: str, message: str, value: object) -> BadConfiguration:
    return BadConfiguration(f"{PREFIX}{field.upper()}: {message} (got {shown_value(value)})")


Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def networks(text: str) -> tuple[Network, ...]:
    """The networks in a list such as "127.0.0.1,10.0.0.0/8"; raises ValueError."""
    return tuple(ipaddress.ip_network(each.strip()) for each in text.split(",") if each.strip())


@lru_cache(maxsize=256)
def is_loopback(host: str) -> bool:
    """True if a host name or address is this machine's own, without asking a name server."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


_REMEDIES = {
    errno.EADDRINUSE: "stop what serves there, or choose another port with --port or ACQUIRE_PORT "
    "(make run PORT=8100)",
    errno.EADDRNOTAVAIL: "choose an address of this machine with --host or ACQUIRE_HOST",
    errno.EACCES: "choose a port above 1023 with --port or ACQUIRE_PORT",
}


def url_of(host: str, port: int) -> str:
    """URL of a service on a host and a port."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def require_free(host: str, port: int) -> None:
    """Raise `BadConfiguration`, with the remedy, if a port cannot be served on."""
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in places:
            with socket.socket(family, kind, protocol) as probe:
                # The server sets the same option: a recently released port is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                probe.bind(address)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "choose another with --host and --port")
        reason = error.strerror or str(error)
        raise BadConfiguration(f"{url_of(host, port)}: {reason}; {remedy}") from None

"""Limits of the connections that are kept: a bound for all, a share for each client address.

A connection is idle while no request of it is being answered.  Where a bound is
reached, the connection that has been idle for the longest time is closed, so that
a client that holds many open connections cannot keep others out.
"""

import ipaddress
from collections import OrderedDict
from collections.abc import Iterable
from functools import lru_cache
from typing import Protocol

from service.settings import Network, is_loopback

RESERVED_FOR_LOOPBACK = 16
"""Connections that only clients on this machine may take, such as an operator's probes."""
IPV6_SITE_BITS = 64
"""One IPv6 client usually has all addresses of such a network to itself."""


class Closable(Protocol):
    """A connection that can be closed at once."""

    def abort(self) -> None:
        """Close the connection, whatever is still to be sent."""


class Client:
    """The connections of one client address."""

    def __init__(self, origin: str, local: bool, shared: bool) -> None:
        self.origin = origin
        self.is_local = local
        self.has_share = shared
        self.count = 0
        self.idle: OrderedDict[Closable, None] = OrderedDict()


class Admission:
    """Counts connections and closes idle ones where a bound is reached."""

    def __init__(
        self,
        most: int,
        per_address: int | None = None,
        trusted: Iterable[Network] = (),
        reserved: int = RESERVED_FOR_LOOPBACK,
    ) -> None:
        """Allow at most `most` connections, and `per_address` of a client that is not `trusted`.

        The last `reserved` connections are for loopback addresses.
        """
        self._most = most
        self._per_address = most if per_address is None else per_address
        self._trusted = tuple(trusted)
        self._reserved = min(reserved, most // 2)
        self._clients: dict[str, Client] = {}
        self._admitted: dict[Closable, Client] = {}
        self._idle: OrderedDict[Closable, None] = OrderedDict()
        self._remote_count = 0
        self._remote_idle: OrderedDict[Closable, None] = OrderedDict()

    def admit(self, connection: Closable, host: str) -> bool:
        """Take a new connection from a client's address; it is idle.

        False where a bound is reached and no connection under that bound is idle.
        """
        client = self._client(host)
        if client.has_share and client.count >= self._per_address:
            is_free = self._close_oldest(client.idle)
        elif not client.is_local and self._remote_count >= self._most - self._reserved:
            is_free = self._close_oldest(self._remote_idle)
        elif len(self._admitted) >= self._most:
            is_free = self._close_oldest(self._idle)
        else:
            is_free = True
        if not is_free:
            return False
        self._clients[client.origin] = client
        client.count += 1
        self._remote_count += not client.is_local
        self._admitted[connection] = client
        self.set_idle(connection)
        return True

    def set_idle(self, connection: Closable) -> None:
        """No request of the connection is being answered from now on."""
        for idle in self._idle_lists(self._admitted.get(connection)):
            idle[connection] = None

    def set_busy(self, connection: Closable) -> None:
        """A request of the connection is being answered from now on."""
        for idle in self._idle_lists(self._admitted.get(connection)):
            idle.pop(connection, None)

    def remove(self, connection: Closable) -> None:
        """The connection is closed."""
        client = self._admitted.get(connection)
        if client is None:
            return
        self.set_busy(connection)
        del self._admitted[connection]
        client.count -= 1
        self._remote_count -= not client.is_local
        if not client.count:
            del self._clients[client.origin]

    def _idle_lists(self, client: Client | None) -> tuple[OrderedDict[Closable, None], ...]:
        if client is None:
            return ()
        if client.is_local:
            return client.idle, self._idle
        return client.idle, self._idle, self._remote_idle

    def _close_oldest(self, idle: OrderedDict[Closable, None]) -> bool:
        """Make room; False where none of these connections is idle."""
        if not idle:
            return False
        connection = next(iter(idle))
        # Removed first: the event loop reports the end of the connection only later.
        self.remove(connection)
        connection.abort()
        return True

    def _client(self, host: str) -> Client:
        origin = _origin(host)
        known = self._clients.get(origin)
        if known is not None:
            return known
        return Client(origin, is_loopback(origin), not self._is_trusted(host))

    def _is_trusted(self, host: str) -> bool:
        address = _address(host)
        return address is not None and any(address in network for network in self._trusted)


@lru_cache(maxsize=4096)
def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


@lru_cache(maxsize=4096)
def _origin(host: str) -> str:
    """The key of one client: an IPv4 address, or a /64 network of IPv6."""
    address = _address(host)
    if address is None:
        return host
    if address.version == 4 or address.is_loopback or address.is_link_local:
        return str(address)
    return str(ipaddress.IPv6Network((int(address), IPV6_SITE_BITS), strict=False))

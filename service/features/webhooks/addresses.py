"""Check of webhook addresses: public ones, and private networks allowed by a setting.

The host name is resolved once per attempt, every address is checked, and the connection is made to
a checked address: a DNS answer that changes between two look-ups has no effect.
"""

import asyncio
import ipaddress
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress

from service.errors import BadInput, Fault, shown_value
from service.settings import Network, networks

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

METADATA = frozenset(
    ipaddress.ip_address(each)
    for each in ("169.254.169.254", "fd00:ec2::254", "100.100.100.200", "168.63.129.16")
)
"""Addresses of cloud metadata services, which reveal secrets; no setting allows them."""
NAT64 = networks("64:ff9b::/96")
UNICAST_IPV6 = networks("2000::/3")
"""Network from which IANA assigns public IPv6 addresses; `NAT64` stands for IPv4."""
NOT_PUBLIC = networks(
    # IANA's registry of IPv4 special-purpose addresses, as of October 2025.
    "0.0.0.0/8, 10.0.0.0/8, 100.64.0.0/10, 127.0.0.0/8, 169.254.0.0/16, 172.16.0.0/12,"
    "192.0.0.0/24, 192.0.2.0/24, 192.88.99.0/24, 192.168.0.0/16, 198.18.0.0/15, 198.51.100.0/24,"
    "203.0.113.0/24, 240.0.0.0/4,"
    # IANA's registry of IPv6 special-purpose addresses, as of October 2025.
    "::/128, ::1/128, ::ffff:0:0/96, 64:ff9b:1::/48, 100::/64, 100:0:0:1::/64, 2001::/23,"
    "2001:db8::/32, 3fff::/20, 5f00::/16, fc00::/7, fe80::/10,"
    # Multicast; IPv4-compatible, IPv4-translated (RFC 2765) and site-local addresses.
    "224.0.0.0/4, ff00::/8, ::/96, ::ffff:0:0:0/96, fec0::/10"
)
"""Networks that are not public, independent of the table in this version of Python.

The registries list some addresses of 192.0.0.0/24 and 2001::/23 as reachable: relays and
translators, which receive no webhooks.
"""
NO_WEB_PORTS = frozenset(
    (1719, 1720, 1723, 2049, 3659, 4045, 4190, 5060, 5061, 6000, 6566, 6679, 6697, 10080)
) | frozenset(range(6665, 6670))
"""Ports above 1023 that browsers block as well (WHATWG Fetch, "bad port")."""
MAX_URL = 2_000
RESOLVE_S = 3.0
"""Time limit in seconds for resolving a host name when a webhook is registered."""
MAX_LOOK_UPS = 64
"""Greatest number of parallel DNS look-ups; a silent name server may block each for 30 s."""


class Refused(Exception):
    """Raised for an address that webhooks must not reach, before any connection."""


def require_url(url: str, allowed: Sequence[Network]) -> None:
    """Raise `BadInput` for a URL that webhooks must not be sent to, whatever its name resolves to.

    An address in the URL is checked here; a host name is checked with each attempt.
    """

    def fault(message: str) -> BadInput:
        # A URL may hold what only the receiver should know: the host alone is shown.
        return BadInput(Fault("url", message, shown_value(url[:40])))

    import httpx

    if len(url) > MAX_URL:
        raise BadInput(Fault("url", f"may have at most {MAX_URL} characters"))
    try:
        parsed = httpx.URL(url)
        # Decoded: raises for a name that no name server can have.
        host = parsed.host
    except (httpx.InvalidURL, ValueError) as error:
        raise fault(f"is no URL: {error}") from None
    schemes = ("https", "http") if allowed else ("https",)
    if parsed.scheme not in schemes:
        raise fault(
            "must begin with https://"
            if parsed.scheme != "http"
            else "must begin with https://; http is for networks in ACQUIRE_WEBHOOK_NETWORKS"
        )
    if not host:
        raise fault("must name a host")
    if parsed.userinfo:
        raise BadInput(Fault("url", "must not hold a user name or a password"))
    if parsed.fragment:
        raise fault("must not have a fragment (#)")
    port = parsed.port
    if port is not None and port not in (80, 443) and not _is_web_port(port):
        raise fault("must have port 80, 443, or one from 1024 on that is for the web")
    if (address := _literal(host)) is not None:
        try:
            require_reachable(address, allowed, only_allowed=parsed.scheme == "http")
        except Refused as error:
            raise fault(str(error)) from None


def require_http_allowed(url: str, allowed: Sequence[Network]) -> None:
    """Raise `BadInput` for plain http to a host name that resolves outside of allowed networks.

    Every attempt would be refused.  A name that cannot be resolved now is accepted.
    """
    import httpx

    parsed = httpx.URL(url)
    if parsed.scheme != "http":
        return

    async def resolve() -> None:
        async with asyncio.timeout(RESOLVE_S):
            await reachable_addresses(parsed.host, parsed.port or 80, allowed, only_allowed=True)

    with suppress(OSError):
        try:
            asyncio.run(resolve())
        except Refused as error:
            raise BadInput(Fault("url", str(error), shown_value(parsed.host))) from None


def require_reachable(
    address: Address, allowed: Sequence[Network], *, only_allowed: bool = False
) -> None:
    """Raise `Refused` for an address that is neither public nor in an allowed network.

    With `only_allowed` it must be in an allowed network.  An address that embeds another one, as
    IPv4-mapped and 6to4 addresses do, is refused if either must be.
    """
    if isinstance(address, ipaddress.IPv6Address):
        # Without the name of an interface (%eth0): with one it equals no other address.
        address = ipaddress.IPv6Address(int(address))
    for each in (address, *_embedded(address)):
        if each in METADATA:
            raise Refused(f"{address} tells a machine its own secrets, and is never allowed")
        if _is_in(each, allowed):
            continue
        if only_allowed:
            raise Refused(f"{address} is not in ACQUIRE_WEBHOOK_NETWORKS, as plain http requires")
        if not _is_public(each):
            raise Refused(f"{address} is not a public address, and no allowed network has it")


async def reachable_addresses(
    host: str, port: int, allowed: Sequence[Network], *, only_allowed: bool = False
) -> list[str]:
    """Checked addresses of a host; resolves a name once.

    Raises `Refused` if one of them must not be reached, OSError for an unknown name.
    """
    literal = _literal(host)
    found = [str(literal)] if literal is not None else await _look_up(host, port)
    for each in found:
        require_reachable(ipaddress.ip_address(each), allowed, only_allowed=only_allowed)
    return found[:8]


def _is_web_port(port: int) -> bool:
    return 1024 <= port <= 65535 and port not in NO_WEB_PORTS


def _literal(host: str) -> Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_in(address: Address, among: Sequence[Network]) -> bool:
    return any(address in network for network in among)


def _is_public(address: Address) -> bool:
    if isinstance(address, ipaddress.IPv6Address) and not _is_in(address, UNICAST_IPV6 + NAT64):
        return False
    return not _is_in(address, NOT_PUBLIC)


def _embedded(address: Address) -> Iterator[Address]:
    """IPv4 addresses that are embedded in an IPv6 address."""
    if isinstance(address, ipaddress.IPv4Address):
        return
    if address.ipv4_mapped is not None:
        yield address.ipv4_mapped
    if address.sixtofour is not None:
        yield address.sixtofour
    if _is_in(address, NAT64):
        yield ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)


_look_ups = threading.BoundedSemaphore(MAX_LOOK_UPS)


async def _look_up(host: str, port: int) -> list[str]:
    """Addresses of a host name, in the order preferred by the system.

    Resolves in a thread that nothing waits for: a look-up cannot be cancelled, and threads of a
    pool would delay the end of the process.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[list[str]] = loop.create_future()

    def tell(found: list[str] | OSError) -> None:
        if done.cancelled():
            return
        if isinstance(found, OSError):
            done.set_exception(found)
        else:
            done.set_result(found)

    def work() -> None:
        found: list[str] | OSError
        try:
            answers = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            found = list(dict.fromkeys(str(answer[4][0]) for answer in answers))
        except (OSError, UnicodeError) as error:
            found = error if isinstance(error, OSError) else OSError(f"{host}: {error}")
        finally:
            _look_ups.release()
        # The loop may have ended meanwhile.
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(tell, found)

    if not _look_ups.acquire(blocking=False):
        raise OSError("too many names are being looked up")
    threading.Thread(target=work, name="webhook-name", daemon=True).start()
    return await done

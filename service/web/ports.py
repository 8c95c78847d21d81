"""Whether a port can be served on, asked before anything is started."""

import errno
import socket

from service.errors import BadConfiguration

_REMEDIES = {
    errno.EADDRINUSE: "stop what serves there, or choose another port with --port or ACQUIRE_PORT "
    "(make run PORT=8100)",
    errno.EADDRNOTAVAIL: "choose an address of this machine with --host or ACQUIRE_HOST",
    errno.EACCES: "choose a port above 1023 with --port or ACQUIRE_PORT",
}


def url_of(host: str, port: int) -> str:
    """The address of a service on a host and a port."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def require_free(host: str, port: int) -> None:
    """Raise `BadConfiguration`, with what to do, where a port cannot be served on."""
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in places:
            with socket.socket(family, kind, protocol) as probe:
                # As the server does: a port that was just let go of is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                probe.bind(address)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "choose another with --host and --port")
        said = error.strerror or str(error)
        raise BadConfiguration(f"{url_of(host, port)}: {said}; {remedy}") from None

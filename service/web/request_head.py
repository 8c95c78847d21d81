"""Checks of a request's head that RFC 9112 requires and the HTTP parser omits."""

import re
from collections.abc import Iterable
from http import HTTPStatus

_HOST = re.compile(
    rb"(?:\[[0-9A-Fa-f:.]+\]|(?:[A-Za-z0-9._~!$&'()*+,;=-]|%[0-9A-Fa-f]{2})*)(?::\d*)?"
)
_ABSOLUTE = re.compile(rb"[A-Za-z][A-Za-z0-9+.-]*://([^/?#]*)")

Refusal = tuple[HTTPStatus, str]


def refusal_of(
    target: bytes, http_version: str, fields: Iterable[tuple[bytes, bytes]]
) -> Refusal | None:
    """Status and reason to refuse a request with; None if its head is valid.

    The names of `fields` are in lower case.
    """
    hosts, codings = [], []
    for name, value in fields:
        if name == b"host":
            hosts.append(value.strip())
        elif name == b"transfer-encoding":
            codings += [each.strip().lower() for each in value.split(b",")]
    if len(hosts) > 1 or (not hosts and http_version != "1.0"):
        # RFC 9112, 3.2.
        reason = "a request must have one header field Host"
        return HTTPStatus.BAD_REQUEST, f"{reason}, and this has {len(hosts) or 'none'}"
    if hosts and not _HOST.fullmatch(hosts[0]):
        return HTTPStatus.BAD_REQUEST, "Host: must be a name or an address, and perhaps a port"
    absolute = None if target.startswith(b"/") else _ABSOLUTE.match(target)
    if absolute and (not hosts or absolute[1].lower() != hosts[0].lower()):
        # RFC 9112, 3.2.2: the target decides, so it must not name another host than the field.
        return HTTPStatus.BAD_REQUEST, "the target of the request names another host than Host"
    return _coding_refusal(codings, http_version) if codings else None


def _coding_refusal(codings: list[bytes], http_version: str) -> Refusal | None:
    """Refusal of a Transfer-Encoding other than one `chunked` (RFC 9112, 6.1, 6.3), or None."""
    if http_version == "1.0":
        return HTTPStatus.BAD_REQUEST, "Transfer-Encoding: HTTP/1.0 has none"
    if any(each != b"chunked" for each in codings):
        return HTTPStatus.NOT_IMPLEMENTED, "Transfer-Encoding: only chunked is understood"
    if len(codings) > 1:
        return HTTPStatus.BAD_REQUEST, "Transfer-Encoding: chunked may be applied only once"
    return None

"""Delivery attempt: a POST to a checked address, with limits on time and answer size."""

import asyncio
import time
from collections.abc import Mapping, Sequence
from email.utils import parsedate_to_datetime

import httpx

from service import __version__
from service.features.webhooks.addresses import Refused, reachable_addresses
from service.features.webhooks.messages import TOTAL_S, Outcome
from service.settings import Network

MAX_ANSWER_BYTES = 64 << 10
PORTS = {"http": 80, "https": 443}


class CheckedTransport(httpx.AsyncBaseTransport):
    """HTTP transport to checked addresses of a host; TLS verifies the host name."""

    def __init__(self, allowed: Sequence[Network]) -> None:
        self._allowed = allowed
        context = httpx.create_ssl_context(trust_env=False)
        # Trust the system's authorities too, so that a site can add its own.
        context.load_default_certs()
        self._inner = httpx.AsyncHTTPTransport(
            verify=context,
            trust_env=False,
            # A kept connection would serve another name that has the same address.
            limits=httpx.Limits(max_connections=None, max_keepalive_connections=0),
        )

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send the request to the first address that accepts a connection.

        Raises `Refused` for an address that must not be reached.
        """
        url = request.url
        # Host as sent: decoded and encoded again by the rules of 2003, xn--fa-hia.example would
        # become fass.example, which has another owner.
        host = url.raw_host.decode("ascii")
        addresses = await reachable_addresses(
            host,
            url.port or PORTS[url.scheme],
            self._allowed,
            only_allowed=url.scheme == "http",
        )
        # The header `Host` was made of the name before.
        request.extensions = {**request.extensions, "sni_hostname": host}
        limits = dict(request.extensions["timeout"])
        for address in addresses[:-1]:
            request.url = url.copy_with(host=address)
            # An address that does not answer must leave time for the other addresses.
            share_s = {"connect": TOTAL_S / len(addresses)}
            request.extensions = {**request.extensions, "timeout": limits | share_s}
            try:
                return await self._inner.handle_async_request(request)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                continue  # nothing was sent yet
        request.extensions = {**request.extensions, "timeout": limits}
        request.url = url.copy_with(host=addresses[-1])
        return await self._inner.handle_async_request(request)

    async def aclose(self) -> None:
        """Close the connections of the transport."""
        await self._inner.aclose()


class Poster:
    """Sends webhook messages over HTTP, any number at the same time."""

    def __init__(self, allowed: Sequence[Network]) -> None:
        self._client = httpx.AsyncClient(
            transport=CheckedTransport(allowed),
            trust_env=False,
            follow_redirects=False,
            timeout=TOTAL_S,
            headers={
                "Content-Type": "application/json",
                "User-Agent": f"attitude-acquisition/{__version__}",
                "Accept-Encoding": "identity",
                "Connection": "close",
            },
        )

    async def post(self, url: str, headers: Mapping[str, str], body: bytes) -> Outcome:
        """Send a message body; failures are returned as an outcome, not raised."""
        begun_s = time.monotonic()
        status: int | None = None
        retry_after_s: float | None = None
        fault: str | None
        try:
            async with asyncio.timeout(TOTAL_S):
                async with self._client.stream(
                    "POST", url, headers=headers, content=body
                ) as answer:
                    status = answer.status_code
                    retry_after_s = _retry_after_s(answer.headers.get("retry-after"))
                    received = 0
                    # Raw bytes: compressed content could expand to any size.
                    async for piece in answer.aiter_raw():
                        received += len(piece)
                        if received > MAX_ANSWER_BYTES:
                            break
                fault = _fault_of(status)
        except Refused as error:
            fault = f"refused: {error}"
        except (TimeoutError, httpx.TimeoutException):
            fault = f"no complete answer within {TOTAL_S:g} s"
        except httpx.ConnectError as error:
            fault = f"no connection: {error}"
        except httpx.HTTPError as error:
            fault = f"the connection broke: {str(error) or type(error).__name__}"
        except (OSError, httpx.InvalidURL, ValueError) as error:
            fault = f"the name cannot be resolved: {error}"
        if fault is not None:
            fault = fault[:300].replace("\x00", "")
        return Outcome(status, fault, retry_after_s, time.monotonic() - begun_s)

    async def close(self) -> None:
        """Close the HTTP client."""
        await self._client.aclose()


def _fault_of(status: int) -> str | None:
    if 200 <= status < 300:
        return None
    if 300 <= status < 400:
        return f"status {status}: redirects are not followed"
    return f"status {status}"


def _retry_after_s(text: str | None) -> float | None:
    """Seconds from a header `Retry-After` with a number or a date; None if invalid."""
    if text is None:
        return None
    if text.isascii() and text.isdigit() and len(text) < 10:
        return float(text)
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - time.time())
    except (ValueError, OverflowError):
        return None

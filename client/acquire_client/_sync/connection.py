"""Connection that sends requests, repeats them if useful and safe, and reads lists by pages."""

import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import httpx
import msgspec

from ..base import Page
from ..calls import Call, Caller, Listing
from ..encoding import Query, bearer_of, checked_address, decoded, json_of, parameters_of
from ..errors import NoAnswer, UnexpectedAnswer, problem_of
from ..retrying import Patience, Repeat, shown
from ..tables import pandas_of, table_of
from .backend import sleep

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

T = TypeVar("T")
Row = TypeVar("Row", bound=msgspec.Struct)

ITEMS_A_PAGE = 500

CONNECT_S = 5.0
JSON = {"Content-Type": "application/json"}


class Connection(Caller):
    """Connections to a service; `Client` explains the arguments."""

    def __init__(
        self,
        url: str,
        token: str | None = None,
        *,
        give_up_after_s: float = 30.0,
        timeout_s: float = 60.0,
        trust_env: bool = False,
        verify: ssl.SSLContext | bool = True,
    ) -> None:
        self.url = checked_address(url)
        self.give_up_after_s = give_up_after_s
        self._http = httpx.Client(
            base_url=self.url,
            headers=bearer_of(token),
            timeout=httpx.Timeout(timeout_s, connect=min(CONNECT_S, timeout_s)),
            # No limit of its own: `at_once` is the bound.
            limits=httpx.Limits(max_connections=None, max_keepalive_connections=20),
            trust_env=trust_env,
            verify=verify,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections to the service."""
        self._http.close()

    def ping(self) -> None:
        """Check with a single attempt that a service answers.

        Raises `NoAnswer` where none does, `UnexpectedAnswer` where it is not this service.
        """
        try:
            response = self._http.get("/livez")
        except httpx.RequestError as error:
            raise NoAnswer(shown(error)) from None
        if not response.is_success:
            status = response.status_code
            raise UnexpectedAnswer(
                f"{self.url} is not this service: GET /livez gives HTTP {status}"
            )

    def request(
        self,
        method: str,
        path: str,
        *,
        query: Query | None = None,
        body: Any = None,
        content: Any = None,
        headers: dict[str, str] | None = None,
        repeat: Repeat | None = None,
    ) -> httpx.Response:
        """Send any request of the API and return the answer; `body` is sent as JSON.

        `content` is sent unchanged.  Methods other than GET, PUT and DELETE are sent again only
        where the service has not received them, unless `repeat` says otherwise.  Raises `NoAnswer`
        or the `Problem` of the answer.
        """
        if repeat is None:
            safe = method.upper() in ("GET", "HEAD", "PUT", "DELETE")
            repeat = Repeat.ALWAYS if safe else Repeat.IF_REFUSED
        if body is not None:
            content, headers = json_of(body), JSON | (headers or {})
        parameters = parameters_of(query or {})
        patience = Patience(self.give_up_after_s, repeat)
        while True:
            try:
                response = self._http.request(
                    method, path, params=parameters, content=content, headers=headers
                )
                if response.is_success:
                    return response
                wait_s = patience.after_problem(problem_of(response))
            except httpx.RequestError as error:
                wait_s = patience.after_loss(error, self.url)
            sleep(wait_s)

    @contextmanager
    def stream(
        self, path: str, query: Query, headers: dict[str, str], silence_s: float
    ) -> Iterator[Iterator[bytes]]:
        """Stream the bytes of an answer as they arrive; raises the `Problem` of an error.

        A stream that is silent for `silence_s` counts as lost.  Nothing is sent again.
        """
        timeout = httpx.Timeout(silence_s, connect=CONNECT_S)
        with self._http.stream(
            "GET", path, params=parameters_of(query), headers=headers, timeout=timeout
        ) as response:
            if not response.is_success:
                response.read()
                raise problem_of(response)
            yield response.iter_bytes()

    def _carry_out(self, call: Call[T]) -> T:
        """Send the request of a call, and read its answer."""
        asked = {name: getattr(call, name) for name in ("query", "body", "content", "headers")}
        response = self.request(call.method, call.path, repeat=call.repeat, **asked)
        return call.read(response)

    def _listed(self, listing: Listing[Row]) -> "Items[Row]":
        """Iterator over the items of a paged list."""
        return Items(self, listing)

    def get(self, kind: type[T], path: str, query: Query | None = None) -> T:
        """Send a GET request; the answer as a model."""
        return decoded(self.request("GET", path, query=query), kind)

    def post(self, kind: type[T], path: str, body: Any, repeat: Repeat = Repeat.IF_REFUSED) -> T:
        """Send a POST request with JSON; the answer as a model."""
        return decoded(self.request("POST", path, body=body, repeat=repeat), kind)


class Items(Generic[Row]):
    """Items of a paged list, which can be iterated repeatedly.

    Batches that the service records meanwhile neither repeat nor hide items.
    """

    def __init__(self, connection: Connection, listing: Listing[Row]) -> None:
        self._connection, self._listing = connection, listing

    def __iter__(self) -> Iterator[Row]:
        # The type is known only at run time, which type checkers do not allow.
        page_kind: Any = Page[self._listing.kind]  # type: ignore[name-defined]
        query = {"limit": ITEMS_A_PAGE, **self._listing.query}
        while True:
            page = self._connection.get(page_kind, self._listing.path, query)
            yield from page.items
            if page.next_cursor is None:
                return
            query["cursor"] = page.next_cursor

    def all(self) -> list[Row]:
        """Read all items of the paged list at once."""
        return list(self)

    def to_arrow(self) -> "pa.Table":
        """Arrow table with a row for each item; raises `PackageMissing` without pyarrow."""
        return table_of(self.all(), self._listing.kind)

    def to_pandas(self) -> "pd.DataFrame":
        """Data frame with a row for each item; `PackageMissing` without pandas and pyarrow."""
        return pandas_of(self.to_arrow())

"""Methods of both clients that are one request: each is written once, as what it asks.

A method describes its request, and the client that it is called on carries it out: `Client` at
once, `AsyncClient` when the call is awaited.
"""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial, update_wrapper, wraps
from types import MethodType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

import httpx
import msgspec

from .base import Page
from .encoding import Query, decoded
from .retrying import Repeat

if TYPE_CHECKING:
    from ._async.connection import AsyncConnection, AsyncItems
    from ._sync.connection import Connection, Items

P = ParamSpec("P")
T = TypeVar("T")
Row = TypeVar("Row", bound=msgspec.Struct)


@dataclass(frozen=True)
class Call(Generic[T]):
    """A request, and how its answer is read; the rest is as `request` of the clients has it."""

    read: Callable[[httpx.Response], T]
    method: str
    path: str
    query: Query | None = None
    body: Any = None
    content: Any = None
    headers: dict[str, str] | None = None
    repeat: Repeat | None = None


@dataclass(frozen=True)
class Listing(Generic[Row]):
    """A long list, whose pages are read as they are needed."""

    kind: type[Row]
    path: str
    query: Query


def get(kind: type[T], path: str, query: Query | None = None) -> Call[T]:
    """A GET whose answer is a model."""
    return Call(partial(decoded, kind=kind), "GET", path, query)


def get_items(kind: type[Row], path: str, query: Query | None = None) -> Call[list[Row]]:
    """A GET whose answer is a short list of models."""
    page: Any = Page[kind]  # type: ignore[valid-type]
    return Call(lambda response: decoded(response, page).items, "GET", path, query)


def post(kind: type[T], path: str, body: Any, repeat: Repeat = Repeat.IF_REFUSED) -> Call[T]:
    """A POST of JSON whose answer is a model."""
    return Call(partial(decoded, kind=kind), "POST", path, body=body, repeat=repeat)


class _Method(Generic[P]):
    """A method that describes what the client carries out."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Any]) -> None:
        @wraps(describe)
        def method(client: Any, *args: P.args, **kwargs: P.kwargs) -> Any:
            asked = describe(client, *args, **kwargs)
            return client._carry_out(asked) if isinstance(asked, Call) else client._listed(asked)

        self._method = method
        # For `doctest`, which looks at this object.
        update_wrapper(cast(Any, self), describe)

    def _bound(self, client: Any) -> Any:
        return self._method if client is None else MethodType(self._method, client)


class single_request(_Method[P], Generic[P, T]):  # noqa: N801 - a decorator
    """Decorates a method that describes one request."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Call[T]]) -> None:
        super().__init__(describe)

    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...

    @overload
    def __get__(self, client: "Connection", owner: type) -> Callable[P, T]: ...

    @overload
    def __get__(
        self, client: "AsyncConnection", owner: type
    ) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """The method of a client, or the function of a class."""
        return self._bound(client)


class paged_list(_Method[P], Generic[P, Row]):  # noqa: N801 - a decorator
    """Decorates a method that describes a long list."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Listing[Row]]) -> None:
        super().__init__(describe)

    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...

    @overload
    def __get__(self, client: "Connection", owner: type) -> Callable[P, "Items[Row]"]: ...

    @overload
    def __get__(self, client: "AsyncConnection", owner: type) -> Callable[P, "AsyncItems[Row]"]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """The method of a client, or the function of a class."""
        return self._bound(client)

"""Methods of both clients that are one request: each is written once, as what it asks.

A method describes its request, and the client that it is called on carries it out: `Client` at
once, `AsyncClient` when the call is awaited.
"""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial, update_wrapper, wraps
from inspect import getattr_static, iscoroutinefunction
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
    # The type is known only now, which the checker of types does not allow.
    page: Any = Page[kind]  # type: ignore[valid-type]
    return Call(lambda response: decoded(response, page).items, "GET", path, query)


def post(kind: type[T], path: str, body: Any, repeat: Repeat = Repeat.IF_REFUSED) -> Call[T]:
    """A POST of JSON whose answer is a model."""
    return Call(partial(decoded, kind=kind), "POST", path, body=body, repeat=repeat)


class _Method:
    """A method that describes what the client carries out."""

    def __init__(self, describe: Callable[..., Any]) -> None:
        self._describe = describe
        # For `doctest`, which looks at this object.
        update_wrapper(cast(Any, self), describe)

    def function_of(self, owner: type["Caller"]) -> Callable[..., Any]:
        """The function that a class of clients has in place of this object."""
        # Each of the two kinds of methods has its own.
        raise NotImplementedError


class Caller:
    """The base of both connections: classes below it get functions in place of descriptions.

    They are coroutine functions where the connection is asynchronous, as `inspect` and
    `unittest.mock.create_autospec` look for.
    """

    _carry_out: Callable[..., Any]
    _listed: Callable[..., Any]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in dir(cls):
            method = getattr_static(cls, name)
            if isinstance(method, _Method):
                setattr(cls, name, method.function_of(cls))


class single_request(_Method, Generic[P, T]):  # noqa: N801 - a decorator
    """Decorates a method that describes one request."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Call[T]]) -> None:
        super().__init__(describe)

    def function_of(self, owner: type[Caller]) -> Callable[..., Any]:
        """A function that sends the request, and gives the answer."""
        describe = self._describe

        @wraps(describe)
        def at_once(client: Any, *args: Any, **kwargs: Any) -> Any:
            return client._carry_out(describe(client, *args, **kwargs))

        @wraps(describe)
        async def awaited(client: Any, *args: Any, **kwargs: Any) -> Any:
            return await client._carry_out(describe(client, *args, **kwargs))

        return awaited if iscoroutinefunction(owner._carry_out) else at_once

    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...

    @overload
    def __get__(self, client: "Connection", owner: type) -> Callable[P, T]: ...

    @overload
    def __get__(
        self, client: "AsyncConnection", owner: type
    ) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """For type checkers: classes of clients have a function in place of this object."""
        return self


class paged_list(_Method, Generic[P, Row]):  # noqa: N801 - a decorator
    """Decorates a method that describes a long list."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Listing[Row]]) -> None:
        super().__init__(describe)

    def function_of(self, owner: type[Caller]) -> Callable[..., Any]:
        """A function that gives the items of the list."""
        describe = self._describe

        @wraps(describe)
        def listed(client: Any, *args: Any, **kwargs: Any) -> Any:
            return client._listed(describe(client, *args, **kwargs))

        return listed

    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...

    @overload
    def __get__(self, client: "Connection", owner: type) -> Callable[P, "Items[Row]"]: ...

    @overload
    def __get__(self, client: "AsyncConnection", owner: type) -> Callable[P, "AsyncItems[Row]"]: ...

    def __get__(self, client: Any, owner: type) -> Any:
        """For type checkers: classes of clients have a function in place of this object."""
        return self

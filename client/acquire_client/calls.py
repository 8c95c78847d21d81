"""Client methods of one request each, written once for both clients as a description.

A method describes its request, and the client on which it is called sends it: `Client` at once,
`AsyncClient` when the call is awaited.
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
    """Description of a request, with the function that reads its answer; fields as in `request`."""

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
    """Description of a long list, whose pages are read on demand."""

    kind: type[Row]
    path: str
    query: Query


def model(kind: type[T]) -> Callable[[httpx.Response], T]:
    """Reader of an answer that is a model."""
    return partial(decoded, kind=kind)


def items(kind: type[Row]) -> Callable[[httpx.Response], list[Row]]:
    """Reader of an answer that is a short list of models."""
    # The type is known only at run time, which type checkers do not allow.
    page: Any = Page[kind]  # type: ignore[valid-type]
    return lambda response: decoded(response, page).items


def text(response: httpx.Response) -> str:
    """Read an answer that is a text."""
    return response.text


class _Method:
    """Method of a client given by the description of its request or list."""

    def __init__(self, describe: Callable[..., Any]) -> None:
        self._describe = describe
        # For `doctest`, which looks at this object.
        update_wrapper(cast(Any, self), describe)

    def function_of(self, owner: type["Caller"]) -> Callable[..., Any]:
        """Function that replaces the described method in a class of clients."""
        # The two kinds of methods override this.
        raise NotImplementedError


class Caller:
    """Base class of both connections, in which functions replace descriptions of requests.

    They are coroutine functions where the connection is asynchronous, so that `inspect` and
    `unittest.mock.create_autospec` recognise them.
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
    """Decorator of a client method that describes one request."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Call[T]]) -> None:
        super().__init__(describe)

    def function_of(self, owner: type[Caller]) -> Callable[..., Any]:
        """Function that sends the described request, and returns the answer."""
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
        """Present only for type checkers: a function replaces this object in classes of clients."""
        return self


class paged_list(_Method, Generic[P, Row]):  # noqa: N801 - a decorator
    """Decorator of a client method that describes a long list."""

    def __init__(self, describe: Callable[Concatenate[Any, P], Listing[Row]]) -> None:
        super().__init__(describe)

    def function_of(self, owner: type[Caller]) -> Callable[..., Any]:
        """Function that returns the items of the described list."""
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
        """Present only for type checkers: a function replaces this object in classes of clients."""
        return self

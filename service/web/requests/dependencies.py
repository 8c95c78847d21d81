"""Dependencies of handlers: the app and the metrics; and the forms of responses.

All dependencies are asynchronous: they never wait for a worker thread, because
all of them may be busy when a probe arrives.
"""

from typing import Annotated, Any

import msgspec
from fastapi import Depends
from starlette.requests import Request
from starlette.responses import Response

from service.app.factory import App
from service.storage.models.base import Page
from service.web.requests.metrics import Metrics
from service.web.requests.request_body import JSON

_JSON = msgspec.json.Encoder()


async def _app(request: Request) -> App:
    app = request.app.state.app
    assert isinstance(app, App)
    return app


async def _metrics(request: Request) -> Metrics:
    metrics = request.app.state.metrics
    assert isinstance(metrics, Metrics)
    return metrics


AppDep = Annotated[App, Depends(_app)]
MetricsDep = Annotated[Metrics, Depends(_metrics)]


def json_response(
    content: Any, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """An answer of plain values."""
    return Response(_JSON.encode(content), status, headers, media_type=JSON)


def page_response(request: Request, page: Page[Any]) -> Response:
    """A page; where there is another, `Link` leads to it with the same filters."""
    headers = None
    if page.next_cursor is not None:
        following = request.url.include_query_params(cursor=page.next_cursor)
        headers = {"Link": f'<{following.path}?{following.query}>; rel="next"'}
    content = {"items": page.items, "next_cursor": page.next_cursor}
    return json_response(content, headers=headers)

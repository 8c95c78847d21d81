"""The least that a post can cost here: `uvicorn benchmarks.no_op:app`.

The same server, framework and body as those of the service.  The route reads
the body, parses its JSON and answers a small JSON; nothing is checked, worked
out or kept.  `/checked` lets the framework check the body by the service's own
model as well.
"""

from typing import Any

from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import JSONResponse

from service.observe.wire import BatchIn

app = FastAPI(openapi_url=None)


@app.post("/no-op")
async def no_op(request: Request) -> JSONResponse:
    body: dict[str, Any] = await request.json()
    return JSONResponse({"batch": body["batch"], "trackers": len(body["observations"])}, 201)


@app.post("/checked")
async def checked(body: BatchIn) -> JSONResponse:
    return JSONResponse({"batch": body.batch, "trackers": len(body.observations)}, 201)

"""Lower limit of the cost of a post: `uvicorn benchmarks.speed.no_op:app`.

The same server, framework and body as those of the service.  `/no-op` takes a
batch as a route of the framework does, by the model of the body, and answers a
small JSON; nothing is worked out or kept.  `/any-json` takes whatever is JSON.
"""

from typing import Any

from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import JSONResponse

from service.observations.schema import BatchIn

app = FastAPI(openapi_url=None)


@app.post("/no-op")
async def no_op(body: BatchIn) -> JSONResponse:
    return JSONResponse({"batch": body.batch, "trackers": len(body.observations)}, 201)


@app.post("/any-json")
async def any_json(request: Request) -> JSONResponse:
    body: dict[str, Any] = await request.json()
    return JSONResponse({"batch": body["batch"], "trackers": len(body["observations"])}, 201)

"""Replay through a running service: a window of posts at a time, results in the order sent.

A post whose answer was lost is sent again: the service knows the batch by its
identity and records it once.
"""

import asyncio
import json
from collections import deque
from collections.abc import Iterable

import httpx

from service.errors import BadInput, Busy, Fault, Unauthenticated, shown_value
from service.replay.carry_attitude import AttitudeCarrier, reporting_to_carrier
from service.replay.items import Item, LineOutcome, Pace, Problem, Report

ROUTE = "/api/v1/batches"
JSON = {"Content-Type": "application/json"}
RETRY_STATUSES = frozenset({429, 502, 503, 504})
TIMEOUT = httpx.Timeout(60.0, connect=5.0)
FIRST_RETRY_S, LONGEST_RETRY_S = 0.1, 5.0
GIVE_UP_AFTER_S = 30.0


def replay_over_http(
    url: str,
    items: Iterable[Item],
    report: Report,
    pace: Pace | None = None,
    concurrency: int = 4,
    give_up_after_s: float = GIVE_UP_AFTER_S,
    token: str | None = None,
    watched_run: str | None = None,
    carrier: AttitudeCarrier | None = None,
) -> None:
    """Post every item to the service at `url` and report what became of it, in order.

    With a `carrier` each batch waits for the answer to the one before.
    Raises `BadInput` for an address that is none, `Unauthenticated` where the
    service does not accept `token`, `Busy` when no service answers there, or
    none any more for `give_up_after_s`.  `watched_run` is a run that limits are to
    be held against.
    """
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    if carrier is not None:
        report, concurrency = reporting_to_carrier(report, carrier), 1
    asyncio.run(
        _replay(
            checked_url(url),
            items,
            report,
            pace or Pace(),
            concurrency,
            give_up_after_s,
            headers,
            watched_run,
            carrier,
        )
    )


def checked_url(url: str) -> str:
    """The address without a slash at its end; raises `BadInput` for one that is none."""
    try:
        parsed = httpx.URL(url)
        valid = parsed.scheme in ("http", "https") and bool(parsed.host)
    except httpx.InvalidURL:
        valid = False
    if not valid:
        message = "must be the address of a service, such as http://127.0.0.1:8000"
        raise BadInput(Fault("--url", message, shown_value(url)))
    return url.rstrip("/")


async def _replay(
    url: str,
    items: Iterable[Item],
    report: Report,
    pace: Pace,
    concurrency: int,
    give_up_after_s: float,
    headers: dict[str, str],
    watched_run: str | None,
    carrier: AttitudeCarrier | None,
) -> None:
    limits = httpx.Limits(max_connections=concurrency, max_keepalive_connections=concurrency)
    # The service listens to this machine alone: a proxy of the environment cannot reach it.
    async with httpx.AsyncClient(
        base_url=url, timeout=TIMEOUT, limits=limits, trust_env=False, headers=headers
    ) as client:
        await _require_service(client, url)
        if watched_run is not None:
            await _watch(client, watched_run)
        clock = asyncio.get_running_loop().time
        window: deque[asyncio.Task[LineOutcome]] = deque()
        try:
            for item in items:
                while (wait_s := pace.wait_s(item, clock())) > 0:
                    while window and window[0].done():
                        report(await window.popleft())
                    await asyncio.sleep(min(wait_s, 0.5))
                if len(window) >= concurrency:
                    report(await window.popleft())
                if carrier is not None:
                    item = carrier.prepared(item)
                window.append(asyncio.create_task(_outcome(client, url, item, give_up_after_s)))
            while window:
                report(await window.popleft())
        finally:
            for task in window:
                task.cancel()
            await asyncio.gather(*window, return_exceptions=True)


async def _require_service(client: httpx.AsyncClient, url: str) -> None:
    try:
        response = await client.get("/livez")
    except httpx.TransportError as error:
        raise Busy(
            f"no service answers at {url} ({shown_error(error)}); "
            "start one with `acquire serve`, or replay with --in-process"
        ) from None
    if response.status_code != 200:
        raise Busy(f"{url} is not this service: GET /livez gives {response.status_code}")
    if (await client.get("/api/v1/session")).status_code == 401:
        raise Unauthenticated(
            f"{url} asks for a token: set ACQUIRE_TOKEN to one of its `acquire token create`"
        )


async def _watch(client: httpx.AsyncClient, run: str) -> None:
    answer = await client.put(f"/api/v1/runs/{run}", json={"alarms": True})
    if answer.status_code != 200:
        raise BadInput(Fault("--alarms", str(_problem(answer)["detail"]), run))


async def _outcome(
    client: httpx.AsyncClient, url: str, item: Item, give_up_after_s: float
) -> LineOutcome:
    if item.submission is None:
        return LineOutcome(item, None, problem=item.problem)
    response = await _post(client, url, item.submission.text, give_up_after_s)
    if response.status_code in (200, 201):
        return LineOutcome(item, response.content, response.headers.get("Replayed") == "true")
    return LineOutcome(item, None, problem=_problem(response))


async def _post(
    client: httpx.AsyncClient, url: str, text: str, give_up_after_s: float
) -> httpx.Response:
    clock = asyncio.get_running_loop().time
    deadline, wait_s = clock() + give_up_after_s, FIRST_RETRY_S
    while True:
        asked_s = 0.0
        try:
            response = await client.post(ROUTE, content=text, headers=JSON)
            if response.status_code not in RETRY_STATUSES:
                return response
            why = f"HTTP {response.status_code}"
            asked_s = _seconds(response.headers.get("Retry-After", ""))
        except httpx.TransportError as error:
            why = shown_error(error)
        if clock() >= deadline:
            raise Busy(
                f"{url} no longer answers ({why}); run the same command again to go on "
                "from here: nothing is recorded twice"
            )
        await asyncio.sleep(min(max(wait_s, asked_s), LONGEST_RETRY_S))
        wait_s *= 2


def _seconds(text: str) -> float:
    return float(text) if text.isascii() and text.isdigit() else 0.0


def shown_error(error: Exception) -> str:
    """An error's words, or its name where it has none."""
    return str(error) or type(error).__name__


def _problem(response: httpx.Response) -> Problem:
    """The part of a problem that does not depend on how the batch was sent."""
    try:
        content = response.json()
        return {name: content[name] for name in ("detail", "errors") if name in content}
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError):
        return {"detail": f"HTTP {response.status_code}: {response.text[:200]}"}

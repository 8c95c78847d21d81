"""Holds every answer against the committed `openapi.yaml`."""

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import yaml
from jsonschema import Draft202012Validator
from referencing import Registry, Resource
from referencing.jsonschema import DRAFT202012

FILE = Path(__file__).parents[2] / "openapi.yaml"
_URI = "urn:openapi"


@cache
def reference() -> dict[str, Any]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load(FILE.read_text(encoding="utf-8"), loader)


@cache
def _registry() -> Registry:
    resource = Resource.from_contents(reference(), default_specification=DRAFT202012)
    return Registry().with_resource(_URI, resource)


@cache
def validator(*place: str) -> Draft202012Validator:
    """The validator of the schema that stands at a place of the reference."""
    pointer = "/".join(each.replace("~", "~0").replace("/", "~1") for each in place)
    return Draft202012Validator({"$ref": f"{_URI}#/{pointer}"}, registry=_registry())


def checked(client: httpx.Client) -> httpx.Client:
    """A client every answer to which is held against the file."""
    client.event_hooks = {"response": [check]}
    return client


def check(response: httpx.Response) -> None:
    """Fail where an answer is not as described: its status, its type, its headers, its shape."""
    request = response.request
    check_answer(request.method, request.url, response.status_code, response.headers, response.read)


def check_answer(
    method: str,
    url: httpx.URL,
    status_code: int,
    headers: httpx.Headers,
    read: Callable[[], bytes],
) -> None:
    """The same of an answer that some other client got."""
    path = next((each for each in reference()["paths"] if _fits(each, url.path)), None)
    operation = (
        reference()["paths"].get(path, {}).get("get" if method == "HEAD" else method.lower())
    )
    if operation is None:
        assert status_code in (404, 405) or path is None, url
        return
    status = str(status_code)
    if status not in operation["responses"]:
        assert status_code >= 400, f"{status} is not described: {url}"
        status = "default"
    described = operation["responses"][status]
    if not described["content"]:
        assert not read()
        return
    kind = headers["content-type"].partition(";")[0]
    assert kind in described["content"], (kind, url)
    for header in set(described.get("headers", {})) - {"Link"}:
        assert header in headers, (header, url)
    content = read()
    if kind.endswith("json") and method != "HEAD":
        place = ("paths", path, method.lower(), "responses", status, "content", kind, "schema")
        errors = list(validator(*place).iter_errors(json.loads(content)))
        assert not errors, f"{method} {url}: {errors[0]}"


def _fits(template: str, path: str) -> bool:
    pattern = re.sub(r"\\\{\w+\\\}", "[^/]+", re.escape(template))
    return re.fullmatch(pattern, path) is not None
